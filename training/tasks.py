"""The training tasks of the default networks. A task has a module, a loss at each step, an evaluation and a picture."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from saccade.services.perception.networks import Extraction, Identity
from saccade.shared.model.generative_model import CCN
from saccade.shared.render.views import ObjectViews
from saccade.training.ccn import LAMBDA_EVERY, adapt, goal_search_errors, identity_loss, loss_l1, sample_pair
from saccade.training.crops import CropComposer
from saccade.training.extraction import extraction_errors, loss_l2
from saccade.training.frames import FrameComposer
from saccade.training.pictures import draw_ccn, draw_extraction
from saccade.training.precision import reduced_precision
from saccade.training.settings import TrainingConfig

IDENTITY_WEIGHT = 50.0  # of the identity network's loss
EVALUATED_EACH = 4  # an evaluation uses no held-out direction more often, on average

Network = TypeVar("Network", bound=nn.Module)


def evaluated(most: int, held_out: int) -> int:
    """How many images an evaluation has: at most so many, and fewer where few directions are held out."""
    return min(most, EVALUATED_EACH * held_out)


def generator_of(config: TrainingConfig, part: str, device: torch.device, *key: int) -> torch.Generator:
    """A random generator that depends only on the seed, the part and the key (for example the step)."""
    entropy = [config.seed, zlib.crc32(part.encode()), *key]
    return torch.Generator(device).manual_seed(int(np.random.SeedSequence(entropy).generate_state(1)[0]))


def on_device(module: Network, device: torch.device) -> Network:
    """Moves a module to the device, in the memory format channels-last."""
    return module.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]  # not in torch's stubs


def split(views: ObjectViews, seed: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """The indices of the directions to train on and of those to hold out: 90 % and 10 %, as in the paper."""
    order = torch.randperm(len(views.azimuth_rad), generator=torch.Generator().manual_seed(seed))
    cut = int(0.9 * len(order))
    return order[:cut].to(device), order[cut:].to(device)


class CcnTask:
    """Phase 1 for one object: the loss L1 of the CCN and the loss of the identity network, on the same crops."""

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
        """The random generator of this part for a key, see `generator_of`."""
        return generator_of(self.config, self.part, self.device, *key)

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        """The loss at a step, and its parts."""
        generator, batch = self.generator(step), self.config.batch_ccn

        def pick(count: int) -> Tensor:
            chosen = torch.randint(len(self.train_index), (count,), generator=generator, device=self.device)
            return self.train_index[chosen]

        clean = self.config.crops == "clean"
        with torch.no_grad():
            pair = sample_pair(self.composer, self.train_index, batch, generator, clean=clean)
            mixed = self.composer.compose(pick(batch // 2), generator, present=0.25)
            present = self.composer.compose(pick(batch), generator) if clean else pair.first
        with reduced_precision(self.device):
            loss, parts = loss_l1(self.ccn, pair, self.lambdas, generator)
            judge = self.module["identity"]
            assert isinstance(judge, Identity)
            identity = identity_loss(judge, present) + identity_loss(judge, mixed)
        return loss + IDENTITY_WEIGHT * identity, {**parts, "identity": float(identity.detach())}

    def after(self, step: int, smoothed: dict[str, float]) -> None:
        """Adapts the weights of the GECO constraints from time to time. `smoothed` are running means of the parts."""
        if step % LAMBDA_EVERY == 0:
            self.lambdas = adapt(self.lambdas, [smoothed["first"], smoothed["second"], smoothed["moved"]])

    def evaluate(self) -> dict[str, float]:
        """Errors of the goal direction on held-out directions: the median (radians), and shares below two limits."""
        errors = goal_search_errors(self.ccn, self.composer, self.held_out, self.generator(2 ** 31), jitter=0.4,
                                    pairs=evaluated(150, len(self.held_out)))
        return {"goal_median_rad": float(np.median(errors)), "goal_within_0.19": float((errors < 0.19).mean()),
                "goal_within_0.5": float((errors < 0.5).mean())}

    def draw(self, path: Path) -> None:
        """Saves sample pictures of held-out directions."""
        draw_ccn(path, self.ccn, sample_pair(self.composer, self.held_out, 8, self.generator(2 ** 31)))


class ExtractionTask:
    """Phase 2: the loss L2 of the extraction network, on composed camera images of all objects."""

    def __init__(self, config: TrainingConfig, views: list[ObjectViews], part: str, device: torch.device):
        torch.manual_seed(config.seed)
        self.composer = FrameComposer(views, device, config.seed)
        self.module = on_device(Extraction(len(views)), device)
        self.config, self.device = config, device
        self.lambdas: list[float] = []
        self._evaluated = evaluated(200, sum(len(split(v, config.seed, device)[1]) for v in views))

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        """The loss at a step, and its parts."""
        batch = self.composer.compose(self.config.batch_extraction, np.random.default_rng([self.config.seed, step]))
        with reduced_precision(self.device):
            return loss_l2(self.module, batch)

    def after(self, step: int, smoothed: dict[str, float]) -> None:
        """Does nothing, because this task has no weights that adapt."""

    def evaluate(self) -> dict[str, float]:
        """Errors of the network on at most 200 images that are always the same, see `errors`."""
        rng = np.random.default_rng([self.config.seed, 2 ** 31])
        return extraction_errors(self.module, self.composer.compose(self._evaluated, rng))

    def draw(self, path: Path) -> None:
        """Saves sample pictures."""
        rng = np.random.default_rng([self.config.seed, 2 ** 31])
        draw_extraction(path, self.module, self.composer.compose(6, rng))
