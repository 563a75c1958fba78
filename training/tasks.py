"""What there is to train: each task has a module, its loss at a step, its measures and its picture."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from saccade.services.perception.networks import Extraction, Identity
from saccade.services.simulator.views import ObjectViews
from saccade.shared.model.generative_model import CCN
from saccade.training.ccn import LAMBDA_EVERY, adapt, goal_search_errors, identity_loss, loss_l1, sample_pair
from saccade.training.crops import CropComposer
from saccade.training.extraction import extraction_errors, loss_l2
from saccade.training.frames import FrameComposer
from saccade.training.pictures import draw_ccn, draw_extraction
from saccade.training.settings import TrainingConfig

IDENTITY_WEIGHT = 50.0

Network = TypeVar("Network", bound=nn.Module)


def generator_of(config: TrainingConfig, part: str, device: torch.device, *key: int) -> torch.Generator:
    """Randomness that depends on the seed, the part and the key (such as the step) alone."""
    entropy = [config.seed, zlib.crc32(part.encode()), *key]
    return torch.Generator(device).manual_seed(int(np.random.SeedSequence(entropy).generate_state(1)[0]))


def on_device(module: Network, device: torch.device) -> Network:
    """The module there, its channels last."""
    return module.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]  # not in torch's stubs


def split(views: ObjectViews, seed: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Directions to train on and to hold out: the paper's 90/10 split."""
    order = torch.randperm(len(views.azimuth_rad), generator=torch.Generator().manual_seed(seed))
    cut = int(0.9 * len(order))
    return order[:cut].to(device), order[cut:].to(device)


class CcnTask:
    """Phase 1 of one object: loss L1 and the identity network's loss on the same crops."""

    def __init__(self, config: TrainingConfig, views: list[ObjectViews], part: str, device: torch.device):
        torch.manual_seed(config.seed)
        self.config = config
        mine = next(v for v in views if v.name == part)
        self.composer = self._composer(mine, [v for v in views if v.name != part], device)
        self.train_index, self.held_out = split(mine, config.seed, device)
        self.module = on_device(nn.ModuleDict(self._networks()), device)
        ccn = self.module["ccn"]
        assert isinstance(ccn, CCN)
        self.ccn = ccn
        self.device, self.lambdas, self.part = device, [80.0] * 3, part

    def _composer(self, mine: ObjectViews, others: list[ObjectViews], device: torch.device):
        return CropComposer(mine, others, device, self.config.seed)

    def _networks(self) -> dict[str, nn.Module]:
        return {"ccn": CCN(), "identity": Identity()}

    def generator(self, *key: int) -> torch.Generator:
        return generator_of(self.config, self.part, self.device, *key)

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        generator, batch = self.generator(step), self.config.batch_ccn

        def pick(count: int) -> Tensor:
            chosen = torch.randint(len(self.train_index), (count,), generator=generator, device=self.device)
            return self.train_index[chosen]

        clean = self.config.crops == "clean"
        with torch.no_grad():
            pair = sample_pair(self.composer, self.train_index, batch, generator, clean=clean)
            mixed = self.composer.compose(pick(batch // 2), generator, present=0.25)
            present = self.composer.compose(pick(batch), generator) if clean else pair.first
        with torch.autocast(self.device.type, dtype=torch.bfloat16):
            loss, parts = loss_l1(self.ccn, pair, self.lambdas, generator)
            judge = self.module["identity"]
            assert isinstance(judge, Identity)
            identity = identity_loss(judge, present) + identity_loss(judge, mixed)
        return loss + IDENTITY_WEIGHT * identity, {**parts, "identity": float(identity.detach())}

    def after(self, step: int, smoothed: dict[str, float]) -> None:
        if step % LAMBDA_EVERY == 0:
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
        self.composer = FrameComposer(views, device, config.seed)
        self.module = on_device(Extraction(len(views)), device)
        self.config, self.device = config, device
        self.lambdas: list[float] = []

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
