"""An arm with a camera in its hand, in MuJoCo: it is told a pose of the camera, and moves its joints there."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from saccade.shared.render.opengl import choose_backend
from saccade.shared.world.geometry import Array, pose, rotation_vector

choose_backend()  # before MuJoCo is loaded: the table is rendered in the same process
import mujoco  # noqa: E402

MODEL = Path(__file__).with_name("arm.xml")
READY = (0.0, -1.2, 2.1, 0.0, 0.4, 0.0)  # joints above the table, from which the first pose is looked for
CLOSE_M, CLOSE_RAD = 1e-4, 1e-3  # a solution this near is good enough
ROUNDS, TRIES, DAMPING, LONGEST_RAD = 150, 12, 1e-3, 0.2


class Arm:
    """Holds a camera. `camera` is its pose world_from_camera [4, 4]."""

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_path(str(MODEL))
        self.data, self._trial = mujoco.MjData(self.model), mujoco.MjData(self.model)
        self._site = self.model.site("camera").id
        self.data.qpos[:] = self.data.ctrl[:] = READY
        mujoco.mj_forward(self.model, self.data)

    @property
    def camera(self) -> Array:
        """Where the camera is now, by the joints as they are."""
        return self._camera_of(self.data)

    def put(self, world_from_camera: Array) -> None:
        """Begins at a pose, at rest."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = READY
        self.data.qpos[:] = self.data.ctrl[:] = self.joints_for(world_from_camera)
        mujoco.mj_forward(self.model, self.data)

    def move(self, world_from_camera: Array, seconds: float) -> None:
        """Lets the position control of the joints go to a pose for some time. The joints lead there evenly."""
        start, end = self.data.ctrl.copy(), self.joints_for(world_from_camera)
        steps = round(seconds / self.model.opt.timestep)
        for step in range(steps):
            self.data.ctrl[:] = start + (end - start) * min(1.0, 2 * (step + 1) / steps)  # then it comes to rest
            mujoco.mj_step(self.model, self.data)

    def joints_for(self, world_from_camera: Array) -> Array:
        """The joints [6] that bring the camera to a pose, or as near as was found. It begins with the present joints,
        so that the arm stays in its posture where it can."""
        rng, starts = np.random.default_rng(0), [self.data.qpos.copy()]
        starts += [rng.uniform(*self.model.jnt_range.T) for _ in range(TRIES)]
        found = []
        for start in starts:
            found.append(self._solved(world_from_camera, start))
            if found[-1][1] < 1.0:
                break
        return min(found, key=lambda one: one[1])[0]

    def _solved(self, goal: Array, joints: Array) -> tuple[Array, float]:
        """Damped least squares from these joints: the joints at the end, and how far they are from good enough."""
        lower, upper = self.model.jnt_range.T
        jacobian = np.zeros((6, self.model.nv))
        for _ in range(ROUNDS):
            self._trial.qpos[:] = joints
            mujoco.mj_kinematics(self.model, self._trial)
            mujoco.mj_comPos(self.model, self._trial)
            camera = self._camera_of(self._trial)
            apart = np.concatenate([goal[:3, 3] - camera[:3, 3], rotation_vector(goal[:3, :3] @ camera[:3, :3].T)])
            left = max(np.linalg.norm(apart[:3]) / CLOSE_M, np.linalg.norm(apart[3:]) / CLOSE_RAD)
            if left < 1.0:
                break
            mujoco.mj_jacSite(self.model, self._trial, jacobian[:3], jacobian[3:], self._site)
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + DAMPING * np.eye(6), apart)
            joints = np.clip(joints + step * min(1.0, LONGEST_RAD / np.abs(step).max()), lower, upper)
        return joints, float(left)

    def _camera_of(self, data: mujoco.MjData) -> Array:
        return pose(data.site_xmat[self._site].reshape(3, 3), data.site_xpos[self._site])
