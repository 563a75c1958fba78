"""The messages: frozen dataclasses whose annotations tell all of their fields; `shared/bus/wire.py` encodes them."""

from __future__ import annotations

import dataclasses
import functools
import typing
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np


@dataclass(frozen=True)
class ArraySpec:
    """dtype and shape of an array field; a str in the shape is a free dimension, equal wherever it is named."""

    dtype: str
    shape: tuple[int | str, ...]


def array(dtype: str, *shape: int | str) -> ArraySpec:
    """What an array field holds, for its annotation: `Annotated[np.ndarray, array("f4", "N", 3)]`."""
    return ArraySpec(dtype, shape)


@dataclass(frozen=True, kw_only=True)
class Message(metaclass=type):  # noqa: UP050 - without it mypy holds that its classes cannot be keys of a cache
    """What every message carries. `seq` counts the messages of one key and is set by the publisher."""

    VERSION: ClassVar[int] = 1

    run: str
    episode: int
    step: int
    seq: int = 0


AnyMessage = TypeVar("AnyMessage", bound=Message)


@dataclass(frozen=True, kw_only=True)
class Frame(Message):
    """What the camera sees. Depth along the optical axis in metres, where the source has it."""

    rgb: Annotated[np.ndarray, array("u1", "H", "W", 3)]
    intrinsics_px: Annotated[np.ndarray, array("f8", 4)]  # fx, fy, cx, cy
    world_from_camera: Annotated[np.ndarray, array("f8", 4, 4)]
    depth_m: Annotated[np.ndarray, array("f4", "H", "W")] | None = None


@dataclass(frozen=True, kw_only=True)
class Goal(Message):
    """The image to reach; without an image the agent explores."""

    rgb: Annotated[np.ndarray, array("u1", "H", "W", 3)] | None
    intrinsics_px: Annotated[np.ndarray, array("f8", 4)]


@dataclass(frozen=True, kw_only=True)
class Percept(Message):
    """What one object's network made of one image (paper, section 3.2), on `percept` and `goal_percept`.

    `pixel` is the centre (u, v) of the object; `scale` = 0.40 m / range; the deviations are calibrated.
    `reconstruction_error`: squared error of the decoded crop where the mask says that the object is seen, summed. The
    latent pose is seen from the camera. On `goal_percept` the camera's pose is unknown: the identity stands for it.
    `mask_bits`: whether the object is seen in each of MxM cells of the image, a row of cells packed into bytes.
    """

    VERSION: ClassVar[int] = 2

    object: str
    presence: float
    pixel: Annotated[np.ndarray, array("f8", 2)]
    pixel_std: float
    scale: float
    log_scale_std: float
    latent_mean: Annotated[np.ndarray, array("f4", "L")]
    latent_std: Annotated[np.ndarray, array("f4", "L")]
    intrinsics_px: Annotated[np.ndarray, array("f8", 4)]
    world_from_camera: Annotated[np.ndarray, array("f8", 4, 4)]
    reconstruction_error: float = 0.0
    mask_bits: Annotated[np.ndarray, array("u1", "M", "B")] | None = None

    def mask(self) -> np.ndarray | None:
        """Where in the image the object is seen: truth values [M, M]."""
        if self.mask_bits is None:
            return None
        return np.unpackbits(self.mask_bits, axis=1)[:, :len(self.mask_bits)].astype(bool)


@dataclass(frozen=True, kw_only=True)
class Belief(Message):
    """The posterior over one object: where it is and from where it would look like the goal.

    Position: mean [3] and covariance [3, 3] of the particle cloud (metres, world) and a sample of its particles.
    Goal view: log posterior [E, A] over the direction (elevation, azimuth; world axes, grid of `viewing_grid`) from
    which the object looks as in the goal image; absent while there is no goal or the object has not been seen.
    `presence`: probability that the object is in the scene; `views`: how many views the pose is fused from.
    `goal_range_m`: range at which the goal image shows it, by the measure of views alike; 0 without a posterior.
    `goal_here`: probability, by the present view alone, that the goal image was taken from about this direction.
    `f_*`: the terms of its variational free energy at this step, nats (paper, appendix A).
    """

    object: str
    presence: float
    world_from_camera: Annotated[np.ndarray, array("f8", 4, 4)]
    mean_m: Annotated[np.ndarray, array("f8", 3)]
    covariance_m2: Annotated[np.ndarray, array("f8", 3, 3)]
    particles_m: Annotated[np.ndarray, array("f4", "N", 3)]
    views: int
    goal_log_posterior: Annotated[np.ndarray, array("f4", "E", "A")] | None = None
    goal_range_m: float = 0.0
    goal_here: float = 0.0
    f_pose: float = 0.0
    f_identity: float = 0.0
    f_crop: float = 0.0
    f_position: float = 0.0
    f_likelihood: float = 0.0

    @property
    def free_energy(self) -> float:
        """Variational free energy F of this object at this step, nats (paper, appendix A): the sum of its terms."""
        return self.f_pose + self.f_identity + self.f_crop + self.f_position + self.f_likelihood


