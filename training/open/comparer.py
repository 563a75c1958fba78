"""Trains the comparer: a crop beside a known view, of the same thing or of another one that the encoder finds alike."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from saccade.services.perception.comparer import Compared, Comparison
from saccade.services.perception.view_encoder import ViewEncoder
from saccade.shared.world.geometry import rotation_towards
from saccade.training.open.composer import Crops
from saccade.training.open.encoder import batch
from saccade.training.open.material import Material
from saccade.training.pictures import draw_pairs
from saccade.training.settings import TrainingConfig
from saccade.training.tasks import on_device

SAME_RAD, OTHER_RAD = 0.45, 0.9  # angles of views that count as the same, and as others
ALIKE = 0.02  # mean squared difference of views that cannot be told apart, so that neither counts as another
MARGIN_RAD = 0.35  # how far known views are from the crop's direction, at most, where they are drawn near it
OFF = 3.0  # weight of the errors of place, size and turn beside that of sameness
EVALUATED = 400


class ComparerTask:
    """Trains the comparer on pairs. Half of them show the same object from about the same direction; the others show
    what a trained encoder finds most alike among views of the batch that show something else."""

    def __init__(self, config: TrainingConfig, material: Material, encoder: ViewEncoder, device: torch.device):
        torch.manual_seed(config.seed)
        self.config, self.material, self.device = config, material, device
        self.encoder = encoder.to(device).eval()
        self.comparison = on_device(Comparison(), device)
        self.lambdas: list[float] = []

    @property
    def module(self) -> Comparison:
        """The networks."""
        return self.comparison

    def pairs(self, step: int, count: int) -> Pairs:
        """Pairs for a step."""
        rng = np.random.default_rng([self.config.seed, 2, step])
        return pairs(self.material, self.encoder, batch(self.material, count, rng), rng)

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        """The loss at a step, and its parts."""
        drawn = self.pairs(step, self.config.batch_ccn)
        with torch.autocast(self.device.type, dtype=torch.bfloat16):
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
        drawn = pairs(self.material, self.encoder, crops, rng)
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


class Pairs:
    """B pairs: crops and known views [B, 4, 64, 64]; label [B] 1 (the same), 0 (another) or NaN (cannot be said); what
    the crop is off by [B, 4], see `Crops`; turn [B, 2], see `Compared`."""

    def __init__(self, seen: Tensor, known: Tensor, label: Tensor, off: Tensor, turn: Tensor):
        self.seen, self.known, self.label, self.off, self.turn = seen, known, label, off, turn


@torch.no_grad()
def pairs(material: Material, encoder: ViewEncoder, crops: Crops, rng: np.random.Generator) -> Pairs:
    """For each crop one known view from near its direction, and one of another object or from elsewhere."""
    which = crops.object.cpu().numpy()
    direction = crops.direction.cpu().numpy().astype(np.float64)
    near, turn = [], []
    for number, towards in zip(which, direction, strict=True):
        views = material.tiles[number].directions
        angle = np.arccos(np.clip(views @ towards, -1, 1))
        chosen = int(rng.choice(np.flatnonzero(angle < max(MARGIN_RAD, 1.01 * angle.min()))))
        near.append(chosen)
        turn.append(turn_between(views[chosen], towards))
    mine = material.composed.known(which, np.array(near))
    # The others: of the batch's known views, that which is most alike by the encoder and shows something else.
    # Flat views of the crops' own directions say whether it can be told apart at all.
    similar = encoder(crops.seen) @ encoder(crops.known).T
    between = (crops.direction @ crops.direction.T).clamp(-1, 1).arccos()
    close = (crops.object[:, None] == crops.object) & (between < OTHER_RAD)
    flat = F.avg_pool2d(crops.known, 4).flatten(1)
    alike = torch.cdist(flat, flat) ** 2 / flat.shape[1] < ALIKE / 4
    noisy = similar - 9.0 * (close | alike) + 0.15 * torch.randn(similar.shape, generator=torch.Generator().manual_seed(
        int(rng.integers(2 ** 62)))).to(similar.device)
    other = noisy.argmax(1)
    nothing = torch.zeros(len(which), 2, device=crops.seen.device)
    turned = torch.tensor(np.array(turn), dtype=torch.float32, device=crops.seen.device)
    size = turned.norm(dim=1)
    label = torch.where(size < SAME_RAD, 1.0, torch.where(size > OTHER_RAD, 0.0, torch.nan))
    return Pairs(torch.cat([crops.seen, crops.seen]), torch.cat([mine, crops.known[other]]),
                 torch.cat([label, torch.zeros_like(label)]), torch.cat([crops.off, crops.off]),
                 torch.cat([turned, nothing]))


def turn_between(known: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The direction [3] `seen` from the direction `known`, as an angle to the right and one up as the camera of the
    known view sees its own motion [2] (rad)."""
    rotation = rotation_towards(-known)
    along = rotation.T @ seen
    flat = along[:2]
    length = np.linalg.norm(flat)
    return flat / max(float(length), 1e-9) * np.arctan2(length, along[2])


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
