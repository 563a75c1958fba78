"""Objects that fall and come to rest: from poses in the air to poses in which they lie, by MuJoCo's physics.

Each object is the convex hull of its mesh. All functions are pure: the same poses give the same rest on one machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from saccade.services.simulator.scene import PAPER_TABLE, Placed, Table, placed_at
from saccade.shared.render.mesh import Mesh
from saccade.shared.render.opengl import choose_backend
from saccade.shared.world.geometry import Array, fibonacci_sphere, quaternion

choose_backend()  # of the renderer: MuJoCo takes it when it is imported
import mujoco  # noqa: E402

STEP_S = 0.004
DENSITY_KG_M3 = 400.0  # of full cans and half-full boxes
FRICTION = (0.8, 0.01, 0.001)  # sliding, turning, rolling
BETWEEN = 75  # steps from one object's fall to the next one's
CHECKED_EVERY, CHECKS, LONGEST = 25, 4, 2000  # steps between checks, checks that must agree, steps
AT_REST = 0.01  # m/s and rad/s
DRAG_FALLING, DRAG_RESTING = 0.999, 0.99  # a step; after the last one has fallen, what rolls comes to a halt
TABLE_THICK_M = 0.1
WAITING_M = 50.0  # above the table, and apart from one another
_DIRECTIONS = fibonacci_sphere(160)


def hull_points(mesh: Mesh) -> Array:
    """Some vertices [H, 3] of the convex hull of a mesh: those that are farthest in evenly spread directions."""
    vertices = np.asarray(mesh.vertices_m, dtype=np.float64)
    axes = np.concatenate([_DIRECTIONS, np.eye(3), -np.eye(3)])
    return vertices[np.unique(np.argmax(vertices @ axes.T, axis=0))]


def height_on(mesh: Mesh, rotation: Array, top_m: float = 0.0) -> float:
    """The height of an object's centre (metres) at which it touches a surface at `top_m` from above, turned by
    `rotation` [3, 3]."""
    return top_m - float((hull_points(mesh) @ rotation.T)[:, 2].min())


def at_rest(meshes: Mapping[str, Mesh], falling: Sequence[Placed], *, standing: Sequence[Placed] = (),
            table: Table = PAPER_TABLE) -> tuple[Placed, ...] | None:
    """Lets objects fall onto the table, one after the other from where they are, among others that stand still.

    Each begins at its place, or higher where a heap is in its way. Returns how they come to rest. None if one fell from
    the table, or if they do not come to rest in 8 s.
    """
    model = _model(meshes, falling, standing, table)
    data = mujoco.MjData(model)
    starts = [np.concatenate([p.center_m, _wxyz(p.rotation)]) for p in falling]
    radii = np.array([np.linalg.norm(meshes[p.name].size_m) / 2 for p in falling])
    still = 0
    for step in range(len(falling) * BETWEEN + LONGEST):
        fallen = step // BETWEEN + 1
        if step % BETWEEN == 0 and fallen <= len(falling):
            start = starts[fallen - 1]
            there, reach = data.qpos.reshape(-1, 7)[:fallen - 1, :3], radii[:fallen - 1] + radii[fallen - 1]
            below = np.linalg.norm(there[:, :2] - start[:2], axis=1) < reach
            start[2] = max([start[2], *(there[:, 2] + reach)[below]])
            data.qpos[7 * (fallen - 1):7 * fallen] = start
            data.qvel[6 * (fallen - 1):6 * fallen] = 0.0
        for waiting in range(fallen, len(falling)):
            data.qpos[7 * waiting:7 * waiting + 7] = [2.0 * waiting, 0.0, WAITING_M, 1.0, 0.0, 0.0, 0.0]
            data.qvel[6 * waiting:6 * waiting + 6] = 0.0
        mujoco.mj_step(model, data)
        data.qvel *= DRAG_FALLING if fallen <= len(falling) else DRAG_RESTING
        if fallen > len(falling) and step % CHECKED_EVERY == 0:
            still = still + 1 if np.abs(data.qvel).max() < AT_REST else 0
            if still == CHECKS:
                return _placed(data.qpos.reshape(-1, 7), falling, table)
    return None


def _model(meshes: Mapping[str, Mesh], falling: Sequence[Placed], standing: Sequence[Placed],
           table: Table) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.integrator = STEP_S, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10.0  # so that heaps do not creep
    x, y = table.size_xy_m
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[x / 2, y / 2, TABLE_THICK_M / 2], friction=FRICTION,
                            pos=[0, 0, table.height_m - TABLE_THICK_M / 2])
    for name in dict.fromkeys(p.name for p in (*falling, *standing)):
        spec.add_mesh(name=name, uservert=hull_points(meshes[name]).ravel().tolist())
    for placed in (*falling, *standing):
        body = spec.worldbody.add_body(pos=placed.center_m, quat=_wxyz(placed.rotation))
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=placed.name, density=DENSITY_KG_M3, friction=FRICTION,
                      condim=6)
    for body in spec.worldbody.bodies[:len(falling)]:
        body.add_freejoint()
    return spec.compile()


def _placed(states: NDArray[np.float64], falling: Sequence[Placed], table: Table) -> tuple[Placed, ...] | None:
    half = np.array(table.size_xy_m) / 2
    if (np.abs(states[:, :2]) > half).any() or (states[:, 2] < table.height_m).any():
        return None
    rotations = np.zeros((len(states), 9))
    for state, rotation in zip(states, rotations, strict=True):
        mujoco.mju_quat2Mat(rotation, state[3:])
    return tuple(placed_at(p.name, p.instance, state[:3], rotation.reshape(3, 3))
                 for p, state, rotation in zip(falling, states, rotations, strict=True))


def _wxyz(rotation: Array) -> Array:
    x, y, z, w = quaternion(rotation)
    return np.array([w, x, y, z])
