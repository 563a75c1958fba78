"""Networks that know no object by name: things are proposed, encoded, and compared with the banks of known objects.

What is known of an object is its bank. So a new object needs no training, a thing that is in no bank is a stranger, and
symmetry shows as views that are alike. The weights hold three networks for all objects and a bank for each; their
manifest says "architecture": "open".
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from saccade.services.perception.comparer import Compared, Comparison
from saccade.services.perception.cropping import Cropper, warp
from saccade.services.perception.likeness import COHORT, USUAL, Cohort, LogOdds
from saccade.services.perception.proposer import Proposals, Proposer, half_tangent, propose
from saccade.services.perception.seen import Modes, Seen, bits
from saccade.services.perception.view_encoder import ViewEncoder
from saccade.shared.model.bank import FILLED, Bank, bank_in
from saccade.shared.model.weights import Weights
from saccade.shared.world.geometry import REFERENCE_RANGE_M, pixel_rays, pose, project, rotation_towards, unit
from saccade.shared.world.windows import Window, upright

INPUT_PX = 448  # the longer side of the image that the proposer sees
GRAIN_PX = 16  # its sides are multiples of this
MODES = 24  # likeliest views of an object that are told
APART_RAD = 0.6  # views farther apart than this are compared separately
CANDIDATES = 2  # things that are compared with each object, and views of each object that are compared with a thing
CAP_RAD = 0.35  # views within this of a compared one are told as one, where the comparison says
VIEW_STD_RAD = 0.12  # of a direction that is told by a view alone: about half of the way to the next one
MASK_PX = 60
SHARPNESS = 20.0  # of the similarities, where it is told how an object is turned
ROLLS_RAD = 2 * np.pi / 8 * np.arange(8)  # in which a thing is tried that is like nothing as it stands

Array = NDArray[np.float64]
NOT_SEEN = Modes(np.eye(3)[None], np.zeros(1), np.full(1, np.pi))


def open_world_of(weights: Weights, names: tuple[str, ...]) -> OpenWorld:
    """The networks and the banks of these objects. Raises SaccadeError if the weights lack one of them, are damaged, or
    are of another architecture."""
    weights.cards_of(names)
    shared, banks = weights.networks, [bank_in(weights, name) for name in names]
    networks = [shared.fill(module, stem) for module, stem in (
        (Proposer(), "proposer"), (ViewEncoder(), "encoder"), (Comparison(), "comparer"))]
    proposer, encoder, comparison = networks
    assert isinstance(proposer, Proposer)  # they are what was filled
    assert isinstance(encoder, ViewEncoder)
    assert isinstance(comparison, Comparison)
    fitted = {key: value for key, value in shared.calibration.items() if key in LogOdds.__annotations__}
    cohort = Cohort(torch.from_numpy(shared.state(COHORT)["vectors"]))
    return OpenWorld(proposer, encoder, comparison, banks, cohort, LogOdds(**fitted))


@dataclass(frozen=True)
class Things:
    """P things that were proposed: their crops with masks [P, 4, 64, 64] and the windows of these, and their masks in
    the image [P, h, w]. The crops are rolled by the angles `roll` [P] (rad)."""

    crops: Tensor
    window: Window
    masks: Tensor
    roll: Array


@dataclass(frozen=True)
class Match:
    """An object found in a thing: the number of the thing, the probability, the view of its bank that was compared, and
    the row of the comparison."""

    thing: int
    presence: float
    view: int
    row: int


class OpenWorld:
    """The networks, with the banks of K objects."""

    square = False  # an image may have any sides

    def __init__(self, proposer: Proposer, encoder: ViewEncoder, comparison: Comparison, banks: list[Bank],
                 cohort: Cohort, log_odds: LogOdds = USUAL):
        self.proposer, self.encoder, self.comparison = proposer.eval(), encoder.eval(), comparison.eval()
        self.banks, self.log_odds = banks, log_odds
        self.vectors = [torch.from_numpy(bank.vectors) for bank in banks]
        self.cohort = cohort
        self.likest = [cohort.likest(vectors) for vectors in self.vectors]

    @torch.inference_mode()
    def see(self, rgb: NDArray[np.uint8], intrinsics_px: ArrayLike, up: ArrayLike,
            depth_m: NDArray[np.float32] | None = None) -> Seen:
        """Infers all objects from an image [H, W, 3]. `up` [3] is the direction of up in the camera's frame. The depth
        is not used."""
        things = self.things(rgb, intrinsics_px, up)
        count = len(self.banks)
        seen = _nothing(count, rgb.shape)
        if not len(things.crops):
            return seen
        things, similar = self.rolled_things(things)
        pairs = [pair for k in range(count) for pair in self._candidates(k, similar[k])]
        known = torch.stack([self.view(k, view) for k, _, view in pairs])
        compared = Compared(self.comparison(things.crops[[thing for _, thing, _ in pairs]], known))
        masks = F.interpolate(things.masks[:, None], size=(MASK_PX, MASK_PX), mode="bilinear")[:, 0] > 0.5
        alike = torch.stack([similar[k][thing, view] for k, thing, view in pairs])
        for k, match in enumerate(self._matches(pairs, self.log_odds(alike, compared.same).double().numpy())):
            seen.presence[k] = match.presence
            placed = Placed(self.banks[k], match, compared, things, intrinsics_px, up)
            seen.pixel[k], seen.scale[k] = placed.pixel, REFERENCE_RANGE_M / placed.range_m
            seen.pixel_std[k], seen.log_scale_std[k] = placed.pixel_std, placed.log_scale_std
            seen.mask_bits[k] = bits(masks[match.thing, None].numpy())[0]
            others = [(view, row) for row, (object_, thing, view) in enumerate(pairs)
                      if object_ == k and thing == match.thing]
            modes = placed.modes(similar[k][match.thing], others, SHARPNESS)
            seen.modes[k] = modes
            assert seen.camera_from_object is not None  # `_nothing` made it
            seen.camera_from_object[k] = pose(modes.rotations[0], placed.ray * placed.range_m)
        return seen

    def _similar(self, crops: Tensor) -> list[Tensor]:
        """The normalised similarities of crops [P, 4, 64, 64] to the views of each object [P, V]."""
        vectors = self.encoder(crops)
        mine = self.cohort.likest(vectors)
        return [self.cohort.normalised(vectors @ bank.T, mine, likest)
                for bank, likest in zip(self.vectors, self.likest, strict=True)]

    def rolled_things(self, things: Things) -> tuple[Things, list[Tensor]]:
        """Things, each rolled so that it is most like something, and their similarities to the views of each object.

        What is like something as it stands stays so: most things stand.
        """
        similar = self._similar(things.crops)
        best = torch.stack([each.max(1).values for each in similar], 1).max(1).values
        lying = torch.nonzero(self.log_odds(best) < 0.0)[:, 0]
        if not len(lying):
            return things, similar
        crops, roll = things.crops.clone(), things.roll.copy()
        angles = torch.tensor(ROLLS_RAD[1:], dtype=torch.float32)
        turned = rolled(crops[lying].repeat_interleave(len(angles), 0), angles.repeat(len(lying)))
        others = self._similar(turned)
        alike = torch.stack([each.max(1).values for each in others], 1).max(1).values.view(len(lying), len(angles))
        for n, thing in enumerate(lying.tolist()):
            number = int(alike[n].argmax())
            if alike[n, number] > best[thing]:
                row = n * len(angles) + number
                crops[thing], roll[thing] = turned[row], ROLLS_RAD[1 + number]
                for mine, other in zip(similar, others, strict=True):
                    mine[thing] = other[row]
        return replace(things, crops=crops, roll=roll), similar

    def view(self, k: int, view: int) -> Tensor:
        """A view of a bank [4, 64, 64] from 0 to 1."""
        return torch.from_numpy(self.banks[k].image(view).copy()).permute(2, 0, 1).float() / 255.0

    def _candidates(self, k: int, similar: Tensor) -> list[tuple[int, int, int]]:
        """Which things [P, V] are compared with object k, and with which of its views: (object, thing, view)."""
        directions = self.banks[k].directions
        pairs = []
        for thing in similar.max(1).values.topk(min(CANDIDATES, len(similar))).indices.tolist():
            left = similar[thing].clone()
            for _ in range(CANDIDATES):
                view = int(left.argmax())
                pairs.append((k, thing, view))
                left[torch.from_numpy(directions @ directions[view] > np.cos(APART_RAD))] = -np.inf
        return pairs

    def _matches(self, pairs: list[tuple[int, int, int]], log_odds: Array) -> list[Match]:
        """Where each object is likeliest. A thing is one object, or none of them: `log_odds` are those against none."""
        odds = np.exp(np.clip(log_odds, -30, 30))
        best: dict[tuple[int, int], int] = {}  # the row of the likeliest view of each object in each thing
        for row, (k, thing, _) in enumerate(pairs):
            if (k, thing) not in best or odds[row] > odds[best[k, thing]]:
                best[k, thing] = row
        total: dict[int, float] = {}
        for (_, thing), row in best.items():
            total[thing] = total.get(thing, 1.0) + float(odds[row])
        matches = []
        for k in range(len(self.banks)):
            presence, thing, row = max((float(odds[r]) / total[t], t, r) for (o, t), r in best.items() if o == k)
            matches.append(Match(thing, presence, pairs[row][2], row))
        return matches

    @torch.inference_mode()
    def things(self, rgb: NDArray[np.uint8], intrinsics_px: ArrayLike, up: ArrayLike) -> Things:
        """Finds the things in an image, and cuts them out."""
        image = torch.from_numpy(np.array(rgb)).permute(2, 0, 1).float() / 255.0
        height, width = rgb.shape[:2]
        share = INPUT_PX / max(height, width)
        size = [max(GRAIN_PX, round(side * share / GRAIN_PX) * GRAIN_PX) for side in (height, width)]
        small = F.interpolate(image[None], size=size, mode="area" if share < 1 else "bilinear")
        foreground, votes = self.proposer(small.contiguous(memory_format=torch.channels_last))
        found = propose(foreground[0], votes[0])
        return self._cut(image, found, width / size[1], height / size[0], intrinsics_px, up)

    def _cut(self, image: Tensor, found: Proposals, right: float, down: float, intrinsics_px: ArrayLike,
             up: ArrayLike) -> Things:
        """Cuts things out; `right` and `down` are pixels of the image per pixel of the proposals."""
        fx = float(np.asarray(intrinsics_px)[0])
        pixels = found.center.double().numpy() * (right, down)
        ahead = np.maximum(-pixel_rays(pixels, intrinsics_px)[:, 2], 1e-3)
        tangent = half_tangent(found.radius.double().numpy() * right, ahead, fx)
        window = Window(pixels, np.ones(len(found)), 2 * REFERENCE_RANGE_M * tangent / FILLED)
        cropper = Cropper(image, found.masks, intrinsics_px, up)
        if not len(found):
            return Things(torch.zeros(0, 4, 64, 64), window, found.masks, np.zeros(0))
        crops, masks = cropper.cut(window)
        return Things(torch.cat([crops, masks], 1), window, found.masks, np.zeros(len(found)))


class Placed:
    """Where an object is that was found: its ray in the camera's frame [3], its range, and how it may be turned."""

    def __init__(self, bank: Bank, match: Match, compared: Compared, things: Things, intrinsics_px: ArrayLike,
                 up: ArrayLike):
        self.bank, self.compared, self.up = bank, compared, np.asarray(up, dtype=np.float64)
        row, window = match.row, things.window
        half, as_cut = float(window.half_tangent[match.thing]), float(things.roll[match.thing])
        self.roll = float(compared.roll[row]) - as_cut
        right, down, radius_m = bank.circles_m[match.view]
        self.range_m = radius_m / (half * FILLED * float(compared.log_ratio[row].exp()))
        aside = _turn(self.roll) @ np.array([right, down]) / self.range_m
        tangent = _turn(-as_cut) @ compared.shift[row].double().numpy() * half - aside
        rotation = upright(pixel_rays(window.pixels[match.thing, None], intrinsics_px), self.up)[0]
        self.ray = unit(rotation @ np.array([tangent[0], -tangent[1], -1.0]))
        self.pixel = project(self.ray, np.eye(4), intrinsics_px)[0]
        shift_std, self.log_scale_std = compared.deviation[row, :2].tolist()
        self.pixel_std = float(shift_std * half * np.asarray(intrinsics_px)[0])

    def modes(self, similar: Tensor, compared: list[tuple[int, int]], sharpness: float) -> Modes:
        """How the object may be turned, by the similarities [V] to its views, of which some were `compared` (view,
        row): around these the direction is known better."""
        directions = self.bank.directions
        share = (sharpness * (similar - similar.max())).double().exp().numpy()
        rows = [row for _, row in compared]
        near = np.argmax(directions @ directions[[view for view, _ in compared]].T, axis=1)
        share = share * self.compared.same[rows].sigmoid().double().numpy()[near]
        towards: list[Array] = []
        weights: list[float] = []
        for view, row in compared:
            cap = directions @ directions[view] > np.cos(CAP_RAD)
            towards.append(turned(directions[view], self.compared.turn[row].double().numpy()))
            weights.append(float(share[cap].sum()))
            share = np.where(cap, 0.0, share)
        rest = np.argsort(-share)[:MODES - len(compared)]
        deviation = np.concatenate([self.compared.deviation[rows, 2], np.full(len(rest), VIEW_STD_RAD)])
        weight = np.maximum(np.concatenate([weights, share[rest]]), 1e-12)
        order = np.argsort(-weight)
        camera = upright(self.ray[None], self.up)[0]
        roll = np.eye(3)
        roll[:2, :2] = _turn(self.roll).T
        all_towards = np.concatenate([towards, directions[rest]])[order]
        rotations = camera @ roll @ rotation_towards(-all_towards).transpose(0, 2, 1)
        return Modes(rotations, np.log(weight[order] / weight.sum()), deviation[order])


