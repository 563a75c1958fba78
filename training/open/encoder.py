"""Trains the view encoder: views that are near on the sphere around an object come near to each other, however they are
lit, hidden or cut out; views of different objects come apart.

A crop is held against the banks of all objects, as it will be later. The banks are encoded anew from time to time,
because encoding them at every step would take minutes.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from saccade.services.perception.view_encoder import ViewEncoder
from saccade.training.open.composer import Crops
from saccade.training.open.material import Material
from saccade.training.pictures import draw_pairs
from saccade.training.precision import reduced_precision
from saccade.training.settings import TrainingConfig
from saccade.training.tasks import on_device

NEAR_RAD = 0.13  # two views of one object count as the same by exp(-(angle / this)^2)
PER_OBJECT = 4  # crops of one object in a batch: two that are near each other, and others
COMPOSED = 0.6  # share of the crops that are composed; the others are cut out of rendered tables
REAL = 0.5  # share of the composed crops that show scanned objects, not groceries made by code
ANEW = 250  # steps after which the banks are encoded anew
OTHERS = 8  # a crop is held against each eighth view of the objects that are not in the batch
AT_A_TIME = 500  # views that are encoded together
SEEN = 0.25  # a crop counts if so much of its object is seen
EVALUATED = 600  # crops in an evaluation


class EncoderTask:
    """Trains the view encoder with soft targets: from crops to the banks, and in a batch to known views and back."""

    def __init__(self, config: TrainingConfig, material: Material, device: torch.device):
        torch.manual_seed(config.seed)
        self.config, self.material, self.device = config, material, device
        self.encoder = on_device(ViewEncoder(), device)
        self.lambdas: list[float] = []
        self.banks: Banks | None = None

    @property
    def module(self) -> ViewEncoder:
        """The networks."""
        return self.encoder

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        """The loss at a step, and its parts."""
        if self.banks is None or step % ANEW == 0:
            self.encoder.eval()
            self.banks = Banks(self.encoder, self.material, range(len(self.material.tiles)))
            self.encoder.train()
        rng = np.random.default_rng([self.config.seed, 1, step])
        crops = batch(self.material, self.config.batch_ccn, rng)
        with reduced_precision(self.device):
            seen, known = self.encoder(crops.seen), self.encoder(crops.known)
        sharpness = self.encoder.log_sharpness.exp()
        among, parts = contrast(seen, known, crops, sharpness)
        against, right = self.banks.against(seen, crops, sharpness)
        return among + against, {**parts, "banks": float(against.detach()), "found": right}

    def after(self, step: int, smoothed: dict[str, float]) -> None:
        """Does nothing, because this task has no weights that adapt."""

    @torch.inference_mode()
    def evaluate(self) -> dict[str, float]:
        """How often crops of held-out tables are named right among all scanned objects, and how far the direction is
        off (rad)."""
        material, rng = self.material, np.random.default_rng([self.config.seed, 2 ** 31])
        banks = Banks(self.encoder, material, material.real)
        vectors, owner, directions = banks.vectors, banks.owner, banks.directions
        named, turned = [], []
        chosen = rng.choice(len(material.held_out.sights.table), EVALUATED)
        for part in np.split(chosen, 6):
            crops = material.held_out.draw(part, rng)
            similar = self.encoder(crops.seen) @ vectors.T
            named.append(owner[similar.argmax(1)] == crops.object)
            mine = torch.where(owner == crops.object[:, None], similar, -9.0)
            turned.append((directions[mine.argmax(1)] * crops.direction).sum(1).clamp(-1, 1).arccos())
        right, angle = torch.cat(named).float().cpu(), torch.cat(turned)
        new = torch.tensor(np.isin(material.held_out.sights.object[chosen], material.held_numbers))
        fresh = {"named_new": float(right[new].mean())} if new.any() else {}
        return {"named": float(right[~new].mean()), **fresh, "turn_rad": float(angle.median()),
                "turn_within_0.2": float((angle < 0.2).float().mean()),
                "turn_within_0.5": float((angle < 0.5).float().mean())}

    @torch.inference_mode()
    def draw(self, path: Path) -> None:
        """Saves sample pictures: crops, and the known views from about there."""
        crops = batch(self.material, 16, np.random.default_rng([self.config.seed, 2 ** 31]))
        draw_pairs(path, crops.seen, crops.known)


def batch(material: Material, count: int, rng: np.random.Generator) -> Crops:
    """About `count` crops of a few objects each, composed and cut out of tables."""
    which, index = [], []
    for _ in range(round(count * COMPOSED / PER_OBJECT)):
        number = material.drawn(rng, REAL)
        directions = material.tiles[number].directions
        first = int(rng.integers(len(directions)))
        near = np.argsort(-(directions @ directions[first]))[1:1 + max(2, len(directions) // 50)]
        others = rng.integers(len(directions), size=PER_OBJECT - 2)
        which += [number] * PER_OBJECT
        index += [first, int(rng.choice(near)), *map(int, others)]
    composed = material.composed.draw(np.array(which), np.array(index), rng)
    tables = material.tables.draw(rng.integers(len(material.tables.sights.table), size=count - len(which)), rng)
    return Crops(*(torch.cat(pair) for pair in zip(vars(composed).values(), vars(tables).values(), strict=True)))


def contrast(seen: Tensor, known: Tensor, crops: Crops, sharpness: Tensor) -> tuple[Tensor, dict[str, float]]:
    """The cross entropy between similarities of vectors and what they should be, from crops to views and back."""
    angle = (crops.direction @ crops.direction.T).clamp(-1 + 1e-6, 1 - 1e-6).arccos()
    same = crops.object[:, None] == crops.object[None]
    target = torch.where(same, torch.exp(-(angle / NEAR_RAD) ** 2), 0.0)
    target.fill_diagonal_(1.0)
    logits = sharpness * (seen @ known.T)
    weight = (crops.visible > SEEN).float()
    there = -(target / target.sum(1, keepdim=True) * logits.log_softmax(1)).sum(1)
    back = -(target.T / target.T.sum(1, keepdim=True) * logits.T.log_softmax(1)).sum(1)
    loss = ((there + back) * weight).sum() / weight.sum().clamp(min=1.0)
    right = (same.gather(1, logits.argmax(1, keepdim=True))[:, 0].float() * weight).sum() / weight.sum()
    return loss, {"contrast": float(loss.detach()), "named": float(right)}


class Banks:
    """The encoded views of objects: vectors [V, D], the objects' numbers [V], the views' numbers there [V], and
    directions [V, 3]."""

    @torch.no_grad()
    def __init__(self, encoder: ViewEncoder, material: Material, numbers: Iterable[int]):
        maker = material.composed
        numbers, vectors = np.array(numbers), []
        which = np.repeat(numbers, maker.views[numbers])
        index = np.concatenate([np.arange(count) for count in maker.views[numbers]])
        for part in np.array_split(np.arange(len(which)), -(-len(which) // AT_A_TIME)):
            with reduced_precision(maker.device):
                vectors.append(encoder(maker.known(which[part], index[part])))
        self.maker, self.index = maker, index
        self.vectors, self.owner = torch.cat(vectors), torch.as_tensor(which, device=maker.device)
        self.directions = maker.directions[maker.view(which, index)]

    def views(self, chosen: Tensor) -> Tensor:
        """The known views [B, 4, 64, 64] with the numbers `chosen` [B]."""
        return self.maker.known(self.owner[chosen].cpu().numpy(), self.index[chosen.cpu().numpy()])

    def against(self, seen: Tensor, crops: Crops, sharpness: Tensor) -> tuple[Tensor, float]:
        """The cross entropy of vectors [B, D] of crops against the views of their objects and some of all others, and
        how often the likeliest is of the object."""
        mine = torch.isin(self.owner, crops.object)
        mine[int(crops.object[0]) % OTHERS::OTHERS] = True
        angle = (crops.direction @ self.directions[mine].T).clamp(-1, 1).arccos()
        same = self.owner[mine] == crops.object[:, None]
        # In units of the nearest view's angle where the views of an object are few.
        nearest = torch.where(same, angle, torch.inf).min(1, keepdim=True).values.clamp(min=NEAR_RAD)
        target = torch.where(same, torch.exp(-(angle / nearest) ** 2), 0.0)
        weight = (crops.visible > SEEN).float()
        logits = sharpness * (seen @ self.vectors[mine].T)
        each = -(target / target.sum(1, keepdim=True) * logits.log_softmax(1)).sum(1)
        right = same.gather(1, logits.argmax(1, keepdim=True))[:, 0].float()
        return (each * weight).sum() / weight.sum().clamp(min=1.0), float((right * weight).sum() / weight.sum())
