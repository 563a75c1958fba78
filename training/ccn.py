"""Phase 1: trains the CCN and the identity network of one object on the same crops.

The CCN has the loss L1 with GECO constraints (paper, section 3.2, table 8).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from saccade.services.perception.networks import Identity
from saccade.shared.model.generative_model import CCN, kl_divergence, log_density
from saccade.training.crops import CropBatch, CropComposer

TOLERANCE = 40.0  # GECO: the squared error, summed over a crop, that is accepted
LAMBDA_RANGE = (80.0, 100.0)
LAMBDA_FACTOR, LAMBDA_EVERY = 1.01, 500
KL_TRANSITION, KL_PRIOR = 50.0, 1.0


@dataclass(frozen=True)
class Pair:
    """Pairs of views of one object, with the displacement [B, 2] (azimuth, elevation; radians) from first to second."""

    first: CropBatch
    second: CropBatch
    displacement: Tensor


def wrapped(angle: Tensor) -> Tensor:
    """Brings angles (radians) into [-pi, pi). The paper's transition is trained on no others."""
    return torch.remainder(angle + torch.pi, 2 * torch.pi) - torch.pi


def sample_pair(composer: CropComposer, train_index: Tensor, batch: int, generator: torch.Generator, *,
                clean: bool = False) -> Pair:
    """Draws `batch` random pairs of the directions `train_index`: composed with clutter, or `clean` as rendered."""
    def pick() -> Tensor:
        chosen = torch.randint(len(train_index), (batch,), generator=generator, device=composer.device)
        return train_index[chosen]

    i, j = pick(), pick()
    azimuth = wrapped(composer.azimuth[j] - composer.azimuth[i])
    displacement = torch.stack([azimuth, composer.elevation[j] - composer.elevation[i]], dim=1)
    if clean:
        return Pair(composer.undisturbed(i), composer.undisturbed(j), displacement)
    return Pair(composer.compose(i, generator), composer.compose(j, generator), displacement)


