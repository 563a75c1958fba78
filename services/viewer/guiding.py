"""Guidance for a hand on the live image: the arrow, the frame of the wanted view, and the words."""

from __future__ import annotations

import numpy as np
import rerun as rr

from saccade.services.viewer.images import CAMERA_IMAGE
from saccade.services.viewer.layout import PLANNED
from saccade.shared.bus.messages import Frame, Plan
from saccade.shared.world.guidance import guide

ARROW, GHOST = f"{CAMERA_IMAGE}/guidance/arrow", f"{CAMERA_IMAGE}/guidance/ghost"
GREEN = (60, 220, 90)
ABOVE = 30  # in the order of drawing: above the image, boxes and masks


class Guiding:
    """Logs the guidance from each frame by the newest plan."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._to = recording
        self.begin()

    def begin(self) -> None:
        """Starts another episode."""
        self._plan: Plan | None = None

    def plan(self, plan: Plan) -> None:
        """Takes a plan."""
        self._plan = plan

    def frame(self, frame: Frame) -> None:
        """Logs where to go from a frame. Nothing is logged before the first plan."""
        if self._plan is None:
            return
        height, width = frame.rgb.shape[:2]
        guidance = guide(frame.world_from_camera, self._plan.viewpoint, self._plan.look_at_m, frame.intrinsics_px,
                         (width, height), there=self._plan.arrived)
        for path, points, colour, label in ((ARROW, guidance.arrow_px, GREEN, None),
                                            (GHOST, guidance.frame_px, PLANNED, guidance.words)):
            if not len(points):
                self._to.log(path, rr.Clear(recursive=False))
                continue
            self._to.log(path, rr.LineStrips2D([np.vstack([points, points[:1]])], colors=[colour], radii=1.5,
                                               labels=label, show_labels=label is not None, draw_order=ABOVE))
