"""Images: what the camera sees, what the networks perceive in it, and what they draw."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from saccade.services.viewer.imagination import Imagination
from saccade.services.viewer.layout import CELL_PX, ROW_PX, Colour
from saccade.services.viewer.words import SEEN, plain
from saccade.services.viewer.world import CAMERA, VIEWPOINT
from saccade.shared.bus.messages import Belief, Frame, Goal, Percept, Plan
from saccade.shared.world.windows import CROP_PX

CAMERA_IMAGE, GOAL_IMAGE, IMAGINED, CROPS = f"{CAMERA}/image", "goal/image", f"{VIEWPOINT}/imagined", "crops/image"
OF_EPISODE = (CAMERA_IMAGE, GOAL_IMAGE, IMAGINED, CROPS)
JPEG_QUALITY = 85
DOT_PX = 12.0  # radius of the dot that is drawn in place of a box if the size of the crop is not known


class Images:
    """Logs images. Without an imagination it logs no crops, no reconstructions and no planned view."""

    def __init__(self, recording: rr.RecordingStream, names: tuple[str, ...], colour_of: Callable[[str], Colour],
                 imagination: Imagination | None) -> None:
        self._to, self._names, self._colour_of, self._imagination = recording, names, colour_of, imagination
        self.begin()
        if imagination:
            places = [((k + 0.5) * CELL_PX, 2 * ROW_PX) for k in range(len(names))]
            self._to.log("crops/names", rr.Points2D(places, labels=[plain(name) for name in names], radii=2.0,
                                                    colors=[colour_of(name) for name in names], show_labels=True),
                         static=True)

    def begin(self) -> None:
        """Starts another episode: removes the images of the last one."""
        self._seen: dict[str, Percept] = {}  # for each object the last percept that saw it
        self._viewpoint: NDArray[np.float64] | None = None  # the viewpoint whose view was imagined last [4, 4]
        for path in OF_EPISODE:
            self._to.log(path, rr.Clear(recursive=True))

    def goal(self, goal: Goal) -> None:
        """Logs the goal image."""
        if goal.rgb is not None:
            self._image(GOAL_IMAGE, goal.rgb)

    def frame(self, frame: Frame) -> None:
        """Logs the camera's image."""
        self._image(CAMERA_IMAGE, frame.rgb)

    def percept(self, percept: Percept, width_px: int) -> None:
        """Logs the boxes, the masks, the name and the presences of an object in the image, which is `width_px` wide.
        It may be there several times."""
        path = f"{CAMERA_IMAGE}/{rr.escape_entity_path_part(percept.object)}"
        if percept.presence < SEEN:
            self._to.log(path, rr.Clear(recursive=True))
            return
        self._seen[percept.object] = percept
        each = [one for one in percept.each() if one.presence >= SEEN]
        colour, labels = self._colour_of(percept.object), [f"{plain(one.object)} {one.presence:.2f}" for one in each]
        if self._imagination is None:
            self._to.log(f"{path}/box", rr.Points2D([one.pixel for one in each], radii=DOT_PX, colors=[colour],
                                                    labels=labels, show_labels=True))
        else:
            self._to.log(f"{path}/box", rr.LineStrips2D([self._imagination.frame_of(one) for one in each],
                                                        colors=[colour], labels=labels, show_labels=True))
        masks = [mask for one in each if (mask := one.mask()) is not None and mask.any()]
        if masks:
            lines = np.concatenate([outline(mask) * (width_px / len(mask)) for mask in masks])
            self._to.log(f"{path}/mask", rr.LineStrips2D(
                lines, colors=[colour], radii=0.8, draw_order=20))

    def step(self, frame: Frame, percepts: dict[str, Percept]) -> None:
        """Logs the crops of the objects that are seen at a step, and below them their reconstructions."""
        ordered = [percepts[name] for name in self._names if name in percepts and percepts[name].presence >= SEEN]
        if self._imagination is None:
            return
        columns = np.concatenate([self._imagination.crops(frame, ordered),
                                  self._imagination.reconstructions(ordered)], axis=1) if ordered else ()
        canvas = np.zeros((2 * ROW_PX, len(self._names) * CELL_PX, 3), np.uint8)
        for percept, column in zip(ordered, columns, strict=True):
            left = self._names.index(percept.object) * CELL_PX + (CELL_PX - CROP_PX) // 2
            canvas[:CROP_PX, left:left + CROP_PX] = column[:CROP_PX]
            canvas[ROW_PX:ROW_PX + CROP_PX, left:left + CROP_PX] = column[CROP_PX:]
        self._image(CROPS, canvas)

    def plan(self, plan: Plan, beliefs: dict[str, Belief]) -> None:
        """Logs the imagined view from the chosen viewpoint, if this is another one than before."""
        if self._imagination is None or (
                self._viewpoint is not None and np.array_equal(plan.viewpoint, self._viewpoint)):
            return
        self._viewpoint = plan.viewpoint
        known = [belief for kind in beliefs.values() for belief in kind.each() if belief.presence >= SEEN]
        self._image(IMAGINED, self._imagination.planned_view(plan.viewpoint, known, self._seen))

    def _image(self, path: str, rgb: NDArray[np.uint8]) -> None:
        self._to.log(path, rr.Image(rgb).compress(jpeg_quality=JPEG_QUALITY))


def outline(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The outline of a mask [M, M]: the edges between cells inside and outside, as lines [N, 2, 2] of (column, row)."""
    padded = np.pad(mask, 1)
    row, column = np.nonzero(padded[1:, 1:-1] != padded[:-1, 1:-1])
    flat = np.stack([np.stack([column, row], -1), np.stack([column + 1, row], -1)], axis=1)
    row, column = np.nonzero(padded[1:-1, 1:] != padded[1:-1, :-1])
    upright = np.stack([np.stack([column, row], -1), np.stack([column, row + 1], -1)], axis=1)
    return np.concatenate([flat, upright]).astype(np.float64)
