"""What the fields of a message hold, read off its dataclass: what every export derives its columns from."""

from __future__ import annotations

import math
import types
import typing
from typing import Annotated, Any

from saccade.shared.bus.messages import ArraySpec, Message, field_types

IMAGE = "u1"  # the dtype of images, and of nothing else


def kinds(message_type: type[Message]) -> dict[str, Any]:
    """Every field and what it holds, absent or not: an ArraySpec, or one of str, int, float, bool, list[str]."""
    return {name: _kind(hint) for name, hint in field_types(message_type).items()}


def fixed_numbers(spec: ArraySpec) -> int | None:
    """How many numbers an array always has; None where a dimension is free."""
    sides = [side for side in spec.shape if not isinstance(side, str)]
    return math.prod(sides) if len(sides) == len(spec.shape) else None


def _kind(hint: Any) -> Any:
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        hint = next(h for h in typing.get_args(hint) if h is not type(None))
    return typing.get_args(hint)[1] if typing.get_origin(hint) is Annotated else hint
