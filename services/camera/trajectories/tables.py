"""Tables of poses, one a line: TUM trajectories, KITTI, and the ground truth of EuRoC."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from saccade.services.camera.trajectories.json_lines import require_new
from saccade.services.camera.trajectories.rigid import from_quaternion, rigid
from saccade.services.camera.trajectories.text import Line, later, lines_of, numbers_of, within, words_of
from saccade.services.camera.trajectories.trajectory import Asked, Key, Order, Stored
from saccade.shared.world.geometry import Array

NANOSECONDS = 1e17  # a first column beyond it is in nanoseconds since 1970
SINCE_1970 = ((NANOSECONDS, 1e-9), (1e14, 1e-6), (1e11, 1e-3))  # beyond what a time has which unit (seconds)
_TUM = "neither a JSON object nor the eight numbers of TUM: timestamp tx ty tz qx qy qz qw"
_KITTI = "not the twelve numbers of KITTI: the rows of a 3x4 matrix"
_EUROC = "not the first eight numbers of EuRoC: time in ns, position x y z, quaternion w x y z"


def header_of(text: str) -> list[str]:
    """The names of the columns, in lower case without units: those of the first line, with or without #. Empty if that
    line names none."""
    first = next((line.strip() for line in text[:4096].split("\n") if line.strip()), "").lower()
    words = [re.sub(r"\[.*?\]", "", word).strip() for word in words_of(first.lstrip("# "))]
    return words if words and words[0] in ("timestamp", "time", "t", "x") and len(words) >= 7 else []


def order_of(header: list[str], usual: Order) -> Order:
    """The order of the quaternion's columns by their names, or the usual one if they have none."""
    ends = [word.replace("_", "")[-1:] for word in header if word.startswith("q")]
    if ends[:1] == ["w"]:
        return "wxyz"
    return "xyzw" if ends[3:4] == ["w"] else usual


def columns_of(header: list[str]) -> list[int] | None:
    """Where the columns x, y, z of the position and qx, qy, qz, qw are, by their names. None if these do not tell."""
    if len(header) != 8:
        return None
    place = {("q" if word.startswith("q") else "") + word[-1:]: k for k, word in enumerate(header) if k}
    wanted = ("x", "y", "z", "qx", "qy", "qz", "qw")
    return [place[name] for name in wanted] if set(place) == set(wanted) else None


def data_of(path: Path, text: str) -> list[Line]:
    """The lines with numbers: without a line of names that is no comment."""
    lines = lines_of(path, text)
    if header_of(text) and lines[0][1][:1].isalpha():
        if len(lines) == 1:
            return lines_of(path, "")
        return lines[1:]
    return lines


def read_tum(path: Path, text: str, asked: Asked) -> Stored:
    """Reads `timestamp tx ty tz qx qy qz qw`, between blanks, tabs or commas, or in the order that a line of names
    tells. Lines may be in any order of time, which is in seconds, or since 1970 in a smaller unit. Raises SaccadeError
    with file:line if a line is damaged or repeats a time."""
    header = header_of(text)
    columns = None if asked.quaternion else columns_of(header)
    order = asked.quaternion or ("xyzw" if columns else order_of(header, "xyzw"))
    table: dict[Key, Array] = {}
    times: list[float] = []
    back = None
    for number, line in data_of(path, text):
        with within(path, f":{number}"):
            time_s, transform = _tum_line(line, order, columns)
            require_new(("time_s", time_s), table)
        back = back or (number if times and time_s < times[-1] else None)
        table["time_s", time_s] = transform
        times.append(time_s)
    notes = (f"the time goes back at line {back}: the poses are sorted by time",) if back else ()
    return Stored("tum", tuple(table), np.stack(list(table.values())), quaternion=order, times_s=np.array(times),
                  notes=notes)


def _tum_line(line: str, order: Order, columns: list[int] | None) -> tuple[float, Array]:
    try:
        numbers = numbers_of(line)
    except ValueError:
        numbers = []
    if len(numbers) != 8:
        raise ValueError(_TUM)
    time_s, *rest = [numbers[k] for k in (0, *columns)] if columns else numbers
    time_s *= next((unit for beyond, unit in SINCE_1970 if time_s >= beyond), 1.0)
    if not np.isfinite(time_s):
        raise ValueError("the time is not finite: leave out the line")
    return time_s, from_quaternion(rest[:3], rest[3:], order)


def read_kitti(path: Path, text: str) -> Stored:
    """Reads twelve numbers a line, the upper three rows of a matrix, for frames from 0. The world is the first camera:
    its y axis points down. Raises SaccadeError with file:line if a line is damaged."""
    transforms = []
    for number, line in lines_of(path, text):
        with within(path, f":{number}"):
            try:
                numbers = numbers_of(line)
            except ValueError:
                numbers = []
            if len(numbers) != 12:
                raise ValueError(_KITTI)
            transforms.append(rigid([*np.reshape(numbers, (3, 4)).tolist(), [0, 0, 0, 1]], "the matrix"))
    return Stored("kitti", tuple(("index", k) for k in range(len(transforms))), np.stack(transforms), up="-y")


def read_euroc(path: Path, text: str, asked: Asked) -> Stored:
    """Reads a CSV of time in nanoseconds, position, quaternion, and columns that do not matter. Raises SaccadeError
    with file:line if a line is damaged, or if the time goes back."""
    order = asked.quaternion or order_of(header_of(text), "wxyz")
    times: list[float] = []
    transforms = []
    for number, line in data_of(path, text):
        with within(path, f":{number}"):
            try:
                nanoseconds, *rest = numbers_of(line)
            except ValueError:
                rest = []
            if len(rest) < 7:
                raise ValueError(_EUROC)
            if not (np.isfinite(nanoseconds) and nanoseconds >= 0):
                raise ValueError("no time in nanoseconds: leave out the line")
            times.append(later(times[-1] if times else None, nanoseconds * 1e-9))
            transforms.append(from_quaternion(rest[:3], rest[3:7], order))
    note = ("EuRoC's ground truth is the pose of the body, the inertial sensor: if the camera is mounted elsewhere, "
            "multiply each pose by T_BS of the camera's sensor.yaml first")
    return Stored("euroc", tuple(("time_s", t) for t in times), np.stack(transforms), quaternion=order,
                  times_s=np.array(times), notes=(note,))
