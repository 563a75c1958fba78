"""What planners say that weigh no expected free energy: a plan that names where the camera goes, and the action."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from saccade.shared.bus.messages import Action, Frame, Message, Plan
from saccade.shared.bus.topics import ACTION, PLAN, Output
from saccade.shared.world.geometry import Array

AHEAD_M = 0.4  # the point to look at, where there is none, is so far along the optical axis
Move = tuple[Array, Array]  # translation [3] in m, rotation [3] in rad


def outputs(stamp: Message, viewpoint: Array, move: Move, *, look_at_m: Array | None = None, target: str = "",
            goal_confidence: float = 0.0, believed_distance_m: float = -1.0, arrived: bool = False) -> Iterable[Output]:
    """Yields the plan to go to a viewpoint [4, 4] and the action, both for the step of `stamp`.

    The mode of the plan is `goal` if the distance to the goal's viewpoint is believed to be known, otherwise `search`.
    """
    if look_at_m is None:
        look_at_m = viewpoint[:3, 3] - AHEAD_M * viewpoint[:3, 2]
    at: dict[str, Any] = {"run": stamp.run, "episode": stamp.episode, "step": stamp.step}
    yield Output(PLAN, Plan(**at, target=target, mode="goal" if believed_distance_m >= 0.0 else "search",
                            viewpoint=viewpoint, look_at_m=look_at_m, g_position=0.0, g_scale=0.0, g_pose=0.0,
                            g_information=0.0, candidates=1, goal_confidence=goal_confidence,
                            believed_distance_m=believed_distance_m, arrived=arrived))
    yield Output(ACTION, Action(**at, translation_m=move[0], rotation_rad=move[1], arrived=arrived))


def step_from(frame: Frame, move: Move) -> Iterable[Output]:
    """Yields the plan and the action of a planner that knows only how the camera moves from here."""
    viewpoint = np.array(frame.world_from_camera)
    viewpoint[:3, 3] += move[0]
    return outputs(frame, viewpoint, move)
