"""Trains the comparer: a crop beside a known view, of the same thing or of another one that the encoder finds alike."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from saccade.services.perception.comparer import Compared, Comparison
from saccade.services.perception.cropping import warp
from saccade.services.perception.view_encoder import ViewEncoder
from saccade.shared.world.geometry import rotation_towards
from saccade.training.open.composer import Crops
from saccade.training.open.encoder import Banks, batch
from saccade.training.open.material import Material
from saccade.training.pictures import draw_pairs
from saccade.training.precision import reduced_precision
from saccade.training.settings import TrainingConfig
from saccade.training.tasks import on_device

AMONG = 4000  # views of the banks of which the most alike is drawn
NONE = 4  # for so many crops one pair with nothing, and one with a part
SAME_RAD, OTHER_RAD = 0.45, 0.9  # angles of views that count as the same, and as others
ALIKE = 0.005  # mean squared difference of views that cannot be told apart, so that neither counts as another
MARGIN_RAD = 0.35  # how far known views are from the crop's direction, at most, where they are drawn near it
OFF = 3.0  # weight of the errors of place, size and turn beside that of sameness
EVALUATED = 400


class ComparerTask:
    """Trains the comparer on pairs: the same object from about the same direction; what a trained encoder finds most
    alike among known views of something else; and nothing, or a part, beside what it might be taken for."""

    def __init__(self, config: TrainingConfig, material: Material, encoder: ViewEncoder, device: torch.device):
        torch.manual_seed(config.seed)
        self.config, self.material, self.device = config, material, device
        self.encoder = encoder.to(device).eval()
        self.comparison = on_device(Comparison(), device)
        self.lambdas: list[float] = []
        self.banks = Banks(self.encoder, material, range(len(material.tiles)))
        real = torch.isin(self.banks.owner, torch.as_tensor(material.real, device=device))
        self.all, self.scanned = torch.arange(len(real), device=device), real.nonzero()[:, 0]

    @property
    def module(self) -> Comparison:
        """The networks."""
        return self.comparison

    def pairs(self, step: int, count: int) -> Pairs:
        """Pairs for a step."""
        rng = np.random.default_rng([self.config.seed, 2, step])
        return pairs(self.material, self.encoder, self.banks, self.all, batch(self.material, count, rng), rng)

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        """The loss at a step, and its parts."""
        drawn = self.pairs(step, self.config.batch_ccn)
        with reduced_precision(self.device):
            compared = Compared(self.comparison(drawn.seen, drawn.known))
        return comparing(compared, drawn)

    def after(self, step: int, smoothed: dict[str, float]) -> None:
        """Does nothing, because this task has no weights that adapt."""

    @torch.inference_mode()
    def evaluate(self) -> dict[str, float]:
        """On held-out tables: how often same and other are told apart, and the median errors where it is the same."""
        rng = np.random.default_rng([self.config.seed, 2 ** 31])
        held = self.material.held_out
        crops = held.draw(rng.choice(len(held.sights.table), EVALUATED), rng)
        drawn = pairs(self.material, self.encoder, self.banks, self.scanned, crops, rng)
        compared = Compared(self.comparison(drawn.seen, drawn.known))
        same, other = drawn.label > 0.5, drawn.label < 0.5
        found = torch.cat([compared.shift, compared.log_ratio[:, None]], 1)
        error = (found - drawn.off[:, :3]).abs()[same]
        return {"same_right": float((compared.same[same] > 0).float().mean()),
                "other_right": float((compared.same[other] < 0).float().mean()),
                "shift": float(error[:, :2].median()), "log_ratio": float(error[:, 2].median()),
                "turn_rad": float((compared.turn - drawn.turn).norm(dim=1)[same].median())}

    @torch.inference_mode()
    def draw(self, path: Path) -> None:
        """Saves sample pictures of pairs."""
        drawn = self.pairs(2 ** 31, 16)
        draw_pairs(path, drawn.seen, drawn.known)


@dataclass(frozen=True)
class Pairs:
    """B pairs: crops and known views [B, 4, 64, 64]; label [B] 1 (the same), 0 (another) or NaN (cannot be said); what
    the crop is off by [B, 4], see `Crops`; turn [B, 2], see `Compared`."""

    seen: Tensor
    known: Tensor
    label: Tensor
    off: Tensor
    turn: Tensor


@torch.no_grad()
def pairs(material: Material, encoder: ViewEncoder, banks: Banks, among: Tensor, crops: Crops,
          rng: np.random.Generator) -> Pairs:
    """For each of B crops a known view from near its direction, and the one of another object or from elsewhere that
    the encoder finds most alike; then pairs that show no thing, or a wrong part of one. `among` are the numbers of
    the banks' views that may be drawn."""
    maker, device, count = material.composed, crops.seen.device, len(crops.seen)
    generator = torch.Generator(device).manual_seed(int(rng.integers(2 ** 62)))
    which = crops.object.cpu().numpy()
    angle = maker.angles(which, crops.direction)
    near = angle <= (1.01 * angle.min(1, keepdim=True).values).clamp(min=MARGIN_RAD)
    index = (near * torch.rand(near.shape, generator=generator, device=device)).argmax(1).cpu().numpy()
    mine = maker.known(which, index)
    turn = turn_between(*(each.cpu().double().numpy() for each in
                          (maker.directions[maker.view(which, index)], crops.direction)))
    turned = torch.tensor(turn, dtype=torch.float32, device=device)
    size = turned.norm(dim=1)
    same = torch.where(size < SAME_RAD, 1.0, torch.where(size > OTHER_RAD, 0.0, torch.nan))

    some = among[torch.randperm(len(among), generator=generator, device=device)[:AMONG]]
    close = (banks.owner[some] == crops.object[:, None]) \
        & ((crops.direction @ banks.directions[some].T).clamp(-1, 1).arccos() < OTHER_RAD)
    other = banks.views(some[_similar(encoder, crops.seen, banks.vectors[some]).masked_fill(close, -9.0).argmax(1)])
    # Flat views of the same directions say whether the two can be told apart at all.
    alike = F.avg_pool2d((crops.known - other) ** 2, 4).flatten(1).mean(1) < ALIKE
    few = count // NONE
    nothing = maker.nothing(few, rng)
    for_nothing = banks.views(some[_similar(encoder, nothing, banks.vectors[some]).argmax(1)])
    parts = misplaced(crops.seen[:few], generator)
    none = torch.zeros(2 * few, device=device)
    return Pairs(torch.cat([crops.seen, crops.seen, nothing, parts]), torch.cat([mine, other, for_nothing, mine[:few]]),
                 torch.cat([same, torch.where(alike, torch.nan, 0.0), none]),
                 torch.cat([crops.off, crops.off, torch.zeros(2 * few, 4, device=device)]),
                 torch.cat([turned, torch.zeros(count + 2 * few, 2, device=device)]))


