"""Trains one part of a run in one process: the CCN and identity network of an object, or the extraction network.

    python -m saccade.training.part RUN_DIR PART

The randomness of every step depends on (seed, part, step) only. So a run that was interrupted continues exactly as it
would have without the interruption.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor, nn

from saccade.shared.errors import SaccadeError
from saccade.shared.files import append_line, replace_whole, writing
from saccade.shared.log.provenance import commit
from saccade.training.checkpoints import CHECKPOINT, ccn_of, extraction_before, model_of, read_checkpoint, step_of
from saccade.training.dataset import load_views
from saccade.training.paper import PaperCcnTask, PaperExtractionTask
from saccade.training.settings import TrainingConfig, load_settings
from saccade.training.tasks import CcnTask, ExtractionTask

SMOOTHING = 0.99  # of the running mean of the losses


class Task(Protocol):
    """What is trained: networks, and what they learn at each step."""

    lambdas: list[float]  # weights of the loss that adapt; they are kept in checkpoints

    @property
    def module(self) -> nn.Module:
        """The networks."""

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        """The loss at a step, and its parts."""

    def after(self, step: int, smoothed: dict[str, float]) -> None:
        """Is called after a step. `smoothed` are running means of the parts."""

    def evaluate(self) -> dict[str, float]:
        """Measures of the networks on data that they are not trained on."""

    def draw(self, path: Path) -> None:
        """Saves sample pictures."""


def pick_device(name: str) -> torch.device:
    """The device that is named (`cpu`, `cuda`). `auto` means the GPU if there is one, otherwise the CPU.

    Raises SaccadeError if `cuda` is named and there is no GPU.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise SaccadeError("device cuda is not there: use --device cpu, or install a driver and a CUDA build of torch")
    return torch.device("cuda" if name == "cuda" or (name == "auto" and torch.cuda.is_available()) else "cpu")


def rate_at(step: int, steps: int, peak: float) -> float:
    """The learning rate at a step: it rises over 100 steps, and falls with a cosine to 2 % of the peak."""
    return peak * min(1.0, (step + 1) / 100) * (0.02 + 0.98 * 0.5 * (1 + np.cos(np.pi * step / steps)))


def constant_rate(step: int, steps: int, peak: float) -> float:
    """The constant learning rate of the paper's CCNs."""
    return peak


def task_of(run_dir: Path, config: TrainingConfig, part: str, device: torch.device) -> Task:
    """Creates the training task of a part, for the architecture of the run.

    Raises SaccadeError if the views are missing or damaged, or if the part needs a CCN that is not finished.
    """
    if config.architecture == "posecnn":
        from saccade.training.posecnn import PoseCnnTask  # here, because it loads the simulator

        return PoseCnnTask(config, device, extraction_before(config, part))
    if config.architecture == "lexa":
        from saccade.training.lexa.task import LexaTask

        return LexaTask(config, part, device, run_dir / part, step_of(run_dir / part / CHECKPOINT))
    if config.architecture == "open":
        from saccade.training.open.tasks import open_task

        return open_task(run_dir, config, part, device)
    views = [load_views(run_dir, name) for name in config.names]
    extraction = config.is_extraction(part)
    if config.architecture == "default":
        return (ExtractionTask if extraction else CcnTask)(config, views, part, device)
    if not extraction:
        return PaperCcnTask(config, views, part, device)
    _, ccn = ccn_of(run_dir, config, config.object_of(part))
    return PaperExtractionTask(config, views, part, device, ccn, extraction_before(config, part))


