"""The calibration of a camera: its intrinsics and the distortion of its lens, as `saccade calibrate` writes them."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, FiniteFloat, model_validator

from saccade.services.camera.trajectories.lens import MAX_SIDE_PX, Lens, lens
from saccade.shared.config import Section, checked
from saccade.shared.errors import SaccadeError, told
from saccade.shared.files import MIB, parse_toml, read_text, replace_whole, writing
from saccade.shared.wording import WORLD

MAX_FILE_BYTES = 1 * MIB
SUFFIX = ".toml"
PINHOLE, FISHEYE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), ("k1", "k2", "k3", "k4")  # in OpenCV's order
COUNTS = {"pinhole": (0, 4, 5, 8), "fisheye": (4,)}
_NEED = "give a file that `saccade calibrate` wrote, or calibrate the camera again"

Side = Annotated[int, Field(ge=1, le=MAX_SIDE_PX)]


class Calibration(Section):
    """What is known of a camera."""

    size_px: tuple[Side, Side]
    """Width and height of the images."""
    model: Literal["pinhole", "fisheye"] = "pinhole"
    """OpenCV's model of the lens."""
    intrinsics_px: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
    """fx, fy, cx, cy, counted from the corner of the first pixel. OpenCV counts from its centre."""
    distortion: tuple[FiniteFloat, ...] = ()
    """OpenCV's coefficients: k1, k2, p1, p2, k3, k4, k5, k6, or the four of a fisheye."""
    rms_px: float | None = Field(None, ge=0)
    """Root mean square distance between the corners that were found and where the model puts them."""
    views: int | None = Field(None, ge=1)
    """How many images were used."""

    @model_validator(mode="after")
    def _is_a_lens(self) -> Calibration:
        if len(self.distortion) not in COUNTS[self.model]:
            counts = " or ".join(map(str, COUNTS[self.model]))
            raise ValueError(f"distortion has {len(self.distortion)} numbers, a {self.model} has {counts}")
        _ = self.lens  # raises ValueError if no lens has such numbers
        return self

    @property
    def lens(self) -> Lens:
        """The lens for images of `size_px`."""
        names = FISHEYE if self.model == "fisheye" else PINHOLE
        numbers = dict(zip(("fx", "fy", "cx", "cy"), self.intrinsics_px, strict=True))
        numbers |= dict(zip(names, self.distortion, strict=False))
        return lens(numbers, self.size_px, fisheye=self.model == "fisheye")

    def write(self, path: Path) -> None:
        """Writes the calibration as TOML, whole or not at all. Raises SaccadeError if it cannot be written."""
        lines = [f"size_px = {list(self.size_px)}", f'model = "{self.model}"',
                 f"intrinsics_px = {[round(x, 4) for x in self.intrinsics_px]}  # fx, fy, cx, cy",
                 f"distortion = {[float(f'{x:.8g}') for x in self.distortion]}"]
        lines += [f"rms_px = {self.rms_px:.4f}"] if self.rms_px is not None else []
        lines += [f"views = {self.views}"] if self.views is not None else []
        with writing(path, "calibration"):
            path.parent.mkdir(parents=True, exist_ok=True)
            replace_whole(path, ("\n".join(lines) + "\n").encode())


def cameras_folder() -> Path:
    """Where calibrations are kept under a camera's name."""
    return Path(os.environ.get("XDG_DATA_HOME", Path.home() / ".local" / "share")) / "saccade" / "cameras"


def calibration_path(text: str) -> Path:
    """The file of a calibration: a path, or the name of a camera under which it is kept."""
    if os.sep in text or text.endswith(SUFFIX) or os.path.exists(text):
        return Path(text)
    return kept_as(text)


def kept_as(name: str) -> Path:
    """The file of the calibration that is kept under a name. Raises SaccadeError if no file can have the name."""
    if not re.fullmatch(WORLD, name):
        raise SaccadeError(f"a camera cannot be named {told(name)}: use letters, digits, '-' and '_'")
    return cameras_folder() / f"{name}{SUFFIX}"


def read_calibration(text: str) -> Calibration:
    """Reads a calibration by its path or by its camera's name. Raises SaccadeError if it is missing or damaged."""
    path = calibration_path(text)
    content = read_text(path, "calibration", _NEED, MAX_FILE_BYTES)
    try:
        tree = parse_toml(content)
    except ValueError as error:
        raise SaccadeError(f"calibration {path} is not TOML ({error}): {_NEED}") from error
    return checked(Calibration, tree, f"calibration {path}, {{}}")
