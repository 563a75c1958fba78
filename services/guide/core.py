"""What the page that guides a hand shows: the newest image, and where to go from there.

The core holds the newest messages. It computes the guidance and encodes the image only when a page asks for them.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from saccade.shared.bus.messages import Action, Belief, Frame, Goal, Message, Plan
from saccade.shared.bus.topics import ACTION, BELIEF, FRAME, GOAL, PLAN, Topic
from saccade.shared.world.guidance import guide, outline

SHOWN: tuple[Topic, ...] = (FRAME, GOAL, BELIEF, PLAN, ACTION)  # the topics that the page needs
SEEN = 0.5  # an object with at least this presence is drawn
JPEG_QUALITY = 85
WAITS = "wait: the agent has not chosen a view yet"


class Guide:
    """Holds the newest messages of a run. `sizes_m` are the extents [3] of the known objects' boxes, by name."""

    def __init__(self, sizes_m: Mapping[str, NDArray[np.float64]]) -> None:
        self._sizes_m, self._at = sizes_m, ("", -1)
        self._forget()

    def _forget(self) -> None:
        self._frame: Frame | None = None
        self._goal: Goal | None = None
        self._plan: Plan | None = None
        self._action: Action | None = None
        self._beliefs: dict[str, Belief] = {}

    def take(self, message: Message) -> None:
        """Takes any message of SHOWN. Messages of an earlier step or episode are ignored."""
        if (message.run, message.episode) != self._at:
            if message.run == self._at[0] and message.episode < self._at[1]:
                return
            self._at = message.run, message.episode
            self._forget()
        if isinstance(message, Frame) and (self._frame is None or message.step >= self._frame.step):
            self._frame = message
        elif isinstance(message, Goal):
            self._goal = message
        elif isinstance(message, Plan) and (self._plan is None or message.step >= self._plan.step):
            self._plan = message
        elif isinstance(message, Action) and (self._action is None or message.step >= self._action.step):
            self._action = message
        elif isinstance(message, Belief) and message.object in self._sizes_m:
            self._beliefs[message.object] = message

    def state(self) -> bytes:
        """The guidance from the newest image, as JSON. Pixels are those of the image; nothing is drawn where a list of
        points is empty."""
        frame, goal, plan, action = self._frame, self._goal, self._plan, self._action  # another thread may take more
        told: dict[str, Any] = {"state": "wait", "words": WAITS, "step": -1, "goal": False, "arrow": [], "frame": [],
                                "outlines": [], "target": "", "mode": ""}
        if frame is not None:
            height, width = frame.rgb.shape[:2]
            told |= {"run": frame.run, "step": frame.step, "size": [width, height],
                     "goal": goal is not None and goal.rgb is not None}
            if plan is not None:
                step_m = action.translation_m if action is not None else None
                guidance = guide(frame.world_from_camera, plan.viewpoint, plan.look_at_m, frame.intrinsics_px,
                                 (width, height), step_m=step_m, there=plan.arrived)
                told |= {"state": guidance.state, "words": guidance.words, "target": plan.target, "mode": plan.mode,
                         "distance_m": round(guidance.distance_m, 3),
                         "turn_deg": round(float(np.degrees(guidance.turn_rad)), 1),
                         "arrow": _points(guidance.arrow_px), "frame": _points(guidance.frame_px),
                         "outlines": self._outlines(plan, frame)}
        return json.dumps(told).encode()

    def _outlines(self, plan: Plan, frame: Frame) -> list[dict[str, Any]]:
        """The believed objects, as they will be seen in the image at the viewpoint."""
        each = [belief for _, kind in sorted(self._beliefs.copy().items()) for belief in kind.each()]
        return [{"name": belief.label(), "points": _points(points)} for belief in each
                if belief.presence >= SEEN and len(points := outline(
                    plan.viewpoint, belief.mean_m, self._sizes_m[belief.object], frame.intrinsics_px))]

    def image(self) -> bytes | None:
        """The newest image as JPEG. None if there is none yet."""
        frame = self._frame
        return None if frame is None else _jpeg(frame.rgb)

    def goal_image(self) -> bytes | None:
        """The goal image as JPEG. None if there is none."""
        goal = self._goal
        return None if goal is None or goal.rgb is None else _jpeg(goal.rgb)


def _points(pixels: ArrayLike) -> list[list[float]]:
    return np.asarray(pixels).round(1).tolist()


def _jpeg(rgb: NDArray[np.uint8]) -> bytes:
    out = io.BytesIO()
    Image.fromarray(rgb).save(out, "JPEG", quality=JPEG_QUALITY)
    return out.getvalue()
