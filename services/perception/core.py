"""SceneCCN: from an image to one percept per object (paper, section 3.2). The networks of all objects run together."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

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
from saccade.services.perception.same_view import Agreement, SameView
from saccade.services.perception.seen import Seen, bits
from saccade.shared.bus.messages import Frame, Goal, Percept
from saccade.shared.bus.topics import FRAME, GOAL, GOAL_PERCEPT, PERCEPT, Output
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.service import Inputs, Service
from saccade.shared.model.generative_model import Decoder, Encoder, Stacked
from saccade.shared.model.weights import WITH_LATENTS, Weights
from saccade.shared.world.windows import Window

SERVICE = Service("perception", inputs=(FRAME, GOAL), trigger=FRAME, outputs=(PERCEPT, GOAL_PERCEPT),
                  divisible=True)
GOAL_UP = (0.0, 1.0, 0.0)  # of a goal image nothing is known but that it stands upright


@dataclass(frozen=True)
class Found:
    """K objects as found in an image.

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
        mean, std = (x[:, 0] for x in self.encoder(masked[:, None]))
        error = ((self.decoder(mean[:, None])[:, 0] * crop_masks - masked[:, :3]) ** 2).sum((1, 2, 3))
        return Seen(found.presence, window.pixels, found.side_px * deviation[:, :2].mean(1), window.scales,
                    deviation[:, 2], mean.numpy(), std.numpy(), error.double().numpy(), found.mask_bits)

    @torch.inference_mode()
    def find(self, rgb: NDArray[np.uint8], intrinsics_px: ArrayLike, up: ArrayLike) -> Found:
        """Finds all objects in an image, and cuts them out. The arguments are those of `see`."""
        image = torch.from_numpy(np.array(rgb)).permute(2, 0, 1).float() / 255.0
        small = F.interpolate(image[None], size=(INPUT_PX, INPUT_PX), mode="area")
        masks, vote_logits, votes = (x[0, self.rows] for x in self.extraction(small))
        logit, center, log_scale = tally(vote_logits, votes)
        cropper = Cropper(image, masks.sigmoid(), intrinsics_px, up)
        window = Window(center.double().numpy() * rgb.shape[1], log_scale.exp().double().numpy(), self.sides_m)
        for _ in range(self.passes):
            crops, crop_masks = cropper.cut(window)
            raw = torch.cat([crops, crop_masks], dim=1)
            identity_logit, correction, log_std = (x[:, 0] for x in self.identity(raw[:, None]))
            before, window = window, cropper.corrected(window, correction.double().clamp(-0.5, 0.5).numpy())
        presence = (logit.sigmoid() * identity_logit.sigmoid()).double().numpy()
        deviation = log_std.exp().double().numpy()
        side_px = 2 * before.half_tangent * float(np.asarray(intrinsics_px)[0])
        return Found(cropper, crops, crop_masks, window, presence, deviation, side_px, bits((masks > 0).numpy()))


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
        for k, (name, agrees) in enumerate(zip(self.names, agreements, strict=True)):
            told = percept(frame, name, seen, k, frame.world_from_camera)
            if agrees is not None:
                told = replace(told, goal_agreement=agrees.share, goal_aside_rad=agrees.aside_rad)
            yield Output(PERCEPT, told, name)

    def _seen(self, model: Model, frame: Frame) -> tuple[Seen, list[Agreement | None]]:
        """What is seen in the frame, and how each object agrees with the goal image, if they are compared."""
        if self._last is None or not _same_view(self._last[0], frame):
            up = frame.world_from_camera[2, :3]
            seen = model.see(frame.rgb, frame.intrinsics_px, up, frame.depth_m)
            compare = self.same_view
            self._last = frame, seen, [None if compare is None else compare(k, frame.rgb, frame.intrinsics_px, up, seen)
                                       for k in range(len(self.names))]
        return self._last[1:]

    def _goal(self, model: Model, goal: Goal) -> Iterable[Output]:
        """The percepts of the goal image. Without a goal image the presence of every object is 0."""
        if goal.rgb is None:
            blank = np.zeros((480, 480, 3), dtype=np.uint8)
            seen = model.see(blank, goal.intrinsics_px, GOAL_UP)
            seen.presence[:] = 0.0
        else:
            seen = model.see(goal.rgb, goal.intrinsics_px, GOAL_UP, alone=True)
            if self._compare is not None:
                self.same_view = self._compare(goal.rgb, goal.intrinsics_px, GOAL_UP, seen)
        for k, name in enumerate(self.names):
            yield Output(GOAL_PERCEPT, percept(goal, name, seen, k, np.eye(4)), name)


def _same_view(a: Frame, b: Frame) -> bool:
    """Whether two frames show the same from the same place. The depth then is the same, too."""
    return (np.array_equal(a.world_from_camera, b.world_from_camera)
            and np.array_equal(a.intrinsics_px, b.intrinsics_px) and np.array_equal(a.rgb, b.rgb))


def percept(source: Frame | Goal, name: str, seen: Seen, k: int, world_from_camera: NDArray) -> Percept:
    """The percept message of object `name`, which is number `k` in `seen`."""
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
