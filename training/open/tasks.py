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
from saccade.services.perception.open_world import OpenWorld
from saccade.services.perception.proposer import Proposer
from saccade.services.perception.view_encoder import ViewEncoder
from saccade.shared.model.weights import Weights
from saccade.shared.render.objects import load_mesh
from saccade.training.checkpoints import finished
from saccade.training.open.banks import bank_from, bank_of_tiles
from saccade.training.open.comparer import ComparerTask
from saccade.training.open.composer import CropMaker
from saccade.training.open.encoder import AT_A_TIME, EncoderTask
from saccade.training.open.material import Objects, load_held_out, load_material
from saccade.training.open.presence import fit_presence
from saccade.training.open.proposer import ProposerTask
from saccade.training.open.tiles import load_tiles
from saccade.training.settings import TrainingConfig

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
    tables, objects = load_held_out(run_dir, config), Objects(config)
    banks = {number: bank_of_tiles(tiles, objects.mesh(tiles.name), encoder)
             for number, tiles in enumerate(tables.maker.tiles)}
    strangers = CropMaker(list(load_tiles(run_dir / "views", objects.made or objects.scanned)), torch.device("cpu"))
    rng = np.random.default_rng([config.seed, 17])
    which = np.repeat(np.arange(len(strangers.tiles)), OF_EACH)
    with torch.inference_mode():
        vectors = torch.cat([encoder(strangers.known(part, rng.integers(strangers.views[part])))
                             for part in np.array_split(which, -(-len(which) // AT_A_TIME))])
    model = OpenWorld(proposer, encoder, comparison, [], Cohort(vectors))
    return vectors, fit_presence(model, banks, tables, np.random.default_rng(config.seed))


def banks_for(config: TrainingConfig, networks: Path) -> dict[str, dict[str, NDArray[Any]]]:
    """The banks of the run's objects, by the networks in a folder. Raises SaccadeError if these are missing or
    damaged, or if a mesh is missing."""
    encoder = Weights(networks).fill(ViewEncoder(), "encoder")
    assert isinstance(encoder, ViewEncoder)  # it is what was filled
    return {name: bank_from(load_mesh(config.objects, name), encoder).arrays() for name in config.names}
