"""The training tasks of the networks that know no object by name, and what is written when they are done."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from saccade.services.perception.comparer import Comparison
from saccade.services.perception.likeness import Cohort, LogOdds
from saccade.services.perception.local_features import LocalFeatures
from saccade.services.perception.open_world import OpenWorld
from saccade.services.perception.proposer import Proposer
from saccade.services.perception.view_encoder import ViewEncoder
from saccade.shared.model.weights import Weights
from saccade.shared.render.objects import load_mesh
from saccade.shared.world.geometry import IMAGE_SIZE_PX
from saccade.training.checkpoints import finished
from saccade.training.open.banks import BankMaker, bank_of_tiles
from saccade.training.open.comparer import ComparerTask
from saccade.training.open.composer import CropMaker
from saccade.training.open.encoder import AT_A_TIME, EncoderTask
from saccade.training.open.material import Objects, load_material
from saccade.training.open.presence import fit_presence
from saccade.training.open.proposer import ProposerTask
from saccade.training.open.table_crops import sights_of
from saccade.training.open.tables import render_tables
from saccade.training.open.tiles import load_tiles
from saccade.training.settings import TrainingConfig

JUDGED_OF = 400  # tables on which the log odds are fitted, where 6,000 are trained on
OF_EACH = 3  # views of each thing that nobody knows in the cohort


def open_task(run_dir: Path, config: TrainingConfig, part: str,
              device: torch.device) -> ProposerTask | EncoderTask | ComparerTask:
    """Creates the task of a part. Raises SaccadeError if what it needs is missing or damaged."""
    material = load_material(run_dir, config, device)
    if part == "proposer":
        return ProposerTask(config, material.tables, material.held_out, device)
    if part == "encoder":
        return EncoderTask(config, material, device)
    encoder = ViewEncoder()
    encoder.load_state_dict(finished(run_dir, config, "encoder")[1])
    return ComparerTask(config, material, encoder, device)


def judged(run_dir: Path, config: TrainingConfig,
           states: Mapping[str, Mapping[str, Tensor]]) -> tuple[Tensor, LogOdds]:
    """What the networks with these tensors judge by: the cohort's vectors [N, D], and how likely a thing is an object,
    fitted on tables to evaluate on. Raises SaccadeError if these, or a mesh, are missing or damaged."""
    networks: dict[str, Proposer | ViewEncoder | Comparison] = {
        "proposer": Proposer(), "encoder": ViewEncoder(), "comparer": Comparison()}
    for part, network in networks.items():
        network.load_state_dict(dict(states[part]))
    proposer, encoder, comparison = networks.values()
    assert isinstance(proposer, Proposer)  # as they were just made
    assert isinstance(encoder, ViewEncoder)
    assert isinstance(comparison, Comparison)
    objects, features, rng = Objects(config), LocalFeatures(), np.random.default_rng([config.seed, 17])
    meshes = [objects.mesh(name) for name in objects.scanned]
    banks = {number: bank_of_tiles(tiles, mesh, encoder, features) for number, (tiles, mesh)
             in enumerate(zip(load_tiles(run_dir / "views", objects.scanned), meshes, strict=True))}
    tables = render_tables(tuple(meshes), max(JUDGED_OF // 60, config.tables * JUDGED_OF // 6000), rng, IMAGE_SIZE_PX)
    sights = sights_of(tables, meshes, {name: number for number, name in enumerate(objects.scanned)})
    strangers = CropMaker(list(load_tiles(run_dir / "views", objects.made or objects.scanned)), torch.device("cpu"))
    which = np.repeat(np.arange(len(strangers.tiles)), OF_EACH)
    with torch.inference_mode():
        vectors = torch.cat([encoder(strangers.known(part, rng.integers(strangers.views[part])))
                             for part in np.array_split(which, -(-len(which) // AT_A_TIME))])
    model = OpenWorld(proposer, encoder, comparison, features, [], Cohort(vectors))
    return vectors, fit_presence(model, banks, tables, sights, np.random.default_rng(config.seed))


def banks_for(config: TrainingConfig, networks: Path) -> dict[str, dict[str, NDArray[Any]]]:
    """The banks of the run's objects, by the networks in a folder. Raises SaccadeError if these are missing or
    damaged, or if a mesh is missing."""
    make = BankMaker(Weights(networks))
    return {name: make(load_mesh(config.objects, name)).arrays() for name in config.names}
