"""What the fields of a message hold, according to its dataclass. All exports derive their columns from this."""

from __future__ import annotations

import math
import types
import typing
from typing import Annotated, Any

from saccade.shared.bus.messages import ArraySpec, Message, field_types, items_of

IMAGE = "u1"  # the dtype of images; nothing else has it


def kinds(message_type: type[Message]) -> dict[str, Any]:
    """Every field and what it holds if it is not absent: an ArraySpec, or one of str, int, float, bool, list[str]. Of a
    field that lists messages it is how many there are."""
    return {name: _kind(hint) for name, hint in field_types(message_type).items()}


def fixed_numbers(spec: ArraySpec) -> int | None:
    """How many numbers an array always has. None if one of its dimensions can have any length."""
    sides = [side for side in spec.shape if not isinstance(side, str)]
    return math.prod(sides) if len(sides) == len(spec.shape) else None


def value_of(message: Message, name: str) -> Any:
    """The value of a field. Of one that lists messages it is how many there are."""
    value = getattr(message, name)
    return len(value) if items_of(field_types(type(message)).get(name)) is not None else value


def _kind(hint: Any) -> Any:
    if items_of(hint) is not None:
        return int
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        hint = next(h for h in typing.get_args(hint) if h is not type(None))
    return typing.get_args(hint)[1] if typing.get_origin(hint) is Annotated else hint
