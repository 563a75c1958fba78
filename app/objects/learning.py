"""Learns the objects of a set: makes the bank of each, and does not touch the files of the others."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from saccade.app.objects.cards import digest
from saccade.shared.config import WEIGHTS, learned_folder
from saccade.shared.errors import SaccadeError
from saccade.shared.files import writing
from saccade.shared.log.provenance import commit
from saccade.shared.model.weights import OPEN, ObjectCard, Weights, bank_file, write_weights
from saccade.shared.render.objects import load_mesh, own_names
from saccade.shared.render.views import crop_side_m
from saccade.training.open.banks import BankMaker

Arrays = dict[str, NDArray[Any]]
SIZES_M = (0.002, 5.0)  # the largest side of an object


@dataclass(frozen=True)
class Learnt:
    """The names of the objects that were learnt, and for each one that could not be a line that says why."""

    names: list[str]
    refused: dict[str, str]


def learn(objects: str, folder: Path, show: Callable[[str, int, int], None]) -> Learnt:
    """Makes the banks that are missing, damaged or out of date in a set, and forgets those of objects that are gone.

    What is done is kept when this is interrupted. `show` is told (object, how many are done, how many there are).
    Raises SaccadeError if the networks are damaged, or if the banks cannot be written.
    """
    networks, target = Weights(WEIGHTS / OPEN), learned_folder(objects, OPEN)
    names, refused = own_names(folder), dict[str, str]()
    digests: dict[str, str] = {}
    for name in names:
        try:
            digests[name] = digest(folder / name)
        except SaccadeError as error:
            refused[name] = str(error)
    cards, hashes, is_whole = _known(target, networks.basis, digests)
    missing = [name for name in digests if name not in cards]
    make = BankMaker(networks)
    learnt = list[str]()
    for done, name in enumerate(missing):
        show(name, done, len(missing))
        try:
            mesh = load_mesh(objects, name)
            require_size(mesh.size_m, name)
        except SaccadeError as error:
            refused[name] = f"{error}; or remove it with `saccade objects remove {name}`"
            continue
        bank = make(mesh).arrays()
        cards[name] = ObjectCard(name, mesh.size_m, crop_side_m(mesh.size_m))
        hashes = _write(target, networks.basis, digests, cards, {name: bank}, hashes)
        learnt.append(name)
        show(name, done + 1, len(missing))
    if not learnt and not is_whole and cards:
        _write(target, networks.basis, digests, cards, {}, hashes)
    _forget(target, cards)
    return Learnt(learnt, refused)


def require_size(size_m: NDArray[np.float64], name: str) -> None:
    """Raises SaccadeError if an object is far too small or too large."""
    largest = float(np.max(size_m))
    if not SIZES_M[0] <= largest <= SIZES_M[1]:
        raise SaccadeError(f"object {name!r} is {largest:g} m large, and one of {SIZES_M[0]:g} to {SIZES_M[1]:g} m can "
                           "be learnt: mend its mesh")


def _write(target: Path, basis: str, digests: dict[str, str], cards: dict[str, ObjectCard],
           banks: dict[str, Arrays], hashes: dict[str, str]) -> dict[str, str]:
    """Writes new banks, beside those that are there with these hashes. Returns the hashes of all."""
    facts = {"architecture": OPEN, "networks": OPEN, "networks_sha256": basis, "commit": commit(),
             "meshes_sha256": {name: digests[name] for name in cards}}
    return write_weights(target, {}, tuple(cards.values()), facts, banks, hashes)


def _known(target: Path, basis: str,
           digests: dict[str, str]) -> tuple[dict[str, ObjectCard], dict[str, str], bool]:
    """The cards of the banks that are still right, the hashes of these banks' files, and whether these are all that
    there are."""
    cards: dict[str, ObjectCard] = {}
    hashes: dict[str, str] = {}
    try:
        weights = Weights(target)
    except SaccadeError:  # there are none, or they are damaged: they are made again
        return cards, hashes, False
    before = digests_of(weights) if weights.manifest.get("networks_sha256") == basis else {}
    for card in weights.cards:
        if before.get(card.name) == digests.get(card.name, ""):
            with suppress(SaccadeError):
                weights.bank(card.name)
                hashes[bank_file(card.name)] = weights.hashes[bank_file(card.name)]
                cards[card.name] = card
    return cards, hashes, len(cards) == len(weights.cards)


def digests_of(weights: Weights) -> dict[str, str]:
    """The hashes of the meshes from which banks were made, by object."""
    found = weights.manifest.get("meshes_sha256")
    return found if isinstance(found, dict) else {}


def _forget(target: Path, cards: dict[str, ObjectCard]) -> None:
    """Removes the files of banks whose objects are gone, and all if none is left."""
    kept = set(map(bank_file, cards))
    with writing(target, "weights"):
        if not cards and target.is_dir():
            shutil.rmtree(target)
        for path in target.glob(bank_file("*")):
            if path.name not in kept:
                path.unlink()
