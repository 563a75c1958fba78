"""Saccade's own format: one JSON object per line, `{"image": "a.png", "world_from_camera": 4x4}`.

"index" (from 0) or "time_s" can stand in place of "image". A camera that stands still has one line without any of the
three. Blank lines, and lines that begin with #, are ignored.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from saccade.services.camera.trajectories.rigid import rigid
from saccade.services.camera.trajectories.text import lines_of, within
from saccade.services.camera.trajectories.trajectory import STILL, Key, Stored
from saccade.shared.errors import printable, told
from saccade.shared.files import parse_json
from saccade.shared.world.geometry import Array


def read_json_lines(path: Path, text: str) -> Stored:
    """Reads JSON lines. Raises SaccadeError with file:line if a line is damaged or repeats another one."""
    table: dict[Key, Array] = {}
    for number, line in lines_of(path, text):
        with within(path, f":{number}"):
            key, transform = _json_line(line)
            require_new(key, table)
            if table and STILL in (key, *table):
                raise ValueError("a pose without image, index or time_s holds for all images: give no other pose")
        table[key] = transform
    return Stored("json-lines", tuple(table), np.stack(list(table.values())), axes="opengl")


def require_new(key: Key, table: dict[Key, Array]) -> None:
    """Raises ValueError if the key is there already."""
    if key in table:
        raise ValueError(f"a second pose for {key[0]} {printable(str(key[1]), 100)}: leave one of them out")


def _json_line(line: str) -> tuple[Key, Array]:
    try:
        tree: Any = parse_json(line)
    except ValueError as error:
        raise ValueError(f"not JSON ({error})") from error
    if not isinstance(tree, dict) or "world_from_camera" not in tree or len(tree) > 2:
        raise ValueError('give {"world_from_camera": 4x4} and one of image, index and time_s')
    kind, value = next(((k, v) for k, v in tree.items() if k != "world_from_camera"), STILL)
    kinds: dict[str, Any] = {"image": str, "index": int, "time_s": (int, float), "still": type(None)}
    if kind not in kinds:
        raise ValueError(f"unknown key {told(kind)}: give one of image, index and time_s")
    if not isinstance(value, kinds[kind]) or isinstance(value, bool):
        raise ValueError(f"{kind}: {told(value)} is not a {'text' if kind == 'image' else 'number'}")
    if kind == "time_s" and not math.isfinite(value):
        raise ValueError(f"time_s: {value} is not finite")
    if kind == "index" and not 0 <= value < 2 ** 63:
        raise ValueError("index: no image has such a number")
    return (kind, value), rigid(tree["world_from_camera"])
