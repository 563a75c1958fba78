"""A training run that is cut off and taken up again."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from saccade.training.part import Trainer


def interrupt_and_resume(run_dir: Path, part: str, *, before_step: int) -> None:
    """Trains a part up to a step, as Ctrl-C would end it, and then to its end in a new trainer."""
    first = Trainer(run_dir, part)
    loss = first.task.loss

    def interrupted(step: int):
        if step == before_step:
            raise KeyboardInterrupt
        return loss(step)

    first.task.loss = interrupted
    with pytest.raises(KeyboardInterrupt):
        first.train()
    Trainer(run_dir, part).train()


def assert_same_checkpoint(whole_run: Path, resumed_run: Path, part: str) -> None:
    """Every tensor of the two runs' last checkpoints is equal, to the bit."""
    whole, resumed = (load_file(folder / part / "checkpoint.safetensors") for folder in (whole_run, resumed_run))
    assert whole.keys() == resumed.keys()
    for key, value in whole.items():
        assert torch.equal(value, resumed[key]), key
