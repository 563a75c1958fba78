"""Active search as a Gymnasium environment, for agents that are trained by reinforcement learning.

    import gymnasium, saccade.services.simulator.gym_env
    env = gymnasium.make("saccade/ActiveSearch-v0", n_objects=3)
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from saccade.services.simulator.core import Simulator, world_for
from saccade.services.simulator.scene import Obstacle, Placed, Scene
from saccade.services.simulator.scenes import generate_scene, load_scenes
from saccade.services.simulator.suites import suite_of
from saccade.services.simulator.tables import MOST_DRAWN, MOST_OBSTACLES, TABLES, draw_table
from saccade.shared.bus.messages import Action, Frame
from saccade.shared.config import SceneConfig
from saccade.shared.errors import SaccadeError
from saccade.shared.render.objects import load_mesh, names_in_use
from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX
from saccade.shared.world.task import ACTION_LIMIT, MAX_STEPS, errors

ID = "saccade/ActiveSearch-v0"
FARTHEST_M = 10.0  # of a camera from the middle of the table, along each axis, in a workspace of its own
Observation = dict[str, Any]  # name -> array


class ActiveSearch(gymnasium.Env[Observation, NDArray[np.float64]]):
    """An environment in which a camera moves until it sees the goal image (paper, section 4.1).

    The observation has `image` and `goal` [size_px, size_px, 3] uint8, and `pose`, which is world_from_camera [4, 4]
    (metres). An action [6] is a translation (metres) along the axes of the world and a rotation about its fixed axes x,
    y and z (radians). Each number is between -0.5 and 0.5. The reward is 1 in the step that reaches the goal (within
    0.075 m and 0.5 rad), otherwise 0. This step terminates the episode. The episode is truncated after `max_steps`.
    `info` holds the id of the scene and the errors in azimuth, elevation and range.

    Every reset draws a scene with the environment's random generator. With a file `scenes` it draws one of the file's
    scenes, or takes the one that reset's options name (`scene=<id>`). With a `suite` of the benchmark it draws scenes
    of that kind: new ones of `twins`, `lying`, `moving`, `drifting`, `crowd` and `anywhere`, and the suite's own of
    the others. Without both it draws a new scene with `n_objects` objects, or with a random number of objects. Raises
    SaccadeError if an object or the file is missing or damaged, or if the suite is unknown or of other objects.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - Gymnasium's interface

    def __init__(self, *, objects: str = "pantry", names: Sequence[str] | None = None,
                 n_objects: int | None = None, yaw: Literal["random", "fixed"] = "random",
                 scenes: str | Path | None = None, suite: str | None = None,
                 max_steps: int = MAX_STEPS, size_px: int = IMAGE_SIZE_PX, render_mode: str | None = None):
        image = spaces.Box(0, 255, (size_px, size_px, 3), np.uint8)
        farthest = np.ones((4, 4))
        if suite in TABLES or scenes is not None:  # a workspace may be larger than the paper's
            farthest[:3, 3] = FARTHEST_M
        self.observation_space = spaces.Dict(
            {"image": image, "goal": image, "pose": spaces.Box(-farthest, farthest, dtype=np.float64)})
        self.action_space = spaces.Box(-ACTION_LIMIT, ACTION_LIMIT, (6,), np.float64)
        self.render_mode, self.yaw, self.n_objects, self.max_steps = render_mode, yaw, n_objects, max_steps
        in_use = names_in_use(SceneConfig(objects=objects, names=tuple(names) if names is not None else None))
        if scenes is not None and suite is not None:
            raise SaccadeError("scenes come from a file or from a suite: leave `scenes` or `suite` out")
        meshes = tuple(load_mesh(objects, name) for name in in_use)
        self._kind = suite if suite in TABLES else None
        known = load_scenes(Path(scenes), in_use) if scenes is not None else []
        if suite is not None and self._kind is None:
            known = suite_of(suite, objects).scenes({mesh.name: mesh for mesh in meshes}, 0)
        self._file = {scene.id: scene for scene in known}
        scale = size_px / IMAGE_SIZE_PX
        self._world = world_for(meshes, known or (_largest(in_use) if self._kind else []), size_px=size_px,
                                intrinsics_px=np.array(INTRINSICS_PX) * scale)
        self._simulator: Simulator | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict]:
        """Starts an episode with a new scene. Raises SaccadeError if the scene in `options` is not in the file.

        Returns the first observation and the info.
        """
        super().reset(seed=seed)
        simulator = Simulator(self._world, [self._draw((options or {}).get("scene"))], max_steps=self.max_steps)
        outputs: dict[str, Any] = {o.topic.name: o.message for o in simulator.begin("gym", 0)}
        self._simulator, self._goal = simulator, outputs["goal"].rgb
        return self._observe(outputs["frame"].rgb, simulator), _info(simulator)

    def _draw(self, scene_id: str | None) -> Scene:
        if scene_id is not None and scene_id not in self._file:
            raise SaccadeError(f"scene {scene_id!r} is not in the environment's file: give `scenes` a file that has it")
        if self._file:
            return self._file[scene_id or str(self.np_random.choice(list(self._file)))]
        sizes = {name: mesh.size_m for name, mesh in self._world.meshes.items()}
        target = str(self.np_random.choice(list(sizes)))
        if self._kind is not None:
            return draw_table(self._kind, self.np_random, self._world.meshes, target,
                              int(self.np_random.integers(1000)), "drawn")
        count = self.n_objects or int(self.np_random.integers(1, len(sizes) + 1))
        return generate_scene(self.np_random, sizes, target, count, yaw=self.yaw)

    def step(self, action: NDArray[np.float64]) -> tuple[Observation, float, bool, bool, dict]:
        """Executes an action [6]. Returns the observation, the reward, terminated, truncated and the info.

        Raises ResetNeeded before the first reset.
        """
        simulator = self._simulator
        if simulator is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        action = np.asarray(action, dtype=np.float64)
        state = simulator.state
        move = Action(run="gym", episode=0, step=state.step, translation_m=action[:3], rotation_rad=action[3:])
        messages = [output.message for output in simulator.step({"action": move})]
        frames = [message for message in messages if isinstance(message, Frame)]
        image = frames[0].rgb if frames else self._world.render(state.camera)  # the last step has no frame
        return (self._observe(image, simulator), float(state.success), state.success, state.done and not state.success,
                _info(simulator))

    def _observe(self, image: NDArray[np.uint8], simulator: Simulator) -> Observation:
        self._image = image
        return {"image": image.copy(), "goal": self._goal.copy(), "pose": simulator.state.camera.copy()}

    def render(self) -> NDArray[np.uint8] | None:
        """The camera's image [size_px, size_px, 3] in the render mode `rgb_array`, otherwise None."""
        return self._image if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._world.close()


def _largest(names: Sequence[str]) -> list[Scene]:
    """A scene with as many of each kind, and as many obstacles, as any that is drawn may have."""
    objects = tuple(Placed(name, np.zeros(3), 0.0, k + 1) for name in names for k in range(MOST_DRAWN))
    obstacles = (Obstacle(np.zeros(3), np.ones(3)),) * MOST_OBSTACLES
    return [Scene("largest", names[0], (0, 0, 0), objects, np.eye(4), obstacles=obstacles)]


def _info(simulator: Simulator) -> dict[str, Any]:
    state = simulator.state
    azimuth, elevation, distance = errors(state.camera[:3, 3], state.goal[:3, 3], state.target[0])
    return {"scene": simulator.scene.id, "azimuth_error_rad": azimuth, "elevation_error_rad": elevation,
            "range_error_m": distance}


gymnasium.register(ID, entry_point="saccade.services.simulator.gym_env:ActiveSearch")
