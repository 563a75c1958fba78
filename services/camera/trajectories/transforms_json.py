"""`transforms.json` of nerfstudio, instant-ngp and the apps that write like them.

Each frame has a `transform_matrix`, world_from_camera in OpenGL camera axes. The intrinsics are those of the whole file
or of a frame: `fl_x fl_y cx cy w h`, or `camera_angle_x`, with the distortion `k1 k2 k3 k4 p1 p2`. The images
themselves are not opened: only the name at the end of `file_path` is used.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from saccade.services.camera.trajectories.lens import MAX_SIDE_PX, Lens, lens
from saccade.services.camera.trajectories.rigid import number, rigid
from saccade.services.camera.trajectories.text import MAX_POSES, within
from saccade.services.camera.trajectories.trajectory import Key, Stored
from saccade.shared.errors import SaccadeError, printable, told
from saccade.shared.files import parse_json
from saccade.shared.world.geometry import Array

LENS_KEYS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y", "camera_model", "is_fisheye",
             "k1", "k2", "k3", "k4", "p1", "p2")
PINHOLE, DISTORTED, FISHEYE = ("PINHOLE", "SIMPLE_PINHOLE"), ("OPENCV", "SIMPLE_RADIAL", "RADIAL"), "OPENCV_FISHEYE"
_NEED = "export it again, whole"


def json_of(path: Path, text: str, what: str) -> dict[str, Any]:
    """The map that a JSON file holds. Raises SaccadeError if it is damaged or holds something else."""
    try:
        tree = parse_json(text)
    except ValueError as error:
        raise SaccadeError(f"poses {path} are not whole JSON ({error}): {_NEED}") from error
    if not isinstance(tree, dict):
        raise SaccadeError(f"poses {path} are JSON, but not {what}: {_NEED}")
    return tree


def read_transforms(path: Path, text: str) -> Stored:
    """Reads a transforms.json. Raises SaccadeError, which names the frame, if something in it is wrong."""
    tree = json_of(path, text, "a transforms.json")
    frames = tree.get("frames")
    if not isinstance(frames, list) or not frames:
        raise SaccadeError(f"poses {path} hold no pose: a transforms.json needs a list of 'frames'")
    if len(frames) > MAX_POSES:
        raise SaccadeError(f"poses {path} holds more than {MAX_POSES} poses: leave out what no image needs")
    with within(path, ""):
        common = _lens(tree)
        matrix = tree.get("applied_transform")
        applied = None if matrix is None else rigid(_square(matrix), "applied_transform")
    table: dict[Key, Array] = {}
    lenses = []
    for k, frame in enumerate(frames):
        with within(path, f", frame {k}"):
            if not isinstance(frame, dict) or "transform_matrix" not in frame:
                raise ValueError(f"it has no transform_matrix: {_NEED}")
            key = _key(frame, k)
            if key in table:
                raise ValueError(f"a second pose for {key[0]} {printable(str(key[1]), 100)}: give the frames of one "
                                 "folder of images")
            table[key] = rigid(_square(frame["transform_matrix"]), "transform_matrix")
            own = any(name in frame for name in LENS_KEYS)
            lenses.append(_lens({**tree, **frame}) if own else common)
    if len({kind for kind, _ in table}) > 1:
        raise SaccadeError(f"poses {path}: some frames have a file_path and some have none: give it to all or to none")
    return Stored("transforms", tuple(table), np.stack(list(table.values())), axes="opengl",
                  lenses=_told_lenses(lenses), applied=applied, notes=_notes(tree, lenses))


def _told_lenses(lenses: list[Lens | None]) -> tuple[Lens, ...]:
    """The lenses that frames have: one if all are the same."""
    known = [x for x in lenses if x is not None]
    return tuple(known[:1]) if len(set(known)) == 1 else tuple(known)


def _notes(tree: Mapping[str, Any], lenses: list[Lens | None]) -> tuple[str, ...]:
    notes, scale, known = [], tree.get("applied_scale", 1.0), len(lenses) - lenses.count(None)
    if 0 < known < len(lenses):
        notes.append(f"{known} of {len(lenses)} frames have intrinsics: they are taken for all")
    if scale != 1.0:
        notes.append(f"applied_scale {told(scale)} is part of the poses: give its inverse as camera.poses_scale for "
                     "the unit before it")
    return tuple(notes)


def _square(rows: Any) -> Any:
    """A matrix of four rows: three rows get the row 0 0 0 1."""
    return [*rows, [0.0, 0.0, 0.0, 1.0]] if isinstance(rows, list) and len(rows) == 3 else rows


def _key(frame: Mapping[str, Any], k: int) -> Key:
    if "file_path" not in frame:
        return "index", k
    path = frame["file_path"]
    name = path.replace("\\", "/").rsplit("/", 1)[-1] if isinstance(path, str) else ""
    if not name:
        raise ValueError(f"file_path: {told(path)} is not the name of a file: give that of the frame's image")
    return "image", name


def _lens(tree: Mapping[str, Any]) -> Lens | None:
    """The lens of a file or of a frame, None if it tells none. Raises ValueError if no lens has such numbers."""
    given = {name: number(tree[name], name) for name in LENS_KEYS
             if name not in ("camera_model", "is_fisheye") and tree.get(name) is not None}
    model = tree.get("camera_model")
    if model is not None and model not in (*PINHOLE, *DISTORTED, FISHEYE):
        raise ValueError(f"camera_model: {told(model)} is not read: undistort the images to PINHOLE first")
    fisheye = model == FISHEYE or tree.get("is_fisheye") is True
    size = (given["w"], given["h"]) if "w" in given and "h" in given else None
    numbers = _focal(given)
    if numbers is None:
        if "camera_angle_x" not in given:
            return None
        return Lens(None, angle_x_rad=_angle(given, "camera_angle_x"), fisheye=fisheye,
                    distortion=_distortion(given, model))
    return lens({**numbers, **dict(_distortion(given, model))}, size, fisheye=fisheye)


def _focal(given: Mapping[str, float]) -> dict[str, float] | None:
    """fx, fy, cx and cy in pixels, or None if they are not told. What is left out is taken as in the middle, and fy as
    fx."""
    fx, fy = given.get("fl_x"), given.get("fl_y")
    if fx is None and "camera_angle_x" in given and "w" in given:
        fx = number(given["w"], "w", 0, MAX_SIDE_PX) / 2 / math.tan(_angle(given, "camera_angle_x") / 2)
        if fy is None and "camera_angle_y" in given and "h" in given:
            fy = number(given["h"], "h", 0, MAX_SIDE_PX) / 2 / math.tan(_angle(given, "camera_angle_y") / 2)
    fx = fy if fx is None else fx
    if fx is None:
        return None
    centre = {name: given.get(name, given[side] / 2 if side in given else None)
              for name, side in (("cx", "w"), ("cy", "h"))}
    if None in centre.values():
        raise ValueError("a focal length without w and h, or cx and cy: export it again, or give camera.intrinsics_px")
    return {"fx": fx, "fy": fx if fy is None else fy, **{k: v for k, v in centre.items() if v is not None}}


def _angle(given: Mapping[str, float], name: str) -> float:
    return number(given[name], name, 0, math.pi - 1e-3)


def _distortion(given: Mapping[str, float], model: Any) -> tuple[tuple[str, float], ...]:
    if model in PINHOLE:
        return ()
    return tuple((name, given[name]) for name in ("k1", "k2", "k3", "k4", "p1", "p2") if name in given)
