"""Trains one part (the CCN and identity network of an object, or the extraction network) in one process.

    python -m training.part RUN_DIR PART

Every step draws its randomness from (seed, part, step), so that a run that was interrupted goes on exactly.
"""

from __future__ import annotations

import json
import os
import sys
import time
import zlib
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from services.perception.networks import Extraction, Identity
from services.simulator.views import ObjectViews
from shared.errors import SaccadeError
from shared.generative_model import CCN
from training.ccn import adapt, goal_search_errors, identity_loss, loss_l1, sample_pair
from training.crops import CropComposer
from training.dataset import load_views
from training.extraction import extraction_errors, loss_l2
from training.frames import FrameComposer
from training.pictures import draw_ccn, draw_extraction
from training.settings import EXTRACTION, TrainingConfig, load_settings

IDENTITY_WEIGHT = 50.0
SMOOTHING = 0.99


def pick_device(name: str) -> torch.device:
    """The device named, or the GPU where there is one. Raises SaccadeError where the GPU asked for is absent."""
    if name == "cuda" and not torch.cuda.is_available():
        raise SaccadeError("device cuda is not there: use --device cpu, or install a driver and a CUDA build of torch")
    return torch.device("cuda" if name == "cuda" or (name == "auto" and torch.cuda.is_available()) else "cpu")


