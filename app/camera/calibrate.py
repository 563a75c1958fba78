"""`saccade calibrate`: looks for the board in images, finds the lens, and writes it with a picture of what is left."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track

from saccade.app.camera.residuals import draw_residuals
from saccade.app.camera.solving import Model, Solved, View, is_of_use, solve
from saccade.services.camera.charuco import Board, Finder, read_board
from saccade.services.camera.sources import Folder, Source, SourceImage, open_source
from saccade.shared.errors import SaccadeError
from saccade.shared.world.images import Size

MOST_IMAGES = 1000  # that are looked at
EVERY_S = 0.2  # of a video; images in between show nearly the same
CELLS, COVERED = 5, 0.6  # of the image on each side; share of them that should have corners


def calibrate(source: str, board: Path, model: Model, out: Path, console: Console) -> Iterator[str]:
    """Calibrates a camera from a folder or a video, writes the calibration to `out` and a picture beside it, and yields
    what was found, line by line.

    Raises SaccadeError if the board or the images cannot be read, or if the views do not suffice.
    """
    described = read_board(board)
    images = open_source(source)
    if images.endless:
        raise SaccadeError(f"{source} never ends: record a video of the board, and give its file")
    if out.suffix.lower() != ".toml":
        raise SaccadeError(f"{out} cannot be a calibration: let its name end in .toml")
    views, looked = find_views(described, images, console)
    yield f"{len(views)} of {looked} images show enough of the board"
    solved = solve(described, views, images.size_px, model)
    picture = out.with_suffix(".png")
    solved.calibration.write(out)
    draw_residuals(solved, picture)
    yield from report(solved, images.size_px)
    yield f"written to {out}; {picture} shows what is left unexplained"


def find_views(board: Board, images: Source, console: Console) -> tuple[list[View], int]:
    """Looks for the board in images, with a progress bar. Returns the views of use, and how many were looked at."""
    finder, views, looked = Finder(board), [], 0
    total = min(len(images.paths), MOST_IMAGES) if isinstance(images, Folder) else None
    for image in track(_looked_at(images), total=total, console=console, transient=True,
                       description="looking for the board"):
        looked += 1
        corners = finder.find(image.rgb)
        if is_of_use(board, corners):
            views.append(View(image.name or f"image {image.index}", corners))
    return views, looked


def _looked_at(images: Source) -> Iterator[SourceImage]:
    """The images of a folder, or those of a video that are some time apart."""
    count, last_s = 0, -np.inf
    for image in images:
        if isinstance(images, Folder) or image.time_s - last_s >= EVERY_S - 1e-6:
            yield image
            count, last_s = count + 1, image.time_s
        if count >= MOST_IMAGES:
            return


def report(solved: Solved, size_px: Size) -> Iterator[str]:
    """Yields what was found, in words."""
    found = solved.calibration
    fx, fy, cx, cy = found.intrinsics_px
    yield (f"{len(solved.views)} views that differ most: {found.rms_px:.2f} pixels rms; the focal length is certain to "
           f"{solved.focal_sigma:.2%} (one standard deviation)")
    yield f"intrinsics: {fx:.2f},{fy:.2f},{cx:.2f},{cy:.2f} px, images of {size_px[0]}x{size_px[1]} pixels"
    yield f"lens: {found.lens.note() or 'no distortion'}"
    pixels = np.concatenate([view.corners.pixels for view in solved.views])
    cells = np.clip((pixels / size_px * CELLS).astype(int), 0, CELLS - 1)
    share = len(np.unique(cells, axis=0)) / CELLS ** 2
    if share < COVERED:
        yield (f"note: the board was seen in {share:.0%} of the image only; elsewhere the distortion is a guess: hold "
               "it also at the borders and in the corners")
