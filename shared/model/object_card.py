"""The card of an object of the user's, `object.toml`: what services need of it beside its mesh and its networks."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from saccade.shared.config import set_folder
from saccade.shared.errors import SaccadeError
from saccade.shared.files import MIB, parse_toml, read_text
from saccade.shared.world.symmetry import NONE, symmetry_from

CARD = "object.toml"
_NEED = "mend it, or remove the object and add it again"


def read_card(folder: Path) -> dict[str, Any]:
    """What the card in an object's folder says. It is empty if there is no card. Raises SaccadeError if it cannot be
    read."""
    path = folder / CARD
    if not os.path.lexists(path):
        return {}
    text = read_text(path, "object card", _NEED, MIB)
    try:
        return parse_toml(text)
    except ValueError as error:
        raise SaccadeError(f"object card {path} is not TOML ({error}): {_NEED}") from error


def symmetry_in(folder: Path, key: str = "symmetry") -> int:
    """The symmetry that the card in an object's folder says, and none if it says nothing. Raises SaccadeError if the
    card cannot be read, or says something else."""
    value = read_card(folder).get(key)
    try:
        return NONE if value is None else symmetry_from(value)
    except ValueError as error:
        raise SaccadeError(f"object card {folder / CARD}: {error}") from error


def symmetries(objects: str, names: Sequence[str]) -> dict[str, int]:
    """The symmetries of objects of a set, by name. Those of the sets that come with Saccade have none. Raises
    SaccadeError if a card is damaged."""
    folder = set_folder(objects)
    return {name: NONE if folder is None else symmetry_in(folder / name) for name in names}
