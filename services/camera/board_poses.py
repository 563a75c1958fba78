"""The camera's pose at each image, from one or several printed boards that lie on the table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from saccade.services.camera.board_map import BoardMap
from saccade.services.camera.board_pose import Doubtful, Measured, measure
from saccade.services.camera.charuco import Board, Corners, Finder
from saccade.services.camera.pose_filter import PoseFilter
from saccade.services.camera.sources import SourceImage
from saccade.services.camera.trajectories.lens import Lens
from saccade.shared.world.geometry import Array

REFUSED = "the camera could hardly have moved there since the last image"


class BoardPoses:
    """Poses world_from_camera [4, 4] (OpenGL) in the frame of a board, from the images themselves.

    `more` are further boards; where they are is learnt from the images. `lens` is that of the images, with its
    intrinsics. With `smooth` the images follow one another in time, and a filter
    smooths the poses; otherwise each image is judged by itself. `why_not` counts the reasons of images without a pose.
    Raises SaccadeError if OpenCV is missing.
    """

    def __init__(self, board: Board, lens: Lens, path: Path, *, smooth: bool, more: Sequence[Board] = ()):
        self.board, self.lens, self._path = board, lens, path
        self._finders = [Finder(one) for one in (board, *more)]
        self.map = BoardMap(len(self._finders))
        self._filter = PoseFilter() if smooth else None
        self.why_not: Counter[str] = Counter()

    def of(self, image: SourceImage) -> Array | None:
        """The camera's pose [4, 4] at an image. None if the board does not show it beyond doubt."""
        return self._take([measure(finder.board, finder.find(image.rgb), self.lens) for finder in self._finders],
                          image.time_s)

    def from_corners(self, corners: Corners, time_s: float) -> Array | None:
        """The camera's pose [4, 4] from the corners of the first board that an image of this time shows, or None."""
        return self._take([measure(self.board, corners, self.lens)], time_s)

    def _take(self, seen: list[Measured | Doubtful], time_s: float) -> Array | None:
        measured = self.map.fuse(seen)
        if isinstance(measured, Doubtful):
            self.why_not[measured.reason] += 1
            return None
        if self._filter is None:
            return measured.world_from_camera
        smoothed = self._filter.take(time_s, measured)
        if smoothed is None:
            self.why_not[REFUSED] += 1
        return smoothed

    def end_before(self, image: SourceImage) -> bool:
        """Whether no later image can have a pose. The board may come back into view at any time."""
        return False

    def matched(self, names: Sequence[str]) -> BoardPoses:
        """The same: the names of the images tell nothing."""
        return self

    @property
    def advice(self) -> str:
        """What to do if no image has a pose."""
        reason = self.why_not.most_common(1)[0][0] if self.why_not else "there is no image"
        return (f"mostly because {reason}; print the board that belongs to this file, lay it flat, and let most of it "
                "be seen")

    def __str__(self) -> str:
        others = self.map.count - 1
        return f"the board {self._path}" + (f" and {others} more" if others else "")
