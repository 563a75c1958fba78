"""Trains the paper's own networks: for each object the CCN with the loss L1, then the others with L2 (equations 4, 5).

The CCN is frozen in the second phase.
"""

from __future__ import annotations

from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from saccade.services.perception.paper import PaperExtraction
from saccade.shared.model.generative_model import CCN, kl_divergence
from saccade.shared.render.views import ObjectViews
from saccade.shared.world.windows import CROP_PX
from saccade.training.ccn import loss_l1, sample_pair, wrapped
from saccade.training.extraction import HIDDEN, SEEN, errors
from saccade.training.frames import FrameBatch
from saccade.training.paper_data import CleanViews, PaperFrames
from saccade.training.pictures import draw_paper_extraction
from saccade.training.precision import reduced_precision
from saccade.training.settings import TrainingConfig
from saccade.training.tasks import CcnTask, evaluated, generator_of, on_device, split

KL_TRANSITION = 10.0  # lambda_4 in the paper's table of the optimisation
MASKING, CROPPING, IDENTIFICATION = 10.0, 10.0, 10.0  # weights of errors summed over 64 x 64 x 3, as in phase 1
SUMMED = 3 * CROP_PX ** 2
# The KL terms count after this share of the steps. Before, a crop may show nothing, which costs thousands of nats, and
# the mask network would learn to cut nothing out.
KL_FROM = 0.3
GUIDE_END = 0.3  # share of the guide's weight that is left at the end
EVALUATED = 400  # number of images in an evaluation, where there are directions enough


class PaperCcnTask(CcnTask):
    """Phase 1 for one object: the loss L1 on clean views, with every term on the whole batch."""

    def _composer(self, mine: ObjectViews, others: list[ObjectViews], device: torch.device):
        return CleanViews(mine, device)

    def _networks(self) -> dict[str, nn.Module]:
        return {"ccn": CCN("paper")}

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        """The loss at a step, and its parts."""
        generator = self.generator(step)
        pair = sample_pair(self.composer, self.train_index, self.config.batch_ccn, generator)
        with reduced_precision(self.device):
            return loss_l1(self.ccn, pair, self.lambdas, generator, kl_transition=KL_TRANSITION, halves=False)


