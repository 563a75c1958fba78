"""Reads the poses of a file or folder in any known format, which is recognised by name and content."""

from __future__ import annotations

import os
from pathlib import Path

from saccade.services.camera.trajectories.colmap import read_colmap_text
from saccade.services.camera.trajectories.colmap_binary import read_colmap_binary
from saccade.services.camera.trajectories.json_lines import read_json_lines
from saccade.services.camera.trajectories.phones import metadata_of, read_record3d, read_stray
from saccade.services.camera.trajectories.tables import NANOSECONDS, header_of, read_euroc, read_kitti, read_tum
from saccade.services.camera.trajectories.text import NEED, text_of, words_of
from saccade.services.camera.trajectories.trajectory import Asked, Stored, Trajectory, in_the_agents_world
from saccade.services.camera.trajectories.transforms_json import read_transforms
from saccade.shared.config import PosesFormat
from saccade.shared.errors import SaccadeError
from saccade.shared.files import opened

HEAD_BYTES = 65_536  # of a file, by which its format is told
ZIP = b"PK\x03\x04"
WITHIN: dict[str, PosesFormat] = {  # what tells the format of a folder
    "odometry.csv": "stray", "transforms.json": "transforms", "images.bin": "colmap", "images.txt": "colmap",
    "sparse/0/images.bin": "colmap", "sparse/0/images.txt": "colmap", "sparse/images.bin": "colmap",
    "sparse/images.txt": "colmap", "metadata": "record3d"}
BESIDE = {"cameras.bin": "images.bin", "cameras.txt": "images.txt", "camera_matrix.csv": "odometry.csv"}


def read_trajectory(path: Path, asked: Asked = Asked()) -> Trajectory:  # noqa: B008
    """Reads the poses of a camera, and converts them into the agent's axes and units.

    Raises SaccadeError, which names the line or the frame, if the file cannot be read, is damaged or too large, is of
    no known format, or does not fit what is asked.
    """
    file = _file(path, asked)
    with opened(file, "poses", NEED, 2 ** 62) as stream:  # how large it may be depends on its format
        head = stream.read(HEAD_BYTES)
    return in_the_agents_world(_stored(file, head, asked), asked, file)


def _file(path: Path, asked: Asked) -> Path:
    """The file that holds the poses: of a folder, the one that tells its format."""
    if os.path.isdir(path):
        found = next((path / name for name, kind in WITHIN.items()
                      if asked.format in (None, kind) and os.path.isfile(path / name)), None)
        if found is None:
            raise SaccadeError(f"poses {path} cannot be read (it is a folder, not a file, and holds none of "
                               f"{', '.join(WITHIN)}): {NEED}")
        return found
    beside = BESIDE.get(path.name)
    return path.with_name(beside) if beside and os.path.isfile(path.with_name(beside)) else path


def _stored(path: Path, head: bytes, asked: Asked) -> Stored:
    if head.startswith(ZIP):
        _require(path, asked, "record3d")
        return read_record3d(path, metadata_of(path), asked)
    if path.name == "images.bin" or (asked.format == "colmap" and b"\0" in head):
        _require(path, asked, "colmap")
        return read_colmap_binary(path, asked)
    start = head.decode("utf-8", "ignore").removeprefix("\ufeff")
    if asked.format == "colmap" or (asked.format is None and _is_colmap(path, start)):
        return read_colmap_text(path, asked)
    text = text_of(path)
    kind = asked.format or _format(text)
    if kind == "json-lines":
        return read_json_lines(path, text)
    if kind == "transforms":
        return read_transforms(path, text)
    if kind == "record3d":
        return read_record3d(path, text, asked)
    if kind == "stray":
        return read_stray(path, asked)
    if kind == "kitti":
        return read_kitti(path, text)
    return read_euroc(path, text, asked) if kind == "euroc" else read_tum(path, text, asked)


def _require(path: Path, asked: Asked, found: PosesFormat) -> None:
    if asked.format not in (None, found):
        raise SaccadeError(f"camera.poses_format {asked.format}: poses {path} are {found}: leave the key out")


def _is_colmap(path: Path, start: str) -> bool:
    comments = [line for line in start.split("\n") if line.startswith("#")]
    return path.name == "images.txt" or any("IMAGE_ID" in line and "QW" in line for line in comments)


def _format(text: str) -> PosesFormat:
    """The format of a text that is not COLMAP's."""
    lines = (line.strip() for line in text.split("\n"))
    first = next((line for line in lines if line and not line.startswith("#")), "")
    if first.startswith("{"):
        if '"world_from_camera"' in first:
            return "json-lines"
        if '"frames"' in text:
            return "transforms"
        return "record3d" if '"poses"' in text else "json-lines"
    header = header_of(text)
    if "frame" in header or header[:1] == ["x"]:
        return "stray"
    data = next(lines, "") if header and first[:1].isalpha() else first
    words = words_of(data[:4096])
    if len(words) == 12:
        return "kitti"
    if "," in data and (len(words) == 17 or _is_nanoseconds(words[0]) or "[ns]" in text[:4096].split("\n")[0]):
        return "euroc"
    return "tum"


def _is_nanoseconds(word: str) -> bool:
    try:
        return float(word) >= NANOSECONDS
    except ValueError:
        return False
