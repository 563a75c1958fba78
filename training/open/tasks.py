"""The training tasks of the networks that know no object by name, and what is written when they are done."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray

from saccade.services.perception.view_encoder import ViewEncoder
from saccade.shared.model.weights import Weights
from saccade.shared.render.objects import load_mesh
from saccade.training.checkpoints import finished
from saccade.training.open.banks import bank_from
from saccade.training.open.comparer import ComparerTask
from saccade.training.open.encoder import EncoderTask
from saccade.training.open.material import load_material
from saccade.training.open.proposer import ProposerTask
from saccade.training.settings import TrainingConfig


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


def banks_for(config: TrainingConfig, networks: Path) -> dict[str, dict[str, NDArray[Any]]]:
    """The banks of the run's objects, by the networks in a folder. Raises SaccadeError if these are missing or
    damaged, or if a mesh is missing."""
    encoder = Weights(networks).fill(ViewEncoder(), "encoder")
    assert isinstance(encoder, ViewEncoder)  # it is what was filled
    return {name: bank_from(load_mesh(config.objects, name), encoder).arrays() for name in config.names}
