"""The messages on the wire: frozen dataclasses, MessagePack maps with named fields, arrays as one extension type.

Everything decoded is checked against the dataclass: an unknown field, a wrong type, shape or dtype, a value that is not
finite or a payload that is too long raises MessageError, which names the field. Nothing is ever unpickled.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import types
import typing
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

import msgpack
import numpy as np

ARRAY_EXTENSION = 1  # msgpack ext type: msgpack([dtype, shape]) followed by the array's bytes, row-major
MAX_SIDE = 8192
MAX_BYTES = 32 * 1024 * 1024
MAX_TEXT = 4096
HEADER_BYTES = 128  # of an array: more than any needs
STAMP_BYTES = 512  # and of the fields that all messages have


class MessageError(ValueError):
    """A payload that is not a valid message; the text names the field."""


@dataclass(frozen=True)
class ArraySpec:
    """dtype and shape of an array field; a str in the shape is a free dimension, equal wherever it is named."""

    dtype: str
    shape: tuple[int | str, ...]


def array(dtype: str, *shape: int | str) -> Any:
    """Annotation of an array field."""
    return Annotated[np.ndarray, ArraySpec(dtype, shape)]


@dataclass(frozen=True, kw_only=True)
class Message:
    """What every message carries. `seq` counts the messages of one key and is set by the publisher."""

    VERSION: ClassVar[int] = 1

    run: str
    episode: int
    step: int
    seq: int = 0


@dataclass(frozen=True, kw_only=True)
class Frame(Message):
    """What the camera sees. Depth along the optical axis in metres, where the source has it."""

    rgb: array("u1", "H", "W", 3)
    intrinsics_px: array("f8", 4)  # fx, fy, cx, cy
    world_from_camera: array("f8", 4, 4)
    depth_m: array("f4", "H", "W") | None = None


@dataclass(frozen=True, kw_only=True)
class Goal(Message):
    """The image to reach; without an image the agent explores."""

    rgb: array("u1", "H", "W", 3) | None
    intrinsics_px: array("f8", 4)


@dataclass(frozen=True, kw_only=True)
class Percept(Message):
    """What one object's network made of one image (paper, section 3.2), on `percept` and `goal_percept`.

    `pixel` is the centre (u, v) of the object; `scale` = 0.40 m / range; the deviations are calibrated.
    `reconstruction_error`: squared error of the decoded crop where the mask says that the object is seen, summed. The
    latent pose is seen from the camera. On `goal_percept` the camera's pose is unknown: the identity stands for it.
    """

    object: str
    presence: float
    pixel: array("f8", 2)
    pixel_std: float
    scale: float
    log_scale_std: float
    latent_mean: array("f4", "L")
    latent_std: array("f4", "L")
    intrinsics_px: array("f8", 4)
    world_from_camera: array("f8", 4, 4)
    reconstruction_error: float = 0.0


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
    world_from_camera: array("f8", 4, 4)
    mean_m: array("f8", 3)
    covariance_m2: array("f8", 3, 3)
    particles_m: array("f4", "N", 3)
    views: int
    goal_log_posterior: array("f4", "E", "A") | None = None
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
    """The chosen viewpoint and the terms of its expected free energy G (paper, equation 5); G is their sum."""

    target: str
    mode: str
    viewpoint: array("f8", 4, 4)
    look_at_m: array("f8", 3)
    g_position: float  # -log P(t | v, goal): look at the goal object
    g_scale: float  # -log P(sigma | v, goal): at the desired scale
    g_pose: float  # -log P(p | v, goal): in the desired pose
    g_information: float  # minus the expected information gain about the positions, nats
    candidates: int
    goal_confidence: float  # that the goal image shows the target
    believed_distance_m: float  # from here to the goal's viewpoint as believed; infinite is not allowed: -1 if unknown
    arrived: bool

    @property
    def g(self) -> float:
        """Expected free energy of the chosen viewpoint, nats."""
        return self.g_position + self.g_scale + self.g_pose + self.g_information


@dataclass(frozen=True, kw_only=True)
class Action(Message):
    """A relative move in world axes: metres, and rotation about the fixed axes x, y, z in radians; |each| <= 0.5.

    `arrived`: the agent says that with this move it is at the goal's view.
    """

    translation_m: array("f8", 3)
    rotation_rad: array("f8", 3)
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
    centers_m: array("f8", "N", 3)
    yaws_rad: array("f8", "N")
    keep_out_m: array("f8", "N")
    target_center_m: array("f8", 3)
    world_from_camera: array("f8", 4, 4)
    goal_world_from_camera: array("f8", 4, 4)
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


def _pack_array(value: Any) -> msgpack.ExtType:
    if not isinstance(value, np.ndarray):
        raise TypeError(f"cannot encode {type(value).__name__}")
    little = np.ascontiguousarray(value).astype(value.dtype.newbyteorder("<"), copy=False)
    return msgpack.ExtType(ARRAY_EXTENSION, msgpack.packb([little.dtype.str[1:], value.shape]) + little.tobytes())


def _unpack_array(code: int, data: bytes) -> np.ndarray:
    if code != ARRAY_EXTENSION:
        raise MessageError(f"unknown extension type {code}")
    unpacker = msgpack.Unpacker(max_buffer_size=HEADER_BYTES, max_array_len=16, max_str_len=8)
    unpacker.feed(data[:HEADER_BYTES])
    header = unpacker.unpack()
    if not (isinstance(header, list) and len(header) == 2 and header[0] in ("u1", "f4", "f8") and
            isinstance(header[1], list) and len(header[1]) <= 4 and
            all(isinstance(n, int) and 0 <= n <= MAX_SIDE for n in header[1])):
        raise MessageError("an array's header is not [dtype, shape]")
    dtype = np.dtype("<" + header[0]) if header[0] != "u1" else np.dtype("u1")
    start = unpacker.tell()
    if len(data) - start != dtype.itemsize * int(np.prod(header[1], dtype=object)):
        raise MessageError("an array's bytes do not fill its shape")
    return np.frombuffer(data, dtype, offset=start).reshape(header[1])


def encode(message: Message) -> bytes:
    """The wire bytes of a message; checks it first, so that no service can publish what another must refuse."""
    fields = {f.name: getattr(message, f.name) for f in dataclasses.fields(message)}
    _check(type(message), fields)
    return msgpack.packb({"type": type(message).__name__, "version": message.VERSION, **fields}, default=_pack_array)


class Stamp(NamedTuple):
    """What every message begins with."""

    run: str
    episode: int
    step: int
    seq: int


def stamp_of(payload: bytes) -> Stamp:
    """The stamp of an encoded message, without the rest of it. Raises MessageError for what does not begin with one."""
    unpacker = msgpack.Unpacker(max_buffer_size=STAMP_BYTES, max_str_len=STAMP_BYTES)
    unpacker.feed(payload[:STAMP_BYTES])
    try:
        unpacker.read_map_header()
        fields = {unpacker.unpack(): unpacker.unpack() for _ in range(2 + len(Stamp._fields))}
        stamp = Stamp(*(fields[name] for name in Stamp._fields))
    except Exception as error:  # msgpack raises many kinds for bytes that are not msgpack
        raise MessageError(f"does not begin with a stamp ({type(error).__name__})") from error
    if [type(value) for value in stamp] != [str, int, int, int]:
        raise MessageError("does not begin with a stamp")
    return stamp


def decode(message_type: type[Message], payload: bytes) -> Message:
    """The message in `payload`. Raises MessageError with the field that is wrong."""
    if len(payload) > MAX_BYTES:
        raise MessageError(f"{len(payload)} bytes, more than {MAX_BYTES}")
    try:
        fields = msgpack.unpackb(payload, ext_hook=_unpack_array, max_str_len=MAX_TEXT, max_array_len=256,
                                 max_map_len=64, strict_map_key=True)
    except MessageError:
        raise
    except Exception as error:  # msgpack raises many kinds for bytes that are not msgpack
        raise MessageError(f"not msgpack ({type(error).__name__})") from error
    if not isinstance(fields, dict) or fields.pop("type", None) != message_type.__name__:
        raise MessageError(f"type: not a {message_type.__name__}")
    if fields.pop("version", None) != message_type.VERSION:
        raise MessageError(f"version: not {message_type.VERSION}")
    _check(message_type, fields)
    return message_type(**fields)


@functools.cache
def field_types(message_type: type[Message]) -> dict[str, Any]:
    """Field names and their annotations, in order."""
    hints = typing.get_type_hints(message_type, include_extras=True)
    return {f.name: hints[f.name] for f in dataclasses.fields(message_type)}


@functools.cache
def _checks(message_type: type[Message]) -> dict[str, tuple[bool, Any]]:
    """For each field whether it may be absent, and its ArraySpec or type."""
    checks = {}
    for name, hint in field_types(message_type).items():
        optional = isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union
        if optional:
            hint = next(h for h in typing.get_args(hint) if h is not type(None))
        checks[name] = optional, typing.get_args(hint)[1] if typing.get_origin(hint) is Annotated else hint
    return checks


def _check(message_type: type[Message], fields: dict[str, Any]) -> None:
    checks = _checks(message_type)
    if fields.keys() != checks.keys():
        odd = sorted(fields.keys() ^ checks.keys())
        raise MessageError(f"{odd[0]}: {'unknown' if odd[0] in fields else 'missing'} field")
    dimensions: dict[str, int] = {}
    for name, (optional, kind) in checks.items():
        value = fields[name]
        if not (optional and value is None):
            _check_field(name, value, kind, dimensions)


def _check_field(name: str, value: Any, kind: Any, dimensions: dict[str, int]) -> None:
    if isinstance(kind, ArraySpec):
        _check_array(name, value, kind, dimensions)
    elif kind is float:
        if not isinstance(value, (float, int)) or isinstance(value, bool) or not math.isfinite(value):
            raise MessageError(f"{name}: not a finite number")
    elif kind == list[str]:
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
            raise MessageError(f"{name}: not a list of texts")
    elif type(value) is not kind:
        raise MessageError(f"{name}: {type(value).__name__}, not {kind.__name__}")
    elif kind is int and not 0 <= value < 2 ** 63:
        raise MessageError(f"{name}: out of range")


def _check_array(name: str, value: Any, spec: ArraySpec, dimensions: dict[str, int]) -> None:
    if not isinstance(value, np.ndarray) or value.dtype != np.dtype(spec.dtype):
        raise MessageError(f"{name}: not an array of {spec.dtype}")
    shape = [dimensions.setdefault(d, n) if isinstance(d, str) else d
             for d, n in zip(spec.shape, value.shape, strict=False)]
    if len(spec.shape) != value.ndim or list(value.shape) != shape or max(value.shape, default=0) > MAX_SIDE:
        raise MessageError(f"{name}: shape {list(value.shape)}, not {list(spec.shape)}")
    if value.dtype.kind == "f" and not np.isfinite(value).all():
        raise MessageError(f"{name}: not finite")
