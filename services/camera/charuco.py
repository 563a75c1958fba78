"""A printed ChArUco board: its description, its pattern, and how its corners are found in an image.

The board's frame is the table's: metres, z up, the origin at the board's middle, x to the right and y up on the sheet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, FiniteFloat, model_validator

from saccade.services.camera.opencv import opencv
from saccade.shared.config import Section, checked
from saccade.shared.errors import SaccadeError
from saccade.shared.files import MIB, parse_json, read_text
from saccade.shared.world.geometry import Array

MAX_FILE_BYTES = 1 * MIB
MOST_SQUARES, LEAST_SQUARES = 60, 4
RING = 2  # squares between the edge and a free middle: the corners between two squares are found
ENOUGH, LARGE_PX = 0.75, 1300  # share of the corners; width of an image that is not enlarged
SHARPENED_PX, SHARPENED = 3.0, 2.0  # radius and strength
_NEED = "give the .json that `saccade board` wrote beside the PDF"

Squares = Annotated[int, Field(ge=LEAST_SQUARES, le=MOST_SQUARES)]
Metres = Annotated[FiniteFloat, Field(gt=0.001, le=2.0)]
Dictionary = Literal["4X4_50", "4X4_100", "4X4_250", "4X4_1000", "5X5_50", "5X5_100", "5X5_250", "5X5_1000",
                     "6X6_50", "6X6_100", "6X6_250", "6X6_1000"]


class Board(Section):
    """A ChArUco board, as its .json describes it."""

    squares: tuple[Squares, Squares]
    """Columns and rows of the chessboard."""
    square_m: Metres
    """Side of a square."""
    marker_m: Metres
    """Side of a marker, with its black edge."""
    dictionary: Dictionary = "4X4_100"
    """OpenCV's dictionary of the markers, without DICT_."""
    first_marker: int = Field(0, ge=0, lt=1000)
    """Number of the first marker. Boards that are used together share no marker."""
    free_middle: bool = False
    """Whether the middle is left white, so that objects can stand there."""
    legacy_pattern: bool = False
    """Whether the board was made by OpenCV before 4.6, whose pattern differs if the number of rows is even."""

    @model_validator(mode="after")
    def _can_be_printed(self) -> Board:
        if not 0.4 * self.square_m <= self.marker_m <= 0.95 * self.square_m:
            raise ValueError(f"marker_m {self.marker_m:g} is not between 40% and 95% of square_m {self.square_m:g}")
        columns, rows = self.squares
        known = int(self.dictionary.split("_")[1])
        if self.markers.stop > known:
            first = f" from {self.first_marker} on" if self.first_marker else ""
            raise ValueError(f"{columns}x{rows} squares need {len(self.markers)} markers{first}, the dictionary "
                             f"{self.dictionary} has {known}")
        if self.free_middle and min(self.squares) < 2 * RING + 1:
            raise ValueError(f"{columns}x{rows} squares have no room for a free middle")
        return self

    @property
    def markers(self) -> range:
        """The numbers of its markers."""
        return range(self.first_marker, self.first_marker + self.squares[0] * self.squares[1] // 2)

    @property
    def size_m(self) -> Array:
        """Width and height [2] of the chessboard."""
        return np.array(self.squares) * self.square_m

    def is_free(self, column: int, row: int) -> bool:
        """Whether a square belongs to the free middle. Row 0 is at the top."""
        return self.free_middle and all(RING <= n < count - RING
                                        for n, count in zip((column, row), self.squares, strict=True))

    @property
    def corners_m(self) -> Array:
        """The inner corners [N, 3] of the chessboard in the board's frame, by their numbers."""
        columns, rows = self.squares
        row, column = np.mgrid[1:rows, 1:columns].reshape(2, -1)
        x, y = column * self.square_m - self.size_m[0] / 2, self.size_m[1] / 2 - row * self.square_m
        return np.stack([x, y, np.zeros(len(x))], axis=1)

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Which inner corners [N] touch no square of the free middle."""
        columns, rows = self.squares
        return np.array([not any(self.is_free(c - a, r - b) for a in (0, 1) for b in (0, 1))
                         for r in range(1, rows) for c in range(1, columns)])


def read_board(path: Path) -> Board:
    """Reads the description of a board. Raises SaccadeError if it is missing, damaged, or describes no board."""
    text = read_text(path, "board", _NEED, MAX_FILE_BYTES)
    try:
        tree = parse_json(text)
        if not isinstance(tree, dict):
            raise ValueError("it holds no map of keys")
    except ValueError as error:
        raise SaccadeError(f"board {path} is not JSON of a board ({error}): {_NEED}") from error
    return checked(Board, tree, f"board {path}, {{}}")


def read_boards(paths: Sequence[Path]) -> list[Board]:
    """Reads the descriptions of boards that are used together. Raises SaccadeError as `read_board` does, or if two of
    them share a marker."""
    boards = [read_board(path) for path in paths]
    for number, one in enumerate(boards):
        for before, other in zip(paths, boards[:number], strict=False):
            alike = one.dictionary[0] == other.dictionary[0]  # markers of one size: larger sets contain the smaller
            if alike and set(one.markers) & set(other.markers):
                raise SaccadeError(f"boards {before} and {paths[number]} have markers in common, so that they could "
                                   "not be told apart: print one of them anew with `saccade board --number 2`")
    return boards


@dataclass(frozen=True)
class Corners:
    """Corners of a board in an image: their numbers [N], and their pixels [N, 2] from the corner of the first pixel."""

    ids: NDArray[np.int64]
    pixels: Array

    def of(self, chosen: NDArray[np.bool_]) -> Corners:
        """The corners that are chosen by a mask [N]."""
        return Corners(self.ids[chosen], self.pixels[chosen])


class Finder:
    """Finds the corners of a board in images. Raises SaccadeError if OpenCV is missing."""

    def __init__(self, board: Board):
        self.board, self._usable = board, board.usable
        self._cv2 = opencv("boards need")
        self._detector = self._cv2.aruco.CharucoDetector(self.opencv_board)

    @cached_property
    def opencv_board(self) -> Any:
        """The board as OpenCV knows it."""
        aruco, board = self._cv2.aruco, self.board
        made = aruco.CharucoBoard(board.squares, board.square_m, board.marker_m, _dictionary(aruco, board),
                                  np.array(board.markers, dtype=np.int32))
        made.setLegacyPattern(board.legacy_pattern)
        return made

    def find(self, rgb: NDArray[np.uint8]) -> Corners:
        """The corners in an image [H, W, 3]; there may be none. If many are missing in a small image, they are looked
        for once more in a sharpened one of twice the size: there the cells of small or blurred markers can be told
        apart."""
        grey = self._cv2.cvtColor(rgb, self._cv2.COLOR_RGB2GRAY)
        found = self._corners(grey)
        if len(found.ids) >= ENOUGH * self._usable.sum() or grey.shape[1] > LARGE_PX:
            return found
        large = self._cv2.resize(grey, None, fx=2, fy=2, interpolation=self._cv2.INTER_CUBIC)
        smooth = self._cv2.GaussianBlur(large, (0, 0), SHARPENED_PX)
        twice = self._corners(self._cv2.addWeighted(large, 1 + SHARPENED, smooth, -SHARPENED, 0))
        return Corners(twice.ids, twice.pixels / 2) if len(twice.ids) > len(found.ids) else found

    def _corners(self, grey: NDArray[np.uint8]) -> Corners:
        places, numbers, _, _ = self._detector.detectBoard(grey)
        if numbers is None or len(numbers) == 0:
            return Corners(np.zeros(0, dtype=np.int64), np.zeros((0, 2)))
        ids = np.asarray(numbers, dtype=np.int64).reshape(-1)
        found = Corners(ids, np.asarray(places, dtype=np.float64).reshape(-1, 2) + 0.5)  # OpenCV counts from centres
        return found.of(self._usable[ids])


def _dictionary(aruco: Any, board: Board) -> Any:
    return aruco.getPredefinedDictionary(getattr(aruco, f"DICT_{board.dictionary}"))


def grey_of(board: Board, *, texels_per_m: float, margin_m: float) -> NDArray[np.uint8]:
    """The sheet as grey values [H, W], with a white margin. Raises SaccadeError if OpenCV is missing."""
    half = board.size_m / 2 + margin_m
    sheet = np.full(np.round(2 * half[::-1] * texels_per_m).astype(int), 255, dtype=np.uint8)
    for left, bottom, right, top in np.round((black_boxes_m(board) + np.tile(half, 2)) * texels_per_m).astype(int):
        sheet[len(sheet) - top:len(sheet) - bottom, left:right] = 0
    return sheet


def black_boxes_m(board: Board) -> Array:
    """The black rectangles [N, 4] of the pattern: left, bottom, right and top in the board's frame (metres). Squares
    come first, then the cells of the markers. Raises SaccadeError if OpenCV is missing."""
    finder = Finder(board)
    made, aruco = finder.opencv_board, finder._cv2.aruco
    cells = int(board.dictionary[0]) + 2  # with the black edge
    cell_m, half = board.marker_m / cells, board.size_m / 2
    bits = _dictionary(aruco, board)
    marked: set[tuple[int, int]] = set()
    of_markers = []
    for number, corners in zip(np.ravel(made.getIds()), made.getObjPoints(), strict=True):
        left, top = np.asarray(corners)[:, :2].min(0)  # OpenCV counts y downwards from the top left corner
        square = int((left + board.marker_m / 2) // board.square_m), int((top + board.marker_m / 2) // board.square_m)
        marked.add(square)
        if not board.is_free(*square):
            image = aruco.generateImageMarker(bits, int(number), cells)
            of_markers += [(left + c * cell_m - half[0], half[1] - top - (r + 1) * cell_m,
                            left + (c + 1) * cell_m - half[0], half[1] - top - r * cell_m)
                           for r, c in np.argwhere(image == 0)]
    columns, rows = board.squares
    side = board.square_m
    squares = [(c * side - half[0], half[1] - (r + 1) * side, (c + 1) * side - half[0], half[1] - r * side)
               for r in range(rows) for c in range(columns) if (c, r) not in marked and not board.is_free(c, r)]
    return np.array([*squares, *of_markers])