class PaperExtractionTask:
    """Phase 2 for one object: trains the mask, spatial transformer and identity networks with the loss L2.

    `ccn` holds the tensors of the object's finished CCN, and `before` those of the networks that training goes on
    from, if it does not begin anew.
    """

    def __init__(self, config: TrainingConfig, views: list[ObjectViews], part: str, device: torch.device,
                 ccn: dict[str, Tensor], before: dict[str, Tensor] | None = None):
        torch.manual_seed(config.seed)
        name = config.object_of(part)
        mine = next(v for v in views if v.name == name)
        self.clean = CleanViews(mine, device)
        self.frames = PaperFrames(mine, [v for v in views if v.name != name], device)
        self.train_index, self.held_out = split(mine, config.seed, device)
        frozen = CCN("paper")
        nn.ModuleDict({"ccn": frozen}).load_state_dict(ccn)
        self.ccn = on_device(frozen, device).eval().requires_grad_(False)
        self.module = on_device(PaperExtraction(), device)
        if before is not None:
            self.module.load_state_dict(before)
        self.kl_from = KL_FROM if before is None else 0.0
        self.config, self.device, self.part = config, device, part
        self.lambdas: list[float] = []

    def generator(self, *key: int) -> torch.Generator:
        """The random generator of this part for a key, see `generator_of`."""
        return generator_of(self.config, self.part, self.device, *key)

    def _pick(self, index: Tensor, count: int, generator: torch.Generator) -> Tensor:
        return index[torch.randint(len(index), (count,), generator=generator, device=self.device)]

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        """The loss at a step, and its parts."""
        generator, count = self.generator(step), self.config.batch_extraction
        first, second = (self._pick(self.train_index, count, generator) for _ in range(2))
        batch, clean = self.frames.compose(second, generator), self.clean.clean(second)
        done, config = step / self.config.steps_extraction, self.config
        expected = self._expected(first, second, generator) if config.kl_extraction and done >= self.kl_from else None
        guide = config.guide_extraction * GUIDE_END ** done
        with reduced_precision(self.device):
            return loss_l2(self.module, self.ccn, batch, clean, expected, kl=config.kl_extraction, guide=guide)

    @torch.no_grad()
    def _expected(self, first: Tensor, second: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of p(p' | p, a) for the views `second` [B].

        p is drawn from the latent pose of the clean views `first` [B], a is the displacement from first to second.
        """
        mean, std = self.ccn.encoder(self.clean.clean(first))
        azimuth = wrapped(self.clean.azimuth[second] - self.clean.azimuth[first])
        displacement = torch.stack([azimuth, self.clean.elevation[second] - self.clean.elevation[first]], dim=1)
        noise = torch.randn(mean.shape, generator=generator, device=self.device)
        return self.ccn.transition(mean + std * noise, displacement)

    def after(self, step: int, smoothed: dict[str, float]) -> None:
        """Does nothing, because this task has no weights that adapt."""

    @torch.inference_mode()
    def evaluate(self) -> dict[str, float]:
        """Errors of the networks on images of held-out directions that are always the same, see `errors`."""
        generator = self.generator(2 ** 31)
        count = evaluated(EVALUATED, len(self.held_out))
        batch = self.frames.compose(self._pick(self.held_out, count, generator), generator)
        _, center, scale, _, logit = self.module(batch.image)
        return errors(logit[:, None], (center[:, None] + 1) / 2, scale.log()[:, None], batch)

    def draw(self, path: Path) -> None:
        """Saves sample pictures of held-out directions."""
        generator = self.generator(2 ** 31)
        chosen = self._pick(self.held_out, 8, generator)
        draw_paper_extraction(path, self.module, self.frames.compose(chosen, generator), self.clean.clean(chosen))


def loss_l2(network: PaperExtraction, ccn: CCN, batch: FrameBatch, clean: Tensor,
            expected: tuple[Tensor, Tensor] | None, *, kl: float, guide: float) -> tuple[Tensor, dict[str, float]]:
    """The loss L2 (paper, equation 5) and its parts: errors of masking, cropping and identification, and two KL terms.

    The KL terms compare the latent pose of the crop with the one `expected` after a displacement, and with a standard
    normal distribution; `kl` is their weight. If `expected` is None they do not count. An object that is not seen
    counts only in the errors of masking and identification. `guide` is the weight of the error of centre (in half
    images) and log scale, which is not in the paper. Squared errors are summed over pixels: with means the KL terms
    outweigh them, and the mask network learns to cut nothing out.
    """
    mask, center, scale, crop, logit = network(batch.image.contiguous(memory_format=torch.channels_last))
    visible = batch.visible[:, 0]
    seen = (visible > SEEN).float()
    clear = ((visible > SEEN) | (visible < HIDDEN)).float()

    def mean_of_seen(values: Tensor) -> Tensor:
        return (values * seen).sum() / seen.sum().clamp(min=1.0)

    masking = SUMMED * F.mse_loss(mask, batch.mask)
    cropping = mean_of_seen(((crop[:, :3].float() - clean) ** 2).sum((1, 2, 3)))
    identification = (F.binary_cross_entropy_with_logits(logit, seen, reduction="none") * clear).mean()
    error = (center - (2 * batch.center[:, 0] - 1)).abs().sum(1) + (scale.log() - batch.log_scale[:, 0]).abs()
    loss = (MASKING * masking + CROPPING * cropping + IDENTIFICATION * identification
            + guide * mean_of_seen(error))
    parts = {"mask": masking, "crop": cropping, "presence": identification}
    if expected is not None:
        mean, std = ccn.encoder(crop[:, :3])
        parts["kl"] = mean_of_seen(kl_divergence(mean, std, *expected))
        loss = loss + kl * (parts["kl"] + mean_of_seen(kl_divergence(mean, std, 0.0, 1.0)))
    return loss, {name: float(value.detach()) for name, value in parts.items()}
