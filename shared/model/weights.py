"""Trained weights: a folder of safetensors in half precision with a manifest that is verified on loading.

`manifest.json` says what the weights are (data, seed, steps, losses, commit, where trained), of which architecture (the
default one where it says nothing), the measures of each object and the SHA-256 of every file.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from safetensors.numpy import load, save

from saccade.shared.errors import SaccadeError

if TYPE_CHECKING:
    from torch import nn

Architecture = Literal["default", "paper"]

MANIFEST = "manifest.json"
MAX_FILE_BYTES = 64 * 1024 * 1024


@dataclass(frozen=True)
class ObjectCard:
    """What the agent knows of an object beside its networks: the box (metres) and the side of its crop (metres)."""

    name: str
    size_m: NDArray[np.float64]
    crop_side_m: float

    @property
    def radius_m(self) -> float:
        """Half the diagonal of the box."""
        return float(np.linalg.norm(self.size_m)) / 2


class Weights:
    """The weights in a folder. Raises SaccadeError where the manifest is missing, damaged or does not match."""

    def __init__(self, folder: Path):
        self.folder = folder
        path = folder / MANIFEST
        if not path.is_file():
            raise SaccadeError(f"weights {path} are missing: train them with `saccade train`, or name another folder")
        try:
            self.manifest = json.loads(path.read_text())
            self.cards = tuple(ObjectCard(name, np.array(card["size_m"], dtype=np.float64), float(card["crop_side_m"]))
                               for name, card in self.manifest["objects"].items())
            self.hashes: dict[str, str] = dict(self.manifest["sha256"])
            self.architecture: Architecture = self.manifest.get("architecture", "default")
            self.calibration: dict[str, float] = dict(self.manifest.get("calibration", {}))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise SaccadeError(f"weights manifest {path} is damaged ({error}): get it again or train anew") from error
        if self.architecture not in get_args(Architecture):
            raise SaccadeError(f"weights manifest {path} names an unknown architecture {self.architecture!r}: "
                               "get a newer version of the program, or train anew")

    @property
    def names(self) -> tuple[str, ...]:
        """Objects that these weights know."""
        return tuple(card.name for card in self.cards)

    def cards_of(self, names: tuple[str, ...]) -> tuple[ObjectCard, ...]:
        """Cards in the order of `names`; raises SaccadeError for an object that has no weights."""
        known = {card.name: card for card in self.cards}
        for name in names:
            if name not in known:
                raise SaccadeError(f"object {name!r} has no weights in {self.folder}: train it with `saccade train`")
        return tuple(known[name] for name in names)

    def state(self, stem: str, prefix: str = "") -> dict[str, NDArray[np.float32]]:
        """Those arrays of `<stem>.safetensors` whose names begin with `prefix`, without it, after the file's hash was
        checked."""
        path = self.folder / f"{stem}.safetensors"
        if not path.is_file():
            raise SaccadeError(f"weights {path} are missing: get them again or train anew")
        if path.stat().st_size > MAX_FILE_BYTES:
            raise SaccadeError(f"weights {path} are larger than {MAX_FILE_BYTES} bytes: not ours, get them again")
        data = path.read_bytes()
        if hashlib.sha256(data).hexdigest() != self.hashes.get(path.name):
            raise SaccadeError(f"weights {path} do not match the hash in {MANIFEST}: get them again or train anew")
        return {key.removeprefix(prefix): array.astype(np.float32) for key, array in load(data).items()
                if key.startswith(prefix)}

    def fill(self, module: nn.Module, stem: str, prefix: str = "") -> nn.Module:
        """Loads `state(stem, prefix)` into a torch module and returns it."""
        import torch  # here: belief and planner need the cards and arrays alone

        try:
            module.load_state_dict({key: torch.from_numpy(array) for key, array in self.state(stem, prefix).items()})
        except RuntimeError as error:
            raise SaccadeError(f"weights {self.folder / stem} are of another architecture: train anew") from error
        return module.eval()


def write_weights(folder: Path, states: Mapping[str, Mapping[str, ArrayLike]], cards: tuple[ObjectCard, ...],
                  facts: dict[str, Any]) -> None:
    """Writes the states in half precision and the manifest with their hashes."""
    folder.mkdir(parents=True, exist_ok=True)
    hashes = {}
    for stem, state in states.items():
        data = save({key: np.asarray(value).astype(np.float16, order="C") for key, value in state.items()})
        (folder / f"{stem}.safetensors").write_bytes(data)
        hashes[f"{stem}.safetensors"] = hashlib.sha256(data).hexdigest()
    objects = {card.name: {"size_m": [round(float(x), 6) for x in card.size_m], "crop_side_m": card.crop_side_m}
               for card in cards}
    manifest = {**facts, "objects": objects, "sha256": hashes}
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=2) + "\n")
