"""Learns the objects of a set: makes the bank of each, and leaves those of the others as they are, to the byte."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from saccade.services.perception.view_encoder import ViewEncoder
from saccade.shared.config import WEIGHTS, learned_folder
from saccade.shared.errors import SaccadeError
from saccade.shared.log.provenance import commit
from saccade.shared.model.weights import MANIFEST, OPEN, ObjectCard, Weights, write_weights
from saccade.shared.render.mesh import MESH_FILE
from saccade.shared.render.objects import load_mesh, own_names
from saccade.shared.render.views import crop_side_m
from saccade.training.open.banks import bank_from

Arrays = dict[str, NDArray[Any]]


def learn(objects: str, folder: Path, show: Callable[[str, int, int], None]) -> list[str]:
    """Makes the banks that are missing or out of date in a set, and forgets those of objects that are gone.

    What is done is kept when this is interrupted. Returns the names of the objects that were learnt. `show` is told
    (object, how many are done, how many there are). Raises SaccadeError if a mesh or the networks are damaged.
    """
    networks, target = Weights(WEIGHTS / OPEN), learned_folder(objects, OPEN)
    digests = {name: _digest(folder / name) for name in own_names(folder)}
    basis = hashlib.sha256("".join(sorted(networks.hashes.values())).encode()).hexdigest()
    cards, banks = _known(target, basis, digests)
    missing = [name for name in digests if name not in banks]
    encoder = networks.fill(ViewEncoder(), "encoder")
    assert isinstance(encoder, ViewEncoder)  # it is what was filled

    def save() -> None:
        facts = {"architecture": OPEN, "networks": OPEN, "networks_sha256": basis, "commit": commit(),
                 "meshes_sha256": {name: digests[name] for name in cards}}
        write_weights(target, {}, tuple(cards.values()), facts, banks)

    for done, name in enumerate(missing):
        show(name, done, len(missing))
        mesh = load_mesh(objects, name)
        banks[name] = bank_from(mesh, encoder).arrays()
        cards[name] = ObjectCard(name, mesh.size_m, crop_side_m(mesh.size_m))
        save()
        show(name, done + 1, len(missing))
    if not missing:
        save()
    _forget(target, digests)
    return missing


def _known(target: Path, basis: str, digests: dict[str, str]) -> tuple[dict[str, ObjectCard], dict[str, Arrays]]:
    """The cards and banks that are still right."""
    if not (target / MANIFEST).is_file():
        return {}, {}
    weights = Weights(target)
    told = weights.manifest
    if told.get("networks_sha256") != basis:
        return {}, {}
    before = told.get("meshes_sha256", {})
    same = [card for card in weights.cards if before.get(card.name) == digests.get(card.name, "")]
    return {card.name: card for card in same}, {card.name: weights.bank(card.name) for card in same}


def _forget(target: Path, digests: dict[str, str]) -> None:
    """Removes the files of banks whose objects are gone."""
    for path in target.glob("*.bank.safetensors"):
        if path.name.removesuffix(".bank.safetensors") not in digests:
            path.unlink()


def _digest(folder: Path) -> str:
    """The hash of an object's mesh and texture. Raises SaccadeError if they cannot be read."""
    found = hashlib.sha256()
    try:
        for path in sorted((folder / MESH_FILE, *folder.glob("texture_map.*"))):
            found.update(path.read_bytes())
    except OSError as error:
        raise SaccadeError(f"object {folder} cannot be read ({error.strerror}): remove it, and add it again") from error
    return found.hexdigest()


def likeness(objects: str) -> tuple[tuple[str, ...], NDArray[np.float64]]:
    """How alike the objects of a set look: for each pair the largest similarity of two views [K, K], 1 being the same.
    Raises SaccadeError if the set was not learnt."""
    weights = Weights(learned_folder(objects, OPEN))
    vectors = [weights.bank(name)["vectors"].astype(np.float64) for name in weights.names]
    return weights.names, np.array([[float((a @ b.T).max()) for b in vectors] for a in vectors])

