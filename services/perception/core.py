"""SceneCCN: from an image to one percept per object (paper, section 3.2). The networks of all objects run together."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray

from saccade.services.perception.cropping import Cropper
from saccade.services.perception.local_features import LocalFeatures
from saccade.services.perception.networks import INPUT_PX, Extraction, Identity, tally
from saccade.services.perception.open_world import open_world_of
from saccade.services.perception.paper import PaperSceneCCN
from saccade.services.perception.posecnn import PoseCNN
from saccade.services.perception.same_view import GOAL_UP, Agreement, SameView
from saccade.services.perception.seen import Seen, bits
from saccade.services.perception.several import AGAINST, Group, groups
from saccade.shared.bus.messages import Frame, Goal, Percept
from saccade.shared.bus.topics import FRAME, GOAL, GOAL_PERCEPT, PERCEPT, Output
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.service import Inputs, Service
from saccade.shared.model.generative_model import Decoder, Encoder, Stacked
from saccade.shared.model.weights import WITH_LATENTS, Weights
from saccade.shared.world.geometry import REFERENCE_RANGE_M
from saccade.shared.world.windows import Window

SERVICE = Service("perception", inputs=(FRAME, GOAL), trigger=FRAME, outputs=(PERCEPT, GOAL_PERCEPT),
                  divisible=True)


@dataclass(frozen=True)
class Found:
    """K objects as found in an image, and further ones of the objects `kinds`, which are the rows after the first K.

    crops [K, 3, 64, 64] and their masks [K, 1, 64, 64]; the windows that the objects fill; presences [K]; standard
    deviations of the windows (two of the place in crop sides, one of the log scale) [K, 3]; sides of the crops in
    pixels [K]; masks in the image. `cropper` cuts further crops.
    """

    cropper: Cropper
    crops: torch.Tensor
    crop_masks: torch.Tensor
    window: Window
    presence: NDArray[np.float64]
    deviation: NDArray[np.float64]
    side_px: NDArray[np.float64]
    mask_bits: NDArray[np.uint8]
    kinds: tuple[int, ...] = ()


class SceneCCN:
    """The networks of K objects, and how they work together.

    `passes` says how often the crop of each object is cut; every pass after the first uses the correction of the
    identity network. Raises SaccadeError if the weights lack an object, are damaged, or have another architecture.
    """

    def __init__(self, weights: Weights, names: tuple[str, ...], passes: int = 2):
        self.cards = weights.cards_of(names)
        self.rows = [weights.names.index(name) for name in names]
        self.extraction = weights.fill(Extraction(len(weights.names)), "extraction")
        self.identity = Stacked([weights.fill(Identity(), name, "identity.") for name in names])
        self.encoder = Stacked([weights.fill(Encoder(), name, "ccn.encoder.") for name in names])
        self.decoder = Stacked([weights.fill(Decoder(), name, "ccn.decoder.") for name in names])
        self.sides_m = np.array([card.crop_side_m for card in self.cards])
        self.passes = passes

    @torch.inference_mode()
    def see(self, rgb: NDArray[np.uint8], intrinsics_px: ArrayLike, up: ArrayLike,
            depth_m: NDArray[np.float32] | None = None, *, alone: bool = False) -> Seen:
        """Infers all objects from an image [H, W, 3]. `up` [3] is the direction of up in the camera's frame. The depth
        is not used."""
        found = self.find(rgb, intrinsics_px, up)
        crops, crop_masks, window, deviation = found.crops, found.crop_masks, found.window, found.deviation
        masked = torch.cat([crops * crop_masks, crop_masks], dim=1)
        mean, std = (x[:, 0] for x in self._by(self.encoder, masked[:, None], found.kinds))
        drawn = self._by(self.decoder, mean[:, None], found.kinds)[:, 0]
        error = ((drawn * crop_masks - masked[:, :3]) ** 2).sum((1, 2, 3))
        return Seen(found.presence, window.pixels, found.side_px * deviation[:, :2].mean(1), window.scales,
                    deviation[:, 2], mean.numpy(), std.numpy(), error.double().numpy(), found.mask_bits,
                    kinds=found.kinds)

    def _by(self, networks: Stacked, inputs: torch.Tensor, kinds: tuple[int, ...]) -> Any:
        """The outputs of networks for K objects, and for further ones of the objects `kinds`, [K + len(kinds), ...]."""
        first = networks(inputs[:len(self.cards)])
        if not kinds:  # an object that is there once costs no more than before
            return first
        rest = networks.some(kinds, inputs[len(self.cards):])
        if isinstance(first, torch.Tensor):
            return torch.cat([first, rest])
        return tuple(map(torch.cat, zip(first, rest, strict=True)))

    def _sorted(self, masks: torch.Tensor, vote_logits: torch.Tensor, votes: torch.Tensor, focal_widths: float) -> \
            tuple[torch.Tensor, torch.Tensor, torch.Tensor, tuple[int, ...]]:
        """Masks, votes and kinds with a further row for each further one of a kind. `focal_widths` is the focal length
        in image widths."""
        further: list[tuple[int, Group]] = []
        for k, card in enumerate(self.cards):
            several = groups(vote_logits[k], votes[k], card.radius_m / REFERENCE_RANGE_M * focal_widths,
                             masks.shape[-1])
            if several:
                vote_logits, masks = vote_logits.clone(), masks.clone()
                vote_logits[k] = several[0].vote_logits
                further += [(k, group) for group in several[1:]]
                first_of = masks[k].clone()
                masks[k] = first_of.masked_fill(~several[0].own, AGAINST)
                rest = [first_of.masked_fill(~group.own, AGAINST) for group in several[1:]]
                masks = torch.cat([masks, torch.stack(rest)])
                vote_logits = torch.cat([vote_logits, torch.stack([group.vote_logits for group in several[1:]])])
        kinds = tuple(k for k, _ in further)
        return masks, vote_logits, torch.cat([votes, votes[list(kinds)]]) if kinds else votes, kinds

    @torch.inference_mode()
    def find(self, rgb: NDArray[np.uint8], intrinsics_px: ArrayLike, up: ArrayLike) -> Found:
        """Finds all objects in an image, and cuts them out. The arguments are those of `see`."""
        image = torch.from_numpy(np.array(rgb)).permute(2, 0, 1).float() / 255.0
        small = F.interpolate(image[None], size=(INPUT_PX, INPUT_PX), mode="area")
        focal_px = float(np.asarray(intrinsics_px)[0])
        masks, vote_logits, votes = (x[0, self.rows] for x in self.extraction(small))
        masks, vote_logits, votes, kinds = self._sorted(masks, vote_logits, votes, focal_px / rgb.shape[1])
        sides_m = np.concatenate([self.sides_m, self.sides_m[list(kinds)]]) if kinds else self.sides_m
        logit, center, log_scale = tally(vote_logits, votes)
        cropper = Cropper(image, masks.sigmoid(), intrinsics_px, up)
        window = Window(center.double().numpy() * rgb.shape[1], log_scale.exp().double().numpy(), sides_m)
        for _ in range(self.passes):
            crops, crop_masks = cropper.cut(window)
            raw = torch.cat([crops, crop_masks], dim=1)
            identity_logit, correction, log_std = (x[:, 0] for x in self._by(self.identity, raw[:, None], kinds))
            before, window = window, cropper.corrected(window, correction.double().clamp(-0.5, 0.5).numpy())
        presence = (logit.sigmoid() * identity_logit.sigmoid()).double().numpy()
        deviation = log_std.exp().double().numpy()
        side_px = 2 * before.half_tangent * focal_px
        return Found(cropper, crops, crop_masks, window, presence, deviation, side_px, bits((masks > 0).numpy()), kinds)


class Model(Protocol):
    """Networks that infer all objects from one image."""

    def see(self, rgb: NDArray[np.uint8], intrinsics_px: ArrayLike, up: ArrayLike,
            depth_m: NDArray[np.float32] | None = None, *, alone: bool = False) -> Seen:
        """Infers all objects from an image [H, W, 3], and from its depth [H, W] where there is one and they use it.
        Networks may take more time for an image that stands alone: no other will say more about the same things."""


def model_of(weights: Weights, names: tuple[str, ...], passes: int) -> Model:
    """Creates the networks of the architecture that the weights have. Raises SaccadeError as the networks do."""
    if weights.architecture == "paper":
        return PaperSceneCCN(weights, names)
    if weights.architecture == "posecnn":
        return PoseCNN(weights, names)
    if weights.architecture == "open":
        return open_world_of(weights, names)
    return SceneCCN(weights, names, passes)


class Perception:
    """Turns frames into percepts. Once per episode it does the same with the goal image, with the same networks.

    `make` creates the networks for some of the objects.
    """

    def __init__(self, make: Callable[[tuple[str, ...]], Model], names: tuple[str, ...]):
        self._make = make
        self._last: tuple[Frame, Seen, list[Agreement | None]] | None = None  # nothing is inferred twice
        self.share(names)

    def share(self, names: tuple[str, ...]) -> None:
        """From now on this copy of the service publishes the percepts of these objects; there may be none.

        Raises SaccadeError if the weights do not serve them.
        """
        self.names, self.goal_told, self._last = names, False, None
        self.same_view: SameView | None = None  # which compares images with the goal image
        self.model = model = self._make(names) if names else None
        # Other models tell by themselves how an object is turned.
        self._compare = partial(SameView, LocalFeatures(), model.sides_m) if isinstance(model, SceneCCN) else None

    def begin(self, run: str, episode: int) -> Iterable[Output]:
        """Starts an episode. Percepts depend on one image and the goal image alone."""
        self.goal_told, self.same_view, self._last = False, None, None
        return ()

    def step(self, inputs: Inputs) -> Iterable[Output]:
        """Yields the percepts of the frame. At the first step of an episode it yields those of the goal image first."""
        model = self.model
        if model is None:
            return
        frame: Frame = inputs["frame"]
        if not self.goal_told:
            self.goal_told = True
            yield from self._goal(model, inputs["goal"])
        seen, agreements = self._seen(model, frame)
        for k, name in enumerate(self.names):
            told, *further = [self._told(name, row, frame, seen, agreements[row]) for row in seen.rows_of(k)]
            yield Output(PERCEPT, replace(told, further=further) if further else told, name)

    def _told(self, name: str, row: int, frame: Frame, seen: Seen, agrees: Agreement | None) -> Percept:
        """The percept of a row of what was seen, and how it agrees with the goal image."""
        told = percept(frame, name, seen, row, frame.world_from_camera)
        return told if agrees is None else replace(
            told, goal_agreement=agrees.share, goal_aside_rad=agrees.aside_rad, goal_above_rad=agrees.above_rad,
            goal_log_larger=agrees.log_larger)

    def _seen(self, model: Model, frame: Frame) -> tuple[Seen, list[Agreement | None]]:
        """What is seen in the frame, and how each row of it agrees with the goal image, if they are compared."""
        if self._last is None or not _same_view(self._last[0], frame):
            up = frame.world_from_camera[2, :3]
            seen = model.see(frame.rgb, frame.intrinsics_px, up, frame.depth_m)
            compare, kinds = self.same_view, (*range(len(self.names)), *seen.kinds)
            self._last = frame, seen, [
                None if compare is None else compare(k, frame.rgb, frame.intrinsics_px, up, seen, row)
                for row, k in enumerate(kinds)]
        return self._last[1:]

    def _goal(self, model: Model, goal: Goal) -> Iterable[Output]:
        """The percepts of the goal image. Without a goal image the presence of every object is 0. Of several of a kind
        the goal is the one in the middle."""
        is_given = goal.rgb is not None
        rgb = np.zeros((480, 480, 3), dtype=np.uint8) if goal.rgb is None else goal.rgb
        seen = model.see(rgb, goal.intrinsics_px, GOAL_UP, alone=is_given)
        if not is_given:
            seen.presence[:] = 0.0
        rows = [seen.goal_row(k, np.array(rgb.shape[1::-1]) / 2) for k in range(len(self.names))]
        if is_given and self._compare is not None:
            self.same_view = self._compare(rgb, goal.intrinsics_px, seen, rows)
        for name, row in zip(self.names, rows, strict=True):
            yield Output(GOAL_PERCEPT, percept(goal, name, seen, row, np.eye(4)), name)


def _same_view(a: Frame, b: Frame) -> bool:
    """Whether two frames show the same from the same place. The depth then is the same, too."""
    return (np.array_equal(a.world_from_camera, b.world_from_camera)
            and np.array_equal(a.intrinsics_px, b.intrinsics_px) and np.array_equal(a.rgb, b.rgb))


def percept(source: Frame | Goal, name: str, seen: Seen, k: int, world_from_camera: NDArray) -> Percept:
    """The percept message of object `name`, which is the row `k` of `seen`."""
    modes = seen.modes[k] if seen.modes else None
    return Percept(
        run=source.run, episode=source.episode, step=source.step, object=name, presence=float(seen.presence[k]),
        pixel=seen.pixel[k], pixel_std=float(seen.pixel_std[k]), scale=float(seen.scale[k]),
        log_scale_std=float(seen.log_scale_std[k]), latent_mean=seen.latent_mean[k], latent_std=seen.latent_std[k],
        intrinsics_px=np.asarray(source.intrinsics_px), world_from_camera=np.asarray(world_from_camera),
        reconstruction_error=float(seen.reconstruction_error[k]), mask_bits=seen.mask_bits[k],
        camera_from_object=None if seen.camera_from_object is None else seen.camera_from_object[k],
        rotations=None if modes is None else modes.rotations,
        log_probability=None if modes is None else modes.log_probability,
        deviation_rad=None if modes is None else modes.deviation_rad)


def _kind(architecture: str) -> str:
    """What stands for all architectures that can replace each other in an agent."""
    return WITH_LATENTS[0] if architecture in WITH_LATENTS else architecture


def build(config: Config) -> Perception:
    """Creates the core from a run's configuration. Raises SaccadeError if the weights do not serve its objects, or if
    they infer poses where latent poses are wanted, or the reverse."""
    weights, wanted = Weights(config.weights), config.perception.architecture
    if _kind(weights.architecture) != _kind(wanted):
        raise SaccadeError(f"weights {weights.folder} are of the architecture {weights.architecture!r}, and this agent "
                           f"needs {wanted!r}: name other weights, or choose the agent that works with these")
    return Perception(lambda names: model_of(weights, names, config.perception.passes), config.names)