def _similar(encoder: ViewEncoder, crops: Tensor, vectors: Tensor) -> Tensor:
    with reduced_precision(crops.device):
        seen = encoder(crops)
    return seen @ vectors.T


def misplaced(crops: Tensor, generator: torch.Generator) -> Tensor:
    """Crops [B, 4, 64, 64] whose circle lies around a part of the thing."""
    count = len(crops)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, device=crops.device)

    larger = 1.7 + 1.3 * uniform(count)
    away = (uniform(count, 2) * 2 - 1) * (0.8 * (larger - 1))[:, None]
    return warp(crops, away, larger, torch.zeros_like(larger))


def turn_between(known: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The directions [..., 3] `seen` from the directions `known`, as an angle to the right and one up as the cameras of
    the known views see their own motion [..., 2] (rad)."""
    along = np.einsum("...ji,...j->...i", rotation_towards(-known), seen)
    length = np.linalg.norm(along[..., :2], axis=-1, keepdims=True)
    return along[..., :2] / np.maximum(length, 1e-9) * np.arctan2(length, along[..., 2:])


def comparing(compared: Compared, drawn: Pairs) -> tuple[Tensor, dict[str, float]]:
    """The cross entropy of sameness, and the negative log likelihood (Laplace) of what is off where it is the same."""
    said = ~drawn.label.isnan()
    same = F.binary_cross_entropy_with_logits(compared.same[said], drawn.label[said])
    mine = said & (drawn.label > 0.5)
    log_std = compared.log_std[mine]
    errors = torch.stack([(compared.shift - drawn.off[:, :2]).abs().mean(1),
                          (compared.log_ratio - drawn.off[:, 2]).abs(), (compared.turn - drawn.turn).abs().mean(1),
                          (compared.roll - drawn.off[:, 3]).abs()], 1)[mine]
    off = (errors * torch.exp(-log_std) + log_std).sum(1).mean()
    parts = {"same": float(same.detach()), "off": float(off.detach()), "turn": float(errors[:, 2].mean().detach()),
             "shift": float(errors[:, 0].mean().detach()), "ratio": float(errors[:, 1].mean().detach())}
    return same + off / OFF / 4, parts
