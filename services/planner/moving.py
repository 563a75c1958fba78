"""What a planner does about a target that moves: it plans for where the target will be when the camera has moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from saccade.shared.bus.messages import Belief, Plan
from saccade.shared.world.geometry import Array

OFTEN = 3  # chosen: for a target that drifts, a viewpoint is chosen anew after this many steps


def ahead(beliefs: dict[str, Belief], target: str | None) -> dict[str, Belief]:
    """The beliefs, with the target where it will be at the next image if it drifts."""
    belief = beliefs.get(target or "")
    if belief is None or belief.velocity_m is None:
        return beliefs
    particles = (belief.particles_m + belief.velocity_m).astype(np.float32)
    return beliefs | {belief.object: replace(belief, mean_m=belief.mean_m + belief.velocity_m, particles_m=particles)}


def carried(plan: Plan, velocity_m: Array | None) -> Plan:
    """The plan one step later: its viewpoint moves along with a target that drifts by `velocity_m` [3] a step."""
    if velocity_m is None:
        return plan
    return replace(plan, viewpoint=shifted(plan.viewpoint, velocity_m), look_at_m=plan.look_at_m + velocity_m)


def shifted(world_from_camera: Array, velocity_m: Array) -> Array:
    """A camera pose [4, 4] that is moved by `velocity_m` [3]."""
    pose = world_from_camera.copy()
    pose[:3, 3] += velocity_m
    return pose
