"""Networks that know no object by name: things are proposed, encoded, and compared with the banks of known objects.

What is known of an object is its bank. So a new object needs no training, a thing that is in no bank is a stranger, and
symmetry shows as views that are alike. The weights hold three networks for all objects and a bank for each; their
manifest says "architecture": "open".
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from saccade.services.perception.comparer import Compared, Comparison, Half
from saccade.services.perception.cropping import Cropper
from saccade.services.perception.landmark_fit import FEATURES, Fit, LandmarkFit
from saccade.services.perception.landmark_search import Found, LandmarkSearch
from saccade.services.perception.likeness import COHORT, OBJECTS, USUAL, Cohort, LogOdds
from saccade.services.perception.local_features import LocalFeatures, in_channels_last
from saccade.services.perception.matching import best_matches, further_matches, unclaimed
from saccade.services.perception.placed import Placed
from saccade.services.perception.proposer import Proposals, Proposer, half_tangent, propose, with_whole
from saccade.services.perception.seen import Modes, Seen, bits
from saccade.services.perception.things import FINE_PX, Match, Things, rolled
from saccade.services.perception.view_encoder import ViewEncoder
from saccade.shared.model.bank import FILLED, Bank, bank_in
from saccade.shared.model.weights import Weights
from saccade.shared.world.geometry import REFERENCE_RANGE_M, pixel_rays, pose
from saccade.shared.world.windows import Window

INPUT_PX = 448  # the longer side of the image that the proposer sees
GRAIN_PX = 16  # its sides are multiples of this
APART_RAD = 0.6  # views farther apart than this are compared separately
CANDIDATES = 2  # things that are compared with each object, and views of each object that are compared with a thing
MASK_PX = 60
NEAR = 0.3  # of the image that things fill, from which on one may be nearer than the image is large
CERTAIN = 25  # landmarks; where so many speak for what a thing is, it is nothing else
TWINS = 0.1  # of a similarity: an object that is nearly as like may be a twin of what was found
LIKEST = 2  # objects that a thing is likest, which are looked for in it where one image follows another, beside twins
LIKE_NOTHING = 0.1  # a normalised similarity; to a thing that is less like everything nothing is fitted there
ABSENT = 5e-3  # the presence of an object that no thing is among the likest of
KEPT = 200  # views that are kept as the comparison takes them, of 200 kB each
SHARPNESS = 20.0  # of the similarities, where it is told how an object is turned
LIKE_SOMETHING = 0.23  # a normalised similarity; a thing that is less like everything is rolled
ROLLS_RAD = 2 * np.pi / 8 * np.arange(8)  # in which a thing is tried that is like nothing as it stands

Array = NDArray[np.float64]
NOT_SEEN = Modes(np.eye(3)[None], np.zeros(1), np.full(1, np.pi))


@dataclass(frozen=True)
class Round:
    """Comparisons of pairs (object, thing, view): by the network, log odds against none, and fits of landmarks."""

    pairs: list[tuple[int, int, int]]
    compared: Compared
    log_odds: Array
    fits: dict[tuple[int, int], Fit]


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
    return OpenWorld(proposer, encoder, comparison, LocalFeatures(), banks, cohort, LogOdds(**fitted))


class OpenWorld:
    """The networks, with the banks of K objects."""

    square = False  # an image may have any sides

    def __init__(self, proposer: Proposer, encoder: ViewEncoder, comparison: Comparison, features: LocalFeatures,
                 banks: list[Bank], cohort: Cohort, log_odds: LogOdds = USUAL):
        self.proposer, self.encoder, self.comparison = proposer.eval(), encoder.eval(), comparison.eval()
        for network in (proposer, encoder, comparison):
            in_channels_last(network)
        self.banks, self.log_odds = banks, log_odds
        self.vectors = torch.from_numpy(np.concatenate([bank.vectors for bank in banks]))
        self.directions = [bank.directions for bank in banks]
        self.features, self.cohort = features, cohort
        self.fits = [LandmarkFit(bank.landmarks) for bank in banks]
        self.search = LandmarkSearch(features, self.fits)
        self.many = float(np.log(max(len(banks) / OBJECTS, 1.0)))  # a thing is each of many more seldom
        self.likest = cohort.likest(self.vectors)
        self._known = lru_cache(KEPT)(self._of_view)  # an agent sees the same views again

    @torch.inference_mode()
    def see(self, rgb: NDArray[np.uint8], intrinsics_px: ArrayLike, up: ArrayLike,
            depth_m: NDArray[np.float32] | None = None, *, alone: bool = False) -> Seen:
        """Infers all objects from an image [H, W, 3]. `up` [3] is the direction of up in the camera's frame. The depth
        is not used. In an image that stands `alone`, landmarks are searched for in everything, in any roll."""
        things = self.things(rgb, intrinsics_px, up, whole=0.0 if alone else NEAR)
        count = len(self.banks)
        found = self.search(things, ROLLS_RAD.tolist()) if alone else {}
        things, similar = self.rolled_things(things, found)
        like = _likeness(similar)
        worth = np.ones_like(like, dtype=bool) if alone else _worth_a_look(like)
        pairs = [pair for k in range(count)
                 for pair in self._candidates(k, similar[k], found, worth[k], whole=things.whole)]
        first = self._round(things, similar, like, pairs, found, quick=not alone)
        matches = best_matches(first.pairs, first.log_odds, first.fits)
        told = [(k, k, match, first) for k, match in matches.items()]  # of no other object anything is told
        more = [(k, thing, view) for k, thing in unclaimed(like, matches, whole=things.whole)
                for view in self._views(k, similar[k][thing])]
        kinds: list[int] = []
        if more:
            second = self._round(things, similar, like, more, found, quick=not alone)
            odds = np.exp(np.clip(second.log_odds, -30, 30))
            further = further_matches(second.pairs, odds, second.fits)
            kinds = [k for k, _ in further]
            told += [(count + n, k, match, second) for n, (k, match) in enumerate(further)]
        seen = _nothing(count + len(kinds), rgb.shape)
        masks = F.interpolate(things.masks[:, None], size=(MASK_PX, MASK_PX), mode="bilinear")[:, 0] > 0.5
        for row, k, match, compared in told:
            placed = Placed(self.banks[k], match, compared.compared, things, intrinsics_px, up)
            self._tell(seen, row, k, match, placed, compared, similar[k][match.thing])
            seen.mask_bits[row] = bits(masks[match.thing, None].numpy())[0]
        return replace(seen, kinds=tuple(kinds))

    def _round(self, things: Things, similar: list[Tensor], like: Array, pairs: list[tuple[int, int, int]],
               found: Mapping[int, Found], *, quick: bool) -> Round:
        """Compares things with objects, pairs (object, thing, view): those that are worth it."""
        fits = self.fitted(things, {(k, thing) for k, thing, _ in pairs}, found, like, quick=quick)
        pairs = _left(pairs, fits, like)
        compared = self._compared(things, pairs)
        alike = torch.stack([similar[k][thing, view] for k, thing, view in pairs])
        odds = self.log_odds(alike, compared.same, *self.found(pairs, fits)).double().numpy() - self.many
        return Round(pairs, compared, odds, fits)

    def _tell(self, seen: Seen, row: int, k: int, match: Match, placed: Placed, compared: Round,
              similar: Tensor) -> None:
        """Fills a row of what is `seen` with where object k is and how it is turned, by the similarities [V] of the
        thing to its views."""
        seen.presence[row] = match.presence
        seen.pixel[row], seen.scale[row] = placed.pixel, REFERENCE_RANGE_M / placed.range_m
        seen.pixel_std[row], seen.log_scale_std[row] = placed.pixel_std, placed.log_scale_std
        others = [(view, number) for number, (object_, thing, view) in enumerate(compared.pairs)
                  if object_ == k and thing == match.thing]
        modes = placed.modes(similar, others, SHARPNESS)
        seen.modes[row] = modes
        assert seen.camera_from_object is not None  # `_nothing` made it
        seen.camera_from_object[row] = pose(modes.rotations[0], placed.ray * placed.range_m)

    def _similar(self, crops: Tensor) -> list[Tensor]:
        """The normalised similarities of crops [P, 4, 64, 64] to the views of each object [P, V]."""
        vectors = self.encoder(crops)
        every = self.cohort.normalised(vectors @ self.vectors.T, self.cohort.likest(vectors), self.likest)
        return list(every.split([len(bank.vectors) for bank in self.banks], dim=1))

    def rolled_things(self, things: Things, found: Mapping[int, Found] | None = None) -> tuple[Things, list[Tensor]]:
        """Things, each rolled as it was found, or else so that it is most like something; and their similarities to the
        views of each object.

        What is like something as it stands stays so: most things stand.
        """
        found = found or {}
        crops, fine, roll = things.crops.clone(), things.fine.clone(), things.roll.copy()
        for thing, each in found.items():
            if each.roll:
                angle = torch.tensor([each.roll], dtype=torch.float32)
                crops[thing], fine[thing] = rolled(crops[thing, None], angle)[0], rolled(fine[thing, None], angle)[0]
                roll[thing] = each.roll
        similar = self._similar(crops)
        best = torch.stack([each.max(1).values for each in similar], 1).max(1).values
        is_found = torch.tensor([thing in found for thing in range(len(crops))])
        lying = torch.nonzero((best < LIKE_SOMETHING) & ~is_found)[:, 0]
        if len(lying):
            angles = torch.tensor(ROLLS_RAD[1:], dtype=torch.float32)
            turned = rolled(crops[lying].repeat_interleave(len(angles), 0), angles.repeat(len(lying)))
            others = self._similar(turned)
            alike = torch.stack([each.max(1).values for each in others], 1).max(1).values.view(len(lying), -1)
            for n, thing in enumerate(lying.tolist()):
                number = int(alike[n].argmax())
                if alike[n, number] > best[thing]:
                    row = n * len(angles) + number
                    crops[thing], roll[thing] = turned[row], ROLLS_RAD[1 + number]
                    fine[thing] = rolled(fine[thing, None], angles[number, None])[0]
                    for mine, other in zip(similar, others, strict=True):
                        mine[thing] = other[row]
        return replace(things, crops=crops, fine=fine, roll=roll), similar

    @torch.inference_mode()
    def fitted(self, things: Things, pairs: Collection[tuple[int, int]],
               found: Mapping[int, Found] | None = None, like: Array | None = None, *,
               quick: bool = True) -> dict[tuple[int, int], Fit]:
        """How the landmarks of objects fit things, for those of the `pairs` (object, thing) where enough do. What was
        `found` is not fitted again. By the likenesses of the objects and things, `like` [K, P], the likest objects come
        first, and where it is clear what a thing is, the others that are not nearly as like are left out. Where it must
        be `quick`, so are things that are like nothing."""
        fits = {(each.object, thing): each.fit for thing, each in (found or {}).items()}
        left = sorted(set(pairs) - fits.keys())
        if like is not None:
            left = [(k, thing) for k, thing in left if not quick or like[:, thing].max() > LIKE_NOTHING]
            left.sort(key=lambda pair: -like[pair])
        wanted = sorted({thing for _, thing in left})
        seen = dict(zip(wanted, self.features(things.fine[wanted], FEATURES) if wanted else [], strict=True))
        for k, thing in left:
            if like is not None and not _may_be(k, thing, fits, like):
                continue
            half = float(things.window.half_tangent[thing])
            fit = self.fits[k](seen[thing], FINE_PX / 2 / half, FINE_PX, quick=quick)
            if fit is not None:
                fits[k, thing] = fit
        return fits

    def found(self, pairs: list[tuple[int, int, int]], fits: Mapping[tuple[int, int], Fit]) -> tuple[Tensor, Tensor]:
        """How many landmarks fit for each of the pairs (object, thing, view), and how many are usual for the object."""
        count = [fits[k, thing].support if (k, thing) in fits else 0.0 for k, thing, _ in pairs]
        usual = [self.banks[k].landmarks.usual for k, _, _ in pairs]
        return torch.tensor(count, dtype=torch.float32), torch.tensor(usual)

    def view(self, k: int, view: int) -> Tensor:
        """A view of a bank [4, 64, 64] from 0 to 1."""
        return torch.from_numpy(self.banks[k].image(view)).permute(2, 0, 1).float() / 255.0

    def _compared(self, things: Things, pairs: list[tuple[int, int, int]]) -> Compared:
        """What the comparison says of the pairs (object, thing, view)."""
        wanted = [thing for _, thing, _ in pairs]
        seen, known = self.comparison.of_seen(things.crops), [self._known(k, view) for k, _, view in pairs]
        return Compared(self.comparison.halves(Half(seen.maps[wanted], seen.given[wanted]),
                                               Half(*(torch.cat(part) for part in zip(*known, strict=True)))))

    def _of_view(self, k: int, view: int) -> Half:
        """Each view by itself, so that it does not matter which ones are kept: rounding may depend on the batch."""
        return self.comparison.of_known(self.view(k, view)[None].contiguous(memory_format=torch.channels_last))

    def _candidates(self, k: int, similar: Tensor, found: Mapping[int, Found], worth: NDArray[np.bool_], *,
                    whole: bool) -> list[tuple[int, int, int]]:
        """Which things are compared with object k, and with which of its views: (object, thing, view). Things are like
        it by `similar` [P, V], or it was found there, or they are the `whole` image, the last one: what is near fills
        it. Only what is `worth` it [P] is compared."""
        likest = similar.max(1).values.topk(min(CANDIDATES, len(similar))).indices.tolist()
        pairs = []
        last = {len(similar) - 1} if whole else set()
        for thing in sorted({*likest, *last, *(n for n, each in found.items() if each.object == k)}):
            if worth[thing]:
                pairs += [(k, thing, view) for view in self._views(k, similar[thing])]
        return pairs

    def _views(self, k: int, similar: Tensor) -> list[int]:
        """The views of object k with which a thing is compared, by its similarities [V] to all of them."""
        directions, left, views = self.directions[k], similar.clone(), []
        for _ in range(CANDIDATES):
            view = int(left.argmax())
            views.append(view)
            left[torch.from_numpy(directions @ directions[view] > np.cos(APART_RAD))] = -np.inf
        return views

    @torch.inference_mode()
    def things(self, rgb: NDArray[np.uint8], intrinsics_px: ArrayLike, up: ArrayLike, *,
               whole: float | None = None) -> Things:
        """Finds the things in an image, and cuts them out. The whole image is one more thing where nothing else is
        found, or where things fill more than the share `whole` of it."""
        image = torch.from_numpy(np.array(rgb)).permute(2, 0, 1).float() / 255.0
        height, width = rgb.shape[:2]
        share = INPUT_PX / max(height, width)
        size = [max(GRAIN_PX, round(side * share / GRAIN_PX) * GRAIN_PX) for side in (height, width)]
        small = F.interpolate(image[None], size=size, mode="area" if share < 1 else "bilinear")
        foreground, votes = self.proposer(small.contiguous(memory_format=torch.channels_last))
        found = propose(foreground[0], votes[0])
        is_whole = whole is not None and (not len(found) or float(foreground.sigmoid().mean()) > whole)
        if is_whole:
            found = with_whole(found, foreground[0])
        things = self._cut(image, found, width / size[1], height / size[0], intrinsics_px, up)
        return replace(things, whole=is_whole)

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
            nothing = torch.zeros(0, 4, 64, 64), torch.zeros(0, 3, FINE_PX, FINE_PX)
            return Things(*nothing, window, found.masks, np.zeros(0))
        crops, masks = cropper.cut(window)
        return Things(torch.cat([crops, masks], 1), cropper.fine(window, FINE_PX), window, found.masks,
                      np.zeros(len(found)))


def _likeness(similar: Sequence[Tensor]) -> Array:
    """How like each object each thing is [K, P]."""
    return np.array([each.max(1).values.numpy() for each in similar], dtype=np.float64)


def _worth_a_look(like: Array) -> NDArray[np.bool_]:
    """Which objects are looked for in which things [K, P], where one image follows another: those that a thing is
    likest, and twins of these where it is like something."""
    count, first = min(LIKEST, len(like)), like.max(0)
    return (like >= np.sort(like, axis=0)[-count]) | ((like > first - TWINS) & (first > LIKE_SOMETHING))


def _may_be(k: int, thing: int, fits: Mapping[tuple[int, int], Fit], like: Array) -> bool:
    """Whether a thing may be object k, by what its landmarks say of other objects. Twins are nearly as like."""
    clear = [other for (other, where), fit in fits.items() if where == thing and fit.support >= CERTAIN]
    return not clear or k in clear or any(like[k, thing] > like[other, thing] - TWINS for other in clear)


def _left(pairs: list[tuple[int, int, int]], fits: Mapping[tuple[int, int], Fit], like: Array) -> \
        list[tuple[int, int, int]]:
    """The pairs (object, thing, view) that are worth a comparison, in their order: at least one of each object."""
    left = {pair for pair in pairs if _may_be(pair[0], pair[1], fits, like)}
    told = {k for k, _, _ in left}
    first = {k: pair for pair in reversed(pairs) if (k := pair[0]) not in told}
    return [pair for pair in pairs if pair in left or first.get(pair[0]) == pair]


def _nothing(count: int, shape: tuple[int, ...]) -> Seen:
    """What is seen where nothing is."""
    height, width = shape[:2]
    none, empty = np.zeros((count, 0), dtype=np.float32), np.zeros((count, MASK_PX, MASK_PX), dtype=bool)
    middle = np.tile([width / 2, height / 2], (count, 1)).astype(np.float64)
    return Seen(np.full(count, ABSENT), middle, np.full(count, float(width)), np.ones(count), np.ones(count), none,
                none, np.zeros(count), bits(empty), np.tile(np.eye(4), (count, 1, 1)), [NOT_SEEN] * count)