def squared_error(image: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Squared error of images [B, C, H, W], summed over each crop and averaged over the batch with weights [B].

    The sum over the crop is necessary: with a mean the KL terms would outweigh the error.
    """
    per_crop = ((image.float() - target) ** 2).sum((1, 2, 3))
    return (per_crop * weight).sum() / weight.sum().clamp(min=1.0)


def loss_l1(ccn: CCN, pair: Pair, lambdas: list[float], generator: torch.Generator, *,
            kl_transition: float = KL_TRANSITION, halves: bool = True) -> tuple[Tensor, dict[str, float]]:
    """The loss L1 (paper, equation 4) and its parts.

    o_2 is compared with the decoding of its own latent pose; the paper writes o_1 there by mistake. With `halves` the
    two terms before the transition use half of the batch each: one half for o_1, the other half for o_2. The pairs are
    symmetric, so this saves a third of the decodings.
    """
    both = torch.cat([pair.first.masked, pair.second.masked]).contiguous(memory_format=torch.channels_last)
    mean, std = ccn.encoder(both)
    noise = torch.randn(mean.shape, generator=generator, device=mean.device)
    sample = mean + std * noise
    half = len(mean) // 2
    moved_mean, moved_std = ccn.transition(sample[:half], pair.displacement)
    noise = torch.randn(moved_mean.shape, generator=generator, device=mean.device)
    end, begin = (half // 2, half // 2) if halves else (half, 0)
    drawn = ccn.decoder(torch.cat([sample[:end], sample[half + begin:], moved_mean + moved_std * noise]))
    first, second, moved = drawn.split([end, half - begin, half])
    seen_1, seen_2 = (pair.first.visible > 0.3).float(), (pair.second.visible > 0.3).float()
    errors = [squared_error(first, pair.first.target[:end], seen_1[:end]),
              squared_error(second, pair.second.target[begin:], seen_2[begin:]),
              squared_error(moved, pair.second.target, seen_1 * seen_2)]
    kl_move = (kl_divergence(mean[half:], std[half:], moved_mean, moved_std) * seen_1 * seen_2).mean()
    kl_prior = (kl_divergence(mean, std, 0.0, 1.0).mean() + kl_divergence(moved_mean, moved_std, 0.0, 1.0).mean())
    loss = sum(weight * (error - TOLERANCE) for weight, error in zip(lambdas, errors, strict=True))
    loss = loss + kl_transition * kl_move + KL_PRIOR * kl_prior
    parts = dict(zip(("first", "second", "moved"), (float(e.detach()) for e in errors), strict=True))
    return loss, {**parts, "kl": float(kl_move.detach())}


def adapt(lambdas: list[float], errors: list[float]) -> list[float]:
    """GECO: raises the weights of constraints that are violated and lowers the others, within the paper's range."""
    return [float(np.clip(w * LAMBDA_FACTOR if e > TOLERANCE else w / LAMBDA_FACTOR, *LAMBDA_RANGE))
            for w, e in zip(lambdas, errors, strict=True)]


def identity_loss(identity: Identity, batch: CropBatch) -> Tensor:
    """The loss of the identity network.

    It is the binary cross entropy of the presence, plus the Gaussian negative log likelihood of the correction for the
    crops in which the object is seen.
    """
    logit, correction, log_std = identity(batch.raw.contiguous(memory_format=torch.channels_last))
    label = (batch.present & (batch.visible > 0.15)).float()
    clear = ((~batch.present) | (batch.visible > 0.3) | (batch.visible < 0.05)).float()
    presence = (F.binary_cross_entropy_with_logits(logit, label, reduction="none") * clear).mean()
    error = ((correction - batch.correction) / log_std.exp()) ** 2 / 2 + log_std
    seen = label * (batch.visible > 0.3)
    return presence + 0.3 * (error.sum(1) * seen).sum() / seen.sum().clamp(min=1.0)


@torch.inference_mode()
def goal_search_errors(ccn: CCN, composer: CropComposer, held_out: Tensor, generator: torch.Generator, *,
                       pairs: int, jitter: float = 1.0) -> np.ndarray:
    """Errors [pairs] (great circle, radians) of the goal direction that the CCN finds, for held-out directions.

    For each pair of composed crops, the transition moves the latent pose of the first crop to every cell of a grid of
    5 degrees. The cell under which the latent pose of the second crop is likeliest is the direction that was found.
    """
    def pick() -> Tensor:
        return held_out[torch.randint(len(held_out), (pairs,), generator=generator, device=composer.device)]

    i, j = pick(), pick()
    here, goal = composer.compose(i, generator, jitter=jitter), composer.compose(j, generator, jitter=jitter)
    (mean, _), (goal_mean, goal_std) = ccn.encoder(here.masked), ccn.encoder(goal.masked)
    azimuth = torch.arange(0, 2 * np.pi, np.pi / 36)
    elevation = torch.linspace(0.02, np.pi / 2 - 0.02, 18)
    grid_e, grid_a = torch.meshgrid(elevation, azimuth, indexing="ij")
    result = np.empty(pairs)
    for n in range(pairs):
        move = torch.stack([wrapped(grid_a.flatten() - composer.azimuth[i[n]].cpu()),
                            grid_e.flatten() - composer.elevation[i[n]].cpu()], dim=1).to(composer.device)
        moved_mean, moved_std = ccn.transition(mean[n].expand(len(move), -1), move)
        score = log_density(goal_mean[n], moved_mean, (moved_std ** 2 + goal_std[n] ** 2).sqrt())
        best = int(score.argmax())
        e, a = grid_e.flatten()[best], grid_a.flatten()[best]
        ge, ga = composer.elevation[j[n]].cpu(), composer.azimuth[j[n]].cpu()
        cosine = e.sin() * ge.sin() + e.cos() * ge.cos() * (a - ga).cos()
        result[n] = float(torch.arccos(cosine.clamp(-1, 1)))
    return result
