"""A valid message of any type, made from its annotations."""

from __future__ import annotations

import typing
from typing import Annotated, Any

import numpy as np

from saccade.shared.bus.messages import Message, Percept, field_types, items_of
from saccade.shared.world.geometry import INTRINSICS_PX

DIMENSIONS = {"H": 4, "W": 5, "L": 8, "N": 3, "E": 6, "A": 7, "M": 10, "B": 2, "R": 4, "G": 2, "C": 3}
VALUES = {str: "mug", int: 3, float: 0.5, bool: True, list[str]: ["mug", "can"]}


def sample(message_type: type[Message], **changes: Any) -> Message:
    """Every field filled, also the optional ones. It is of the first of its kind."""
    filled: dict[str, Any] = {name: _value(hint) for name, hint in field_types(message_type).items()}
    if "instance" in filled:
        filled["instance"] = 1
    return message_type(**filled | changes)


def goal_percept(name: str) -> Percept:
    """What a goal image says that shows an object in its middle, 0.40 m away, and tells nothing of its pose."""
    return Percept(run="r", episode=0, step=0, object=name, presence=1.0, pixel=np.array([240.0, 240.0]), pixel_std=2.0,
                   scale=1.0, log_scale_std=0.05, latent_mean=np.zeros(0, np.float32),
                   latent_std=np.zeros(0, np.float32), intrinsics_px=np.array(INTRINSICS_PX),
                   world_from_camera=np.eye(4))


def array_fields(message_type: type[Message]) -> list[str]:
    """Names of the fields that hold arrays."""
    return [name for name, hint in field_types(message_type).items() if isinstance(_value(hint), np.ndarray)]


def _value(hint: Any) -> Any:
    if typing.get_origin(hint) is Annotated:
        spec = typing.get_args(hint)[1]
        shape = [DIMENSIONS.get(n, n) for n in spec.shape]
        return (np.arange(np.prod(shape)) % 200).reshape(shape).astype(spec.dtype)
    if items_of(hint) is not None:
        return []
    if hint in VALUES:
        return VALUES[hint]
    return _value(next(h for h in typing.get_args(hint) if h is not type(None)))