def turned(known: Array, turn: Array) -> Array:
    """The direction [3] that lies an angle to the right and one up [2] (rad) from the direction `known` [3], as its
    camera sees its own motion."""
    angle = float(np.linalg.norm(turn))
    flat = turn * (np.sin(angle) / max(angle, 1e-9))
    return rotation_towards(-known) @ np.array([flat[0], flat[1], np.cos(angle)])


def rolled(crops: Tensor, angle: Tensor) -> Tensor:
    """Crops [P, C, 64, 64], turned by angles [P] (rad)."""
    return warp(crops, torch.zeros(len(crops), 2), torch.ones(len(crops)), angle)


def _turn(angle: float) -> Array:
    """The rotation [2, 2] of a picture (right, down) by an angle (rad)."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _nothing(count: int, shape: tuple[int, ...]) -> Seen:
    """What is seen where nothing is."""
    height, width = shape[:2]
    none, empty = np.zeros((count, 0), dtype=np.float32), np.zeros((count, MASK_PX, MASK_PX), dtype=bool)
    middle = np.tile([width / 2, height / 2], (count, 1)).astype(np.float64)
    return Seen(np.zeros(count), middle, np.full(count, float(width)), np.ones(count), np.ones(count), none, none,
                np.zeros(count), bits(empty), np.tile(np.eye(4), (count, 1, 1)), [NOT_SEEN] * count)
