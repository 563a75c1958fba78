"""`saccade board`: a ChArUco board as a PDF of exact size, and its description beside it."""

from __future__ import annotations

import io
import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from saccade.services.camera.charuco import LEAST_SQUARES, Board, Dictionary, black_boxes_m
from saccade.shared.errors import SaccadeError
from saccade.shared.files import replace_all, writing
from saccade.shared.world.geometry import Array

INCH_M = 0.0254
MARGIN_M = 0.01  # which many printers leave white
FOOT_M = 0.024  # for the ruler and the words
MARKER_SHARE = 0.76  # of a square's side
LARGEST_ERROR = 0.1  # of a measured ruler; a larger one is a mistake
TICK_M, FONT_PT, TITLE_PT = 0.003, 7.0, 9.0


@dataclass(frozen=True)
class Paper:
    """A size of paper, and what fits on it."""

    width_m: float
    height_m: float
    square_m: float
    ruler_m: float


DICTIONARIES: dict[Dictionary, int] = {"4X4_100": 100, "4X4_250": 250, "4X4_1000": 1000}  # how many markers each has
PAPERS = {"a4": Paper(0.210, 0.297, 0.025, 0.15), "a3": Paper(0.297, 0.420, 0.035, 0.25),
          "letter": Paper(0.2159, 0.2794, 0.025, 0.15)}


def board_for(paper: Paper, square_m: float | None, *, free_middle: bool, number: int = 1) -> Board:
    """Returns the board with the most squares that fit on the paper. Sheets of the same size with another `number`
    share no marker. Raises SaccadeError if too few or too many squares fit."""
    side = square_m or paper.square_m
    columns, rows = (math.floor((length + 1e-9) / side) for length in
                     (paper.width_m - 2 * MARGIN_M, paper.height_m - 2 * MARGIN_M - FOOT_M))
    least = LEAST_SQUARES + 1 if free_middle else LEAST_SQUARES
    if min(columns, rows) < least:
        raise SaccadeError(f"--square-mm {1e3 * side:g}: {columns}x{rows} squares would fit, and {least}x{least} are "
                           "needed: give smaller squares or larger paper")
    markers = columns * rows // 2
    dictionary: Dictionary = "4X4_250"  # a board with more markers is refused
    if markers <= DICTIONARIES[dictionary]:
        dictionary = next((name for name, most in DICTIONARIES.items() if markers * number <= most), "4X4_1000")
    try:
        return Board(squares=(columns, rows), square_m=side, marker_m=round(MARKER_SHARE * side, 4),
                     dictionary=dictionary, first_marker=markers * (number - 1), free_middle=free_middle)
    except ValueError as error:
        many = f"--square-mm {1e3 * side:g}: {columns}x{rows} squares are more than a board has"
        raise SaccadeError(f"{many if number == 1 else f'{many} with --number {number}'}: give larger squares"
                           ) from error


def as_printed(board: Board, paper: Paper, measured_m: float | None) -> Board:
    """Returns the board in the size that the printer gave it, if the ruler on the sheet is `measured_m` long. Raises
    SaccadeError if no printer is so wrong."""
    if measured_m is None:
        return board
    share = measured_m / paper.ruler_m
    if abs(share - 1) > LARGEST_ERROR:
        raise SaccadeError(f"--measured-mm {1e3 * measured_m:g}: the ruler on the sheet should be "
                           f"{1e3 * paper.ruler_m:.0f} mm long: measure it again, in millimetres")
    return board.model_copy(update={"square_m": board.square_m * share, "marker_m": board.marker_m * share})


def write_sheet(out: Path, board: Board, paper: Paper, measured_m: float | None = None) -> Path:
    """Writes the PDF, and the description beside it with the ending .json. Returns the description's path.

    Raises SaccadeError if they cannot be written, or if OpenCV is missing.
    """
    if out.suffix.lower() != ".pdf":
        raise SaccadeError(f"{out} cannot be a sheet: let its name end in .pdf")
    description = json.dumps(as_printed(board, paper, measured_m).model_dump(mode="json"), indent=1) + "\n"
    told = out.with_suffix(".json")
    drawn = pdf_of(board, paper, told.name)
    with writing(out, "board"):
        out.parent.mkdir(parents=True, exist_ok=True)
        replace_all(out.parent, {out.name: drawn, told.name: description.encode()})
    return told


def pdf_of(board: Board, paper: Paper, name: str) -> bytes:
    """Returns the PDF of one page, whose scale is exact. `name` is that of the description. The same board gives the
    same bytes."""
    figure = Figure(figsize=(paper.width_m / INCH_M, paper.height_m / INCH_M))
    FigureCanvasPdf(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0, paper.width_m), ylim=(0, paper.height_m))
    axes.axis("off")
    boxes = black_boxes_m(board)
    middle = np.array([paper.width_m / 2, paper.height_m - MARGIN_M - board.size_m[1] / 2])
    axes.add_patch(_filled(boxes + np.tile(middle, 2)))
    _ruler(axes, paper)
    columns, rows = board.squares
    words = (f"Saccade board: {columns} x {rows} squares of {1e3 * board.square_m:g} mm, markers of "
             f"{1e3 * board.marker_m:g} mm, dictionary {board.dictionary}, described by {name}",
             "Print at 100 % (\"actual size\", not \"fit to page\"). The line above must be "
             f"{1e3 * paper.ruler_m:.0f} mm long: measure it. If it is not,",
             "print again, or write the description again with --measured-mm and the length that you measure. Glue the "
             "sheet onto something flat.",
             "The origin of the world is the middle of the squares: x points to the right of this sheet, y to its top, "
             "z up.")
    for k, text in enumerate(words):
        axes.text(paper.width_m / 2, MARGIN_M + 0.0108 - 0.0034 * k, text.replace("$", r"\$"), ha="center", va="center",
                  fontsize=FONT_PT)
    drawn = io.BytesIO()
    with rc_context({"pdf.fonttype": 42}):
        figure.savefig(drawn, format="pdf", metadata={"CreationDate": None, "Title": "Saccade board"})
    return drawn.getvalue()


def _filled(boxes: Array) -> PathPatch:
    """Black rectangles [N, 4] (left, bottom, right, top) as one shape, so that no lines are seen between them."""
    corners = boxes[:, [0, 1, 2, 1, 2, 3, 0, 3, 0, 1]].reshape(-1, 5, 2)
    codes = np.tile([Outline.MOVETO, Outline.LINETO, Outline.LINETO, Outline.LINETO, Outline.CLOSEPOLY], len(boxes))
    return PathPatch(Outline(corners.reshape(-1, 2), codes), facecolor="black", edgecolor="none", linewidth=0)


def _ruler(axes, paper: Paper) -> None:
    """A line of exact length with a tick at each centimetre."""
    left, y = (paper.width_m - paper.ruler_m) / 2, MARGIN_M + FOOT_M - 0.0075
    axes.plot([left, left + paper.ruler_m], [y, y], color="black", linewidth=0.6, solid_capstyle="butt")
    for k in range(round(paper.ruler_m / 0.01) + 1):
        long = TICK_M if k % 5 == 0 else TICK_M / 2
        axes.plot([left + 0.01 * k] * 2, [y - long / 2, y + long / 2], color="black", linewidth=0.4)
    axes.text(left + paper.ruler_m + 0.003, y, f"{1e3 * paper.ruler_m:.0f} mm", va="center", fontsize=TITLE_PT)