class Trainer:
    """The training loop of a part. It writes checkpoints, losses and pictures into the folder `RUN_DIR/PART`.

    If the folder has a checkpoint, training continues from it. Raises SaccadeError if the settings, the views or the
    checkpoint are missing or damaged, or if the device is not available.
    """

    def __init__(self, run_dir: Path, part: str):
        self.config, self.folder, self.part = load_settings(run_dir), run_dir / part, part
        with writing(self.folder, "training run"):
            self.folder.mkdir(exist_ok=True)
        device = pick_device(self.config.device)
        self.task = task_of(run_dir, self.config, part, device)
        extraction, paper = self.config.is_extraction(part), self.config.architecture == "paper"
        self.peak = self.config.rate_extraction if extraction else self.config.rate_ccn
        self.rate_at = constant_rate if paper and not extraction else rate_at
        self.steps, self.clip = self.config.steps(part), 5.0 if extraction and not paper else 5000.0
        self.optimizer = torch.optim.Adam(self.task.module.parameters(), lr=self.peak,
                                          amsgrad=not (paper and extraction))
        self.step, self.seconds, self.commit = 0, 0.0, commit()
        self.smoothed: dict[str, float] = {}
        self.resume()

    def train(self) -> None:
        """Trains until the last step. Raises SaccadeError if the loss is not finite."""
        started, before = time.monotonic(), self.seconds
        while self.step < self.steps:
            for group in self.optimizer.param_groups:
                group["lr"] = self.rate_at(self.step, self.steps, self.peak)
            loss, parts = self.task.loss(self.step)
            if not torch.isfinite(loss):
                raise SaccadeError(f"{self.part}: the loss is not finite at step {self.step}: lower the learning rate")
            self.optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(self.task.module.parameters(), self.clip)
            self.optimizer.step()
            self.step += 1
            for key, value in parts.items():
                self.smoothed[key] = SMOOTHING * self.smoothed.get(key, value) + (1 - SMOOTHING) * value
            self.task.after(self.step, self.smoothed)
            self.seconds = before + time.monotonic() - started
            if self.step % 20 == 0:
                self.report({})
            if self.step % self.config.checkpoint_every == 0 or self.step == self.steps:
                self.checkpoint()

    def report(self, measured: dict[str, float]) -> None:
        """Writes the progress and, if there are `measured` values, one line of losses.jsonl."""
        state = {"step": self.step, "steps": self.steps, "seconds": round(self.seconds, 1),
                 **{k: round(v, 4) for k, v in self.smoothed.items()}, **{k: round(v, 4) for k, v in measured.items()}}
        with writing(self.folder, "progress"):
            replace_whole(self.folder / "progress.json", json.dumps(state).encode())
            if measured:
                append_line(self.folder / "losses.jsonl", json.dumps(state))

    def checkpoint(self) -> None:
        """Saves networks, optimiser and counters, then evaluates and draws samples.

        The file is replaced in one operation, so that after an interruption either the old or the new one exists.
        """
        tensors = {f"model.{k}": v.contiguous() for k, v in self.task.module.state_dict().items()}
        for n, state in self.optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{n}.{k}": torch.as_tensor(v).contiguous() for k, v in state.items()}
        facts = {"step": self.step, "seconds": self.seconds, "lambdas": self.task.lambdas, "smoothed": self.smoothed,
                 "commit": self.commit}
        temporary = self.folder / "checkpoint.tmp"
        try:
            save_file(tensors, temporary, metadata={"facts": json.dumps(facts)})
            os.replace(temporary, self.folder / CHECKPOINT)
        except (OSError, SafetensorError) as error:
            temporary.unlink(missing_ok=True)
            raise SaccadeError(f"checkpoint {self.folder / CHECKPOINT} cannot be written ({error}), the last one "
                               "stays: free some space, and give the same command again") from error
        self.task.module.eval()
        self.report(self.task.evaluate())
        with writing(self.folder / "samples.png", "picture"):
            self.task.draw(self.folder / "samples.png")
        self.task.module.train()

    def resume(self) -> None:
        """Continues from the checkpoint, if there is one. Raises SaccadeError if it is damaged."""
        path = self.folder / CHECKPOINT
        if not path.is_file():
            return
        facts, tensors = read_checkpoint(path)
        self.task.module.load_state_dict(model_of(tensors))
        states: dict[int, dict[str, Tensor]] = {}
        for key, value in tensors.items():
            if key.startswith("optimizer."):
                _, number, name = key.split(".")
                states.setdefault(int(number), {})[name] = value
        current = self.optimizer.state_dict()
        self.optimizer.load_state_dict({"state": states, "param_groups": current["param_groups"]})
        self.step, self.seconds, self.smoothed = facts["step"], facts["seconds"], facts["smoothed"]
        self.task.lambdas = facts["lambdas"]


def main() -> int:
    """Runs the process. For an error that the user can correct it prints one line and returns the exit code 2."""
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    try:
        Trainer(Path(sys.argv[1]), sys.argv[2]).train()
    except SaccadeError as error:
        print(f"saccade: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