class CcnTask:
    """Phase 1 of one object: loss L1 and the identity network's loss on the same crops."""

    def __init__(self, config: TrainingConfig, views: list[ObjectViews], part: str, device: torch.device):
        torch.manual_seed(config.seed)
        mine = next(v for v in views if v.name == part)
        self.composer = CropComposer(mine, [v for v in views if v.name != part], device)
        order = torch.randperm(len(mine.azimuth_rad), generator=torch.Generator().manual_seed(config.seed))
        cut = int(0.9 * len(order))  # the paper's 90/10 split
        self.train_index, self.held_out = order[:cut].to(device), order[cut:].to(device)
        self.ccn = CCN().to(device, memory_format=torch.channels_last)
        self.identity = Identity().to(device, memory_format=torch.channels_last)
        self.module = nn.ModuleDict({"ccn": self.ccn, "identity": self.identity})
        self.config, self.device, self.lambdas, self.part = config, device, [80.0] * 3, part

    def generator(self, *key: int) -> torch.Generator:
        entropy = [self.config.seed, zlib.crc32(self.part.encode()), *key]
        return torch.Generator(self.device).manual_seed(int(np.random.SeedSequence(entropy).generate_state(1)[0]))

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        generator, batch = self.generator(step), self.config.batch_ccn
        with torch.no_grad():
            pair = sample_pair(self.composer, self.train_index, batch, generator)
            chosen = torch.randint(len(self.train_index), (batch // 2,), generator=generator, device=self.device)
            mixed = self.composer.compose(self.train_index[chosen], generator, present=0.25)
        with torch.autocast(self.device.type, dtype=torch.bfloat16):
            loss, parts = loss_l1(self.ccn, pair, self.lambdas, generator)
            identity = identity_loss(self.identity, pair.first) + identity_loss(self.identity, mixed)
        return loss + IDENTITY_WEIGHT * identity, {**parts, "identity": float(identity.detach())}

    def after(self, step: int, smoothed: dict[str, float]) -> None:
        if step % 500 == 0:
            self.lambdas = adapt(self.lambdas, [smoothed["first"], smoothed["second"], smoothed["moved"]])

    def evaluate(self) -> dict[str, float]:
        errors = goal_search_errors(self.ccn, self.composer, self.held_out, self.generator(2 ** 31), jitter=0.4)
        return {"goal_median_rad": float(np.median(errors)), "goal_within_0.19": float((errors < 0.19).mean()),
                "goal_within_0.5": float((errors < 0.5).mean())}

    def draw(self, path: Path) -> None:
        draw_ccn(path, self.ccn, sample_pair(self.composer, self.held_out, 8, self.generator(2 ** 31)))


class ExtractionTask:
    """Phase 2: loss L2 on composed camera images of all objects."""

    def __init__(self, config: TrainingConfig, views: list[ObjectViews], part: str, device: torch.device):
        torch.manual_seed(config.seed)
        self.composer = FrameComposer(views, device)
        self.module = Extraction(len(views)).to(device, memory_format=torch.channels_last)
        self.config, self.device, self.lambdas = config, device, []

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        batch = self.composer.compose(self.config.batch_extraction, np.random.default_rng([self.config.seed, step]))
        with torch.autocast(self.device.type, dtype=torch.bfloat16):
            return loss_l2(self.module, batch)

    def after(self, step: int, smoothed: dict[str, float]) -> None:
        """Nothing adapts."""

    def evaluate(self) -> dict[str, float]:
        rng = np.random.default_rng([self.config.seed, 2 ** 31])
        return extraction_errors(self.module, self.composer.compose(200, rng))

    def draw(self, path: Path) -> None:
        rng = np.random.default_rng([self.config.seed, 2 ** 31])
        draw_extraction(path, self.module, self.composer.compose(6, rng))


def rate_at(step: int, steps: int, peak: float) -> float:
    """Warm-up over 100 steps, then a cosine to 2 % of the peak."""
    return peak * min(1.0, (step + 1) / 100) * (0.02 + 0.98 * 0.5 * (1 + np.cos(np.pi * step / steps)))


class Trainer:
    """The loop: steps, checkpoints, losses, pictures. Its folder is `RUN_DIR/PART`."""

    def __init__(self, run_dir: Path, part: str):
        self.config, self.folder, self.part = load_settings(run_dir), run_dir / part, part
        self.folder.mkdir(exist_ok=True)
        device = pick_device(self.config.device)
        views = [load_views(run_dir, name) for name in self.config.names]
        task_type = ExtractionTask if part == EXTRACTION else CcnTask
        self.task = task_type(self.config, views, part, device)
        peak = self.config.rate_extraction if part == EXTRACTION else self.config.rate_ccn
        self.peak, self.steps, self.clip = peak, self.config.steps(part), 5.0 if part == EXTRACTION else 5000.0
        self.optimizer = torch.optim.Adam(self.task.module.parameters(), lr=peak, amsgrad=True)
        self.step, self.seconds, self.smoothed = 0, 0.0, {}
        self.resume()

    def train(self) -> None:
        started, before = time.monotonic(), self.seconds
        while self.step < self.steps:
            for group in self.optimizer.param_groups:
                group["lr"] = rate_at(self.step, self.steps, self.peak)
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
        state = {"step": self.step, "steps": self.steps, "seconds": round(self.seconds, 1),
                 **{k: round(v, 4) for k, v in self.smoothed.items()}, **{k: round(v, 4) for k, v in measured.items()}}
        (self.folder / "progress.json").write_text(json.dumps(state))
        if measured:
            with (self.folder / "losses.jsonl").open("a") as file:
                file.write(json.dumps(state) + "\n")

    def checkpoint(self) -> None:
        """Model, optimiser and counters, replaced in one move, so that an interruption leaves the old or the new."""
        tensors = {f"model.{k}": v.contiguous() for k, v in self.task.module.state_dict().items()}
        for n, state in self.optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{n}.{k}": torch.as_tensor(v).contiguous() for k, v in state.items()}
        facts = {"step": self.step, "seconds": self.seconds, "lambdas": self.task.lambdas, "smoothed": self.smoothed}
        temporary = self.folder / "checkpoint.tmp"
        save_file(tensors, temporary, metadata={"facts": json.dumps(facts)})
        os.replace(temporary, self.folder / "checkpoint.safetensors")
        self.task.module.eval()
        self.report(self.task.evaluate())
        self.task.draw(self.folder / "samples.png")
        self.task.module.train()

    def resume(self) -> None:
        path = self.folder / "checkpoint.safetensors"
        if not path.is_file():
            return
        facts, tensors = read_checkpoint(path)
        model = {k.removeprefix("model."): v for k, v in tensors.items() if k.startswith("model.")}
        self.task.module.load_state_dict(model)
        states: dict[int, dict[str, Tensor]] = {}
        for key, value in tensors.items():
            if key.startswith("optimizer."):
                _, number, name = key.split(".")
                states.setdefault(int(number), {})[name] = value
        current = self.optimizer.state_dict()
        self.optimizer.load_state_dict({"state": states, "param_groups": current["param_groups"]})
        self.step, self.seconds, self.smoothed = facts["step"], facts["seconds"], facts["smoothed"]
        self.task.lambdas = facts["lambdas"]


def read_checkpoint(path: Path) -> tuple[dict, dict[str, Tensor]]:
    """Facts and tensors of a checkpoint. Raises SaccadeError where it is damaged."""
    from safetensors import safe_open

    try:
        with safe_open(path, "pt") as file:
            facts = json.loads(file.metadata()["facts"])
        return facts, load_file(path)
    except Exception as error:  # safetensors raises its own class for every kind of damage
        raise SaccadeError(f"checkpoint {path} is damaged ({error}): remove it to train this part anew") from error


def main() -> int:
    """The process. Exit code 2 and one line for what the user can mend."""
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    try:
        Trainer(Path(sys.argv[1]), sys.argv[2]).train()
    except SaccadeError as error:
        print(f"saccade: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
