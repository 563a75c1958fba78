"""The messages. Each one is a frozen dataclass, and its annotations define all of its fields. `shared/bus/wire.py`
encodes them."""

from __future__ import annotations

import dataclasses
import functools
import typing
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np

from saccade.shared.wording import label_of


@dataclass(frozen=True)
class ArraySpec:
    """dtype and shape of an array field. A name in the shape stands for any length; it is the same length wherever the
    name occurs in a message."""

    dtype: str
    shape: tuple[int | str, ...]


def array(dtype: str, *shape: int | str) -> ArraySpec:
    """Describes an array field in its annotation: `Annotated[np.ndarray, array("f4", "N", 3)]`."""
    return ArraySpec(dtype, shape)


@dataclass(frozen=True, kw_only=True)
class Message(metaclass=type):  # noqa: UP050 - without it mypy says that its classes cannot be keys of a cache
    """The fields that every message carries."""

    VERSION: ClassVar[int] = 1

    run: str
    """Name of the run."""
    episode: int
    """Number of the episode within the run, from 0."""
    step: int
    """Number of the step within the episode, from 0."""
    seq: int = 0
    """Number of the message among those of its key in this episode, from 0. The publisher sets it."""


AnyMessage = TypeVar("AnyMessage", bound=Message)


def mask_of(mask_bits: np.ndarray) -> np.ndarray:
    """Truth values [M, M] of a mask whose rows of cells are packed into bytes [M, B]."""
    return np.unpackbits(mask_bits, axis=1)[:, :len(mask_bits)].astype(bool)


@dataclass(frozen=True, kw_only=True)
class Frame(Message):
    """What the camera sees."""

    rgb: Annotated[np.ndarray, array("u1", "H", "W", 3)]
    """The image."""
    intrinsics_px: Annotated[np.ndarray, array("f8", 4)]
    """fx, fy, cx, cy in pixels."""
    world_from_camera: Annotated[np.ndarray, array("f8", 4, 4)]
    """Pose of the camera (OpenGL: it looks along its -z, +y is up; metres)."""
    depth_m: Annotated[np.ndarray, array("f4", "H", "W")] | None = None
    """Depth along the optical axis, where the source has it."""


@dataclass(frozen=True, kw_only=True)
class Goal(Message):
    """The image to reach. Without an image the agent explores.

    The fields about the place are there if the camera has a workspace of its own. Without them the rules of the paper
    hold: the camera stays in a box and outside of spheres around the objects, and the table top is at z = 0."""

    VERSION: ClassVar[int] = 2

    rgb: Annotated[np.ndarray, array("u1", "H", "W", 3)] | None
    """The image."""
    intrinsics_px: Annotated[np.ndarray, array("f8", 4)]
    """fx, fy, cx, cy in pixels."""
    workspace_m: Annotated[np.ndarray, array("f8", 2, 3)] | None = None
    """Lowest and highest corner of the box in which the camera stays."""
    shell_m: Annotated[np.ndarray, array("f8", 5)] | None = None
    """Centre (x, y, z), inner and outer radius of the shell in which the camera stays, as an arm reaches it."""
    table_m: Annotated[np.ndarray, array("f8", 3)] | None = None
    """Extents of the table along x and y, and the height z of its top."""
    obstacle_centers_m: Annotated[np.ndarray, array("f8", "B", 3)] | None = None
    """Centres of the boxes that are in the way."""
    obstacle_sizes_m: Annotated[np.ndarray, array("f8", "B", 3)] | None = None
    """Their sizes."""
    obstacle_yaws_rad: Annotated[np.ndarray, array("f8", "B")] | None = None
    """How they are turned about the vertical axis."""


