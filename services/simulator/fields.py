"""Checks of what a scenes file says: each raises ValueError, which names the key, before anything is built."""

from __future__ import annotations

from collections.abc import Set
from typing import Any

import numpy as np
from numpy.typing import NDArray

from saccade.shared.errors import is_text, told

MAX_ID = 256  # characters of an id or a name: it is in messages and in file names
# What is further is not seen
MAX_NUMBERS = {"center_xyz_m": 10.0, "goal_world_from_camera": 10.0, "start_world_from_camera": 10.0, "yaw_rad": 1e4,
               "quaternion_xyzw": 1e4, "about_xy_m": 10.0, "turn_rad": 1.0}


def check_text(entry: dict[str, Any], key: str) -> str:
    """Returns a text that fits into messages and file names."""
    text = entry[key]
    if not isinstance(text, str) or not text:
        raise ValueError(f"{key} must be a text")
    if len(text) > MAX_ID:
        raise ValueError(f"{key} has {len(text)} characters: shorten it to {MAX_ID}")
    if not is_text(text):
        raise ValueError(f"{key} must be Unicode without control codes: remove what is none")
    return text


def check_keys(entry: Any, required: Set[str], optional: Set[str] = frozenset()) -> None:
    """Refuses what is not a map, lacks a key or has an unknown one."""
    if not isinstance(entry, dict):
        raise ValueError("not a map")
    if missing := sorted(required - entry.keys()):
        raise ValueError(f"{missing[0]} is missing")
    if unknown := sorted(entry.keys() - required - optional):
        raise ValueError(f"{told(unknown[0])[1:-1]} is unknown: remove it")


def numbers(entry: dict[str, Any], key: str, shape: tuple[int, ...], low: float = -np.inf,
            high: float = np.inf) -> NDArray[np.float64]:
    """Returns finite numbers of a shape, each from `low` to `high`."""
    if not _has_shape(entry[key], shape):
        raise ValueError(f"{key} must be numbers of shape {list(shape)}")
    try:
        raw = np.array(entry[key], dtype=np.float64)
    except OverflowError as error:
        raise ValueError(f"{key} is larger than any number here") from error
    if not np.isfinite(raw).all():
        raise ValueError(f"{key} is not finite")
    if np.abs(raw).max() > (most := MAX_NUMBERS.get(key, np.inf)):
        raise ValueError(f"{key} must be within ±{most:g}")
    if raw.min() < low or raw.max() > high:
        raise ValueError(f"{key} must be from {low:g} to {high:g}")
    return raw


def number(entry: dict[str, Any], key: str, low: float = -np.inf, high: float = np.inf) -> float:
    """Returns one number from `low` to `high`."""
    return float(numbers(entry, key, (), low, high))


def whole(entry: dict[str, Any], key: str, low: int, high: int, default: int | None = None) -> int:
    """Returns a whole number from `low` to `high`. With a default the key may be missing."""
    value = entry[key] if default is None else entry.get(key, default)
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise ValueError(f"{key} must be a whole number from {low} to {high}")
    return value


def colour(entry: dict[str, Any], key: str) -> tuple[int, int, int]:
    """Returns a colour: three whole numbers from 0 to 255."""
    rgb = numbers(entry, key, (3,))
    if not ((rgb >= 0) & (rgb <= 255) & (rgb == rgb.round())).all():
        raise ValueError(f"{key} must be three whole numbers from 0 to 255")
    red, green, blue = (int(value) for value in rgb)
    return red, green, blue


def flag(entry: dict[str, Any], key: str, *, default: bool) -> bool:
    """Returns a truth value."""
    value = entry.get(key, default)
    if not isinstance(value, bool):
        raise ValueError(f"{key} must be true or false")
    return value


def rigid(entry: dict[str, Any], key: str) -> NDArray[np.float64]:
    """Returns a rigid transform [4, 4]."""
    transform = numbers(entry, key, (4, 4))
    rotation = transform[:3, :3]
    if (np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-4 or np.linalg.det(rotation) < 0
            or np.abs(transform[3] - (0, 0, 0, 1)).max() > 1e-6):
        raise ValueError(f"{key} is not a rigid transform")
    return transform


def entries(entry: dict[str, Any], key: str, most: int) -> list[Any]:
    """Returns a list with at most so many entries. It is empty if the key is missing."""
    values = entry.get(key, [])
    if not isinstance(values, list):
        raise ValueError(f"{key} must be a list")
    if len(values) > most:
        raise ValueError(f"{key} has {len(values)} entries, more than {most}: remove some")
    return values


def _has_shape(value: Any, shape: tuple[int, ...]) -> bool:
    """Whether it is lists of that shape with nothing but numbers in them, before an array is made of it."""
    if not shape:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return isinstance(value, list) and len(value) == shape[0] and all(_has_shape(one, shape[1:]) for one in value)
