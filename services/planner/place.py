"""The place that a goal message tells: what the camera may do there, among objects that a planner knows of."""

from __future__ import annotations

import numpy as np

from saccade.shared.bus.messages import Goal
from saccade.shared.world.geometry import yaw_rotation
from saccade.shared.world.workspace import TABLE_THICK_M, Boxes, BoxReach, Reach, ShellReach, Space, boxes_of


def space_of(goal: Goal, objects: Boxes) -> Space | None:
    """What the camera may do among objects. None if the goal tells no workspace: then the rule of the paper holds."""
    reach: Reach
    if goal.workspace_m is not None:
        reach = BoxReach(np.asarray(goal.workspace_m[0]), np.asarray(goal.workspace_m[1]))
    elif goal.shell_m is not None:
        reach = ShellReach(np.asarray(goal.shell_m[:3]), float(goal.shell_m[3]), float(goal.shell_m[4]))
    else:
        return None
    boxes = [objects]
    if goal.obstacle_centers_m is not None and goal.obstacle_sizes_m is not None:
        yaws = np.zeros(len(goal.obstacle_centers_m)) if goal.obstacle_yaws_rad is None else goal.obstacle_yaws_rad
        boxes.append(Boxes(np.asarray(goal.obstacle_centers_m),
                           np.array([yaw_rotation(float(yaw)) for yaw in yaws]).reshape(-1, 3, 3),
                           np.asarray(goal.obstacle_sizes_m)))
    if goal.table_m is not None:
        x, y, top = (float(value) for value in goal.table_m)
        boxes.append(Boxes(np.array([[0.0, 0.0, top - TABLE_THICK_M / 2]]), np.eye(3)[None],
                           np.array([[x, y, TABLE_THICK_M]])))
    return Space(reach, boxes_of(*boxes))