@dataclass(frozen=True, kw_only=True)
class Percept(Message):
    """What the networks of one object made of one image (paper, section 3.2), on `percept` and `goal_percept`. On
    `goal_percept` the camera's pose is unknown: the identity stands for it."""

    VERSION: ClassVar[int] = 7

    object: str
    """Name of the object."""
    presence: float
    """Probability that the object is in the image."""
    pixel: Annotated[np.ndarray, array("f8", 2)]
    """Its centre (u, v)."""
    pixel_std: float
    """Calibrated standard deviation of the centre, pixels."""
    scale: float
    """0.40 m divided by its range."""
    log_scale_std: float
    """Calibrated standard deviation of the scale's logarithm."""
    latent_mean: Annotated[np.ndarray, array("f4", "L")]
    """Mean of its latent pose, as seen from the camera. It has no numbers if the networks estimate the pose itself."""
    latent_std: Annotated[np.ndarray, array("f4", "L")]
    """Standard deviation of its latent pose."""
    intrinsics_px: Annotated[np.ndarray, array("f8", 4)]
    """fx, fy, cx, cy of the image, in pixels."""
    world_from_camera: Annotated[np.ndarray, array("f8", 4, 4)]
    """Pose of the camera."""
    reconstruction_error: float = 0.0
    """Squared error of the decoded crop, summed over where the mask says that the object is seen."""
    mask_bits: Annotated[np.ndarray, array("u1", "M", "B")] | None = None
    """Whether the object is seen in each of MxM cells of the image: a row of cells packed into bytes."""
    camera_from_object: Annotated[np.ndarray, array("f8", 4, 4)] | None = None
    """Its pose in the camera's frame (metres; the object's frame has its origin at the centre of its box), from
    networks that estimate it in place of a latent pose."""
    rotations: Annotated[np.ndarray, array("f8", "R", 3, 3)] | None = None
    """Rotations camera_from_object that it may have, the likeliest first, from networks that tell more than one."""
    log_probability: Annotated[np.ndarray, array("f8", "R")] | None = None
    """Their log probabilities."""
    deviation_rad: Annotated[np.ndarray, array("f8", "R")] | None = None
    """Their standard deviations, radians."""
    goal_agreement: float | None = None
    """Share of the object's local features that agree with those in the goal image, where both are compared: where the
    object is about as large and about at the same place in the image."""
    goal_aside_rad: float | None = None
    """By how much the azimuth of the goal's view is larger than that of this one, as these features are turned and
    shifted."""
    goal_above_rad: float | None = None
    """By how much its elevation is larger."""
    goal_log_larger: float | None = None
    """Logarithm of how much larger than in the goal image the object is, by these features against `scale`."""
    further: list[Percept] = field(default_factory=list)
    """What else in the image may be one of its kind, the likeliest first. These have no further ones."""

    def each(self) -> list[Percept]:
        """All percepts of the kind, this one first."""
        return [self, *self.further]

    def mask(self) -> np.ndarray | None:
        """Where in the image the object is seen: truth values [M, M]. None if the message has no mask."""
        if self.mask_bits is None:
            return None
        return mask_of(self.mask_bits)


@dataclass(frozen=True, kw_only=True)
class Belief(Message):
    """The posterior over one object: where it is, and from where it would look like the goal. Of several of a kind the
    others are in `further`."""

    VERSION: ClassVar[int] = 3

    object: str
    """Name of the object."""
    presence: float
    """Probability that the object is in the scene."""
    world_from_camera: Annotated[np.ndarray, array("f8", 4, 4)]
    """Pose of the camera at this step."""
    mean_m: Annotated[np.ndarray, array("f8", 3)]
    """Mean of the particle cloud (world)."""
    covariance_m2: Annotated[np.ndarray, array("f8", 3, 3)]
    """Covariance of the particle cloud."""
    particles_m: Annotated[np.ndarray, array("f4", "N", 3)]
    """A sample of the particles."""
    views: int
    """How many views the pose is fused from."""
    goal_log_posterior: Annotated[np.ndarray, array("f4", "E", "A")] | None = None
    """Log posterior over the direction (elevation, azimuth; world axes; grid of `viewing_grid`) from which the
    object looks as in the goal image. Absent without a goal, or before the object was seen."""
    goal_range_m: float = 0.0
    """Range at which the goal image shows the object, by the measure of similar views. 0 without a posterior."""
    goal_here: float = 0.0
    """Probability, by the present view alone, that the goal image was taken from about this direction."""
    goal_rotations: Annotated[np.ndarray, array("f8", "G", 3, 3)] | None = None
    """Rotations world_from_camera from which the object looks as in the goal image, the likeliest first. They are there
    if the object may lie and the goal's camera may have been rolled; otherwise the direction says it."""
    goal_rotations_log_probability: Annotated[np.ndarray, array("f8", "G")] | None = None
    """Their log probabilities."""
    velocity_m: Annotated[np.ndarray, array("f8", 3)] | None = None
    """Its velocity (world), metres a step. Absent while it is believed to rest."""
    since_step: int = 0
    """Step since which it is believed to be as it is: at which it was last noticed to be moved or back. 0 if nothing
    has happened to it."""
    goal_agreement: float | None = None
    """Share of the local features of the present view that agree with those of the goal image, where both are compared.
    The posterior takes it into account."""
    f_pose: float = 0.0
    """Term of the variational free energy (paper, appendix A), nats: the latent pose."""
    f_identity: float = 0.0
    """The same: the identity."""
    f_crop: float = 0.0
    """The same: pixel and scale of the crop."""
    f_position: float = 0.0
    """The same: the position."""
    f_likelihood: float = 0.0
    """The same: the reconstruction of the crop."""
    instance: int = 1
    """Its number among those of its kind that were found in this episode, from 1. It stays the same."""
    further: list[Belief] = field(default_factory=list)
    """The others of its kind. Where there are several, the last one is one that was not seen yet and may be where
    nobody has looked. These have no further ones."""
    count_probabilities: Annotated[np.ndarray, array("f8", "C")] | None = None
    """Probabilities that none, one, two and so on of its kind are in the scene. Absent in `further`."""

    def each(self) -> list[Belief]:
        """The beliefs about all of its kind, this one first."""
        return [self, *self.further]

    def label(self) -> str:
        """Its name, with its number where it is not the first: `soup_can#2`."""
        return label_of(self.object, self.instance)

    def count(self) -> tuple[int, float]:
        """How many of its kind are most likely in the scene, and the probability of this."""
        shares = np.array([1.0 - self.presence, self.presence]) if self.count_probabilities is None \
            else self.count_probabilities
        return int(np.argmax(shares)), float(np.max(shares))

    @property
    def free_energy(self) -> float:
        """Variational free energy F of this object at this step, nats (paper, appendix A): the sum of its terms."""
        return self.f_pose + self.f_identity + self.f_crop + self.f_position + self.f_likelihood