@dataclass(frozen=True, kw_only=True)
class Plan(Message):
    """The chosen viewpoint and the terms of its expected free energy G (paper, equation 5); G is their sum.

    `best_eyes_m`, `best_g`: the best of the candidates it was chosen from, best first, and their G (nats).
    """

    VERSION: ClassVar[int] = 2

    target: str
    mode: str
    viewpoint: Annotated[np.ndarray, array("f8", 4, 4)]
    look_at_m: Annotated[np.ndarray, array("f8", 3)]
    g_position: float  # -log P(t | v, goal): look at the goal object
    g_scale: float  # -log P(sigma | v, goal): at the desired scale
    g_pose: float  # -log P(p | v, goal): in the desired pose
    g_information: float  # minus the expected information gain about the positions, nats
    candidates: int
    goal_confidence: float  # that the goal image shows the target
    believed_distance_m: float  # from here to the goal's viewpoint as believed; infinite is not allowed: -1 if unknown
    arrived: bool
    best_eyes_m: Annotated[np.ndarray, array("f4", "N", 3)] | None = None
    best_g: Annotated[np.ndarray, array("f4", "N")] | None = None

    @property
    def g(self) -> float:
        """Expected free energy of the chosen viewpoint, nats."""
        return self.g_position + self.g_scale + self.g_pose + self.g_information


@dataclass(frozen=True, kw_only=True)
class Action(Message):
    """A relative move in world axes: metres, and rotation about the fixed axes x, y, z in radians; |each| <= 0.5.

    `arrived`: the agent says that with this move it is at the goal's view.
    """

    translation_m: Annotated[np.ndarray, array("f8", 3)]
    rotation_rad: Annotated[np.ndarray, array("f8", 3)]
    arrived: bool = False


@dataclass(frozen=True, kw_only=True)
class Truth(Message):
    """The simulator's ground truth, for evaluator, viewer and oracle only. `done`: no further frame will come.

    `keep_out_m`: radii of the spheres around the objects that the camera is pushed out of, in their order. The target's
    centre is also that of its place in the goal image where it does not stand on the table. `step` counts the actions.
    """

    scene: str
    target: str
    names: list[str]
    centers_m: Annotated[np.ndarray, array("f8", "N", 3)]
    yaws_rad: Annotated[np.ndarray, array("f8", "N")]
    keep_out_m: Annotated[np.ndarray, array("f8", "N")]
    target_center_m: Annotated[np.ndarray, array("f8", 3)]
    world_from_camera: Annotated[np.ndarray, array("f8", 4, 4)]
    goal_world_from_camera: Annotated[np.ndarray, array("f8", 4, 4)]
    success: bool
    done: bool
    declared: bool = False  # the agent has said that it had arrived
    declared_true: bool = False  # and was within tolerance when it first said so


@dataclass(frozen=True, kw_only=True)
class Result(Message):
    """How an episode ended. Errors are those of the last camera position in spherical coordinates of the target."""

    scene: str
    target: str
    objects: int
    success: bool
    steps: int
    azimuth_error_rad: float
    elevation_error_rad: float
    range_error_m: float
    declared: bool  # the agent said that it had arrived
    declared_true: bool  # and was within tolerance when it first said so


@dataclass(frozen=True, kw_only=True)
class Status(Message):
    """A service about itself: its state and what it counted since it started."""

    service: str
    state: str
    received: int = 0
    published: int = 0
    refused: int = 0
    skipped: int = 0
    gaps: int = 0
    milliseconds: float = 0.0  # of the last step
    note: str = ""


@functools.cache
def field_types(message_type: type[Message]) -> dict[str, Any]:
    """Field names and their annotations, in order."""
    hints = typing.get_type_hints(message_type, include_extras=True)
    return {f.name: hints[f.name] for f in dataclasses.fields(message_type)}