@dataclass(frozen=True, kw_only=True)
class Events(Message):
    """What the belief noticed with one image: objects that are not where they were. Mostly there are none."""

    VERSION: ClassVar[int] = 2

    objects: list[str]
    """Names of the objects, one for each event."""
    kinds: list[str]
    """What happened to each: `moved`, `gone`, `back`, `drifts`, or `rests` after it has drifted."""
    positions_m: Annotated[np.ndarray, array("f8", "N", 3)]
    """Where each is believed to be now; of one that is gone, where it was."""
    probabilities: Annotated[np.ndarray, array("f8", "N")]
    """Probability of each event, by what was seen."""
    instances: Annotated[np.ndarray, array("u1", "N")]
    """Their numbers among those of their kind, as the beliefs have them."""

    def labels(self) -> list[str]:
        """The objects' names, with their numbers where they are not the first: `soup_can#2`."""
        return [label_of(name, number) for name, number in zip(self.objects, self.instances.tolist(), strict=True)]


@dataclass(frozen=True, kw_only=True)
class Plan(Message):
    """The chosen viewpoint and the terms of its expected free energy G (paper, equation 5). G is their sum."""

    VERSION: ClassVar[int] = 3

    target: str
    """The object that the goal image shows; empty while exploring."""
    mode: str
    """`search`, `approach` or `goal`."""
    viewpoint: Annotated[np.ndarray, array("f8", 4, 4)]
    """Pose of the camera to move to."""
    look_at_m: Annotated[np.ndarray, array("f8", 3)]
    """Point that the viewpoint looks at."""
    g_position: float
    """-log P(t | v, goal): look at the goal object."""
    g_scale: float
    """-log P(sigma | v, goal): at the desired scale."""
    g_pose: float
    """-log P(p | v, goal): in the desired pose."""
    g_information: float
    """Minus the expected information gain about the positions, nats."""
    candidates: int
    """How many candidates it was chosen from."""
    goal_confidence: float
    """Probability that the goal image shows the target."""
    believed_distance_m: float
    """Distance to the goal's viewpoint as believed, -1 if unknown."""
    arrived: bool
    """The agent says that it is at the goal's view."""
    best_eyes_m: Annotated[np.ndarray, array("f4", "N", 3)] | None = None
    """Positions of the best candidates, best first."""
    best_g: Annotated[np.ndarray, array("f4", "N")] | None = None
    """Their G, nats."""
    target_instance: int = 1
    """Number of the one of the target's kind that the viewpoint shows, as the beliefs have it."""

    @property
    def g(self) -> float:
        """Expected free energy of the chosen viewpoint, nats."""
        return self.g_position + self.g_scale + self.g_pose + self.g_information


@dataclass(frozen=True, kw_only=True)
class Action(Message):
    """A relative move in world axes. The absolute value of each number is at most 0.5."""

    translation_m: Annotated[np.ndarray, array("f8", 3)]
    """Move of the camera."""
    rotation_rad: Annotated[np.ndarray, array("f8", 3)]
    """Rotation about the fixed axes x, y and z, in this order."""
    arrived: bool = False
    """The agent says that with this move it is at the goal's view."""


@dataclass(frozen=True, kw_only=True)
class Truth(Message):
    """The simulator's ground truth, for evaluator, viewer and oracle only. `step` counts the actions.

    Fields that are absent have the value of a scene as the paper's: each object stands upright and is there once."""

    VERSION: ClassVar[int] = 2

    scene: str
    """Id of the scene."""
    target: str
    """Object of the goal."""
    names: list[str]
    """Objects on the table."""
    centers_m: Annotated[np.ndarray, array("f8", "N", 3)]
    """Centres of their boxes."""
    yaws_rad: Annotated[np.ndarray, array("f8", "N")]
    """How they are turned about the vertical axis. 0 where `rotations` tell it."""
    keep_out_m: Annotated[np.ndarray, array("f8", "N")]
    """Radii of the spheres around them that the camera is pushed out of."""
    target_center_m: Annotated[np.ndarray, array("f8", 3)]
    """Centre of the target, or of its place in the goal image where it does not stand on the table. Of several of its
    kind it is the one that the nearest goal pose shows."""
    world_from_camera: Annotated[np.ndarray, array("f8", 4, 4)]
    """Pose of the camera."""
    goal_world_from_camera: Annotated[np.ndarray, array("f8", 4, 4)]
    """Pose of the camera that took the goal image. It moves with the target. If the target is symmetric, or there are
    several of its kind, it is the nearest one to the camera of all poses that show the same."""
    success: bool
    """The camera is, or was, within the tolerance of the goal's pose."""
    done: bool
    """No further frame will come."""
    declared: bool = False
    """The agent has said that it had arrived."""
    declared_true: bool = False
    """It was within the tolerance when it first said so."""
    instances: Annotated[np.ndarray, array("u1", "N")] | None = None
    """Their numbers among the objects of the same name, from 1."""
    target_instance: int = 1
    """Number of the target at `target_center_m`."""
    rotations: Annotated[np.ndarray, array("f8", "N", 3, 3)] | None = None
    """Their rotations world_from_object. The object's frame is that of its mesh, with its origin at the centre."""
    sizes_m: Annotated[np.ndarray, array("f8", "N", 3)] | None = None
    """Sizes of their boxes, in their own frames. The camera stays away from these boxes in a workspace."""
    in_view: Annotated[np.ndarray, array("f8", "N")] | None = None
    """Share of each, from 0 to 1, that the camera sees: not hidden by others and within the image."""
    events: list[str] | None = None
    """What happened to objects with this step, such as `moved soup_can#2`."""

    def labels(self) -> list[str]:
        """The objects' names, with their numbers where there are several: `soup_can`, `soup_can#2`."""
        numbers = [] if self.instances is None else self.instances.tolist()
        numbers += [1] * (len(self.names) - len(numbers))
        return [label_of(name, number) for name, number in zip(self.names, numbers, strict=False)]

    def world_from_objects(self) -> np.ndarray:
        """Rotations world_from_object [N, 3, 3] of all objects, whichever way they are told."""
        if self.rotations is not None:
            return self.rotations
        cosines, sines = np.cos(self.yaws_rad), np.sin(self.yaws_rad)
        turned = np.zeros((len(self.yaws_rad), 3, 3))
        turned[:, 0, 0] = turned[:, 1, 1] = cosines
        turned[:, 1, 0], turned[:, 0, 1], turned[:, 2, 2] = sines, -sines, 1.0
        return turned


@dataclass(frozen=True, kw_only=True)
class Result(Message):
    """How an episode ended. Errors are those of the last camera position, spherical, around the target."""

    scene: str
    """Id of the scene."""
    target: str
    """Object of the goal."""
    objects: int
    """How many objects stood on the table."""
    success: bool
    """Whether the goal was reached."""
    steps: int
    """Steps that were taken."""
    azimuth_error_rad: float
    """Azimuth error."""
    elevation_error_rad: float
    """Elevation error."""
    range_error_m: float
    """Range error."""
    declared: bool
    """The agent said that it had arrived."""
    declared_true: bool
    """It was within the tolerance when it first said so."""


@dataclass(frozen=True, kw_only=True)
class Status(Message):
    """A service about itself: its state, and what it counted since it started."""

    service: str
    """Name of the service."""
    state: str
    """`starting`, `ready`, `busy`, `finished`, `stopped` or `failed`."""
    received: int = 0
    """Messages received."""
    published: int = 0
    """Messages published."""
    refused: int = 0
    """Messages that were no valid ones."""
    skipped: int = 0
    """Steps that it could not take."""
    gaps: int = 0
    """Messages that sequence numbers say are missing."""
    milliseconds: float = 0.0
    """Duration of the last step."""
    note: str = ""
    """What it says in words."""


def items_of(hint: Any) -> type[Message] | None:
    """The type of the messages that a field of this annotation lists. None if it lists none."""
    inner = typing.get_args(hint)
    is_list = typing.get_origin(hint) is list and isinstance(inner[0], type) and issubclass(inner[0], Message)
    return inner[0] if is_list else None


@functools.cache
def field_types(message_type: type[Message]) -> dict[str, Any]:
    """Names and annotations of a message's fields, in their order."""
    hints = typing.get_type_hints(message_type, include_extras=True)
    return {f.name: hints[f.name] for f in dataclasses.fields(message_type)}
