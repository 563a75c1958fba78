"""An agent within this process, for your own robot or simulator: images and poses go in, actions come out. There is no
bus."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from saccade.app.run.registry import DEFAULT_AGENT, agent_pairs
from saccade.services.camera.virtual_camera import VirtualCamera
from saccade.shared.bus.messages import Action, Belief, Events, Frame, Goal, Message, Percept, Plan
from saccade.shared.bus.topics import ACTION, BELIEF, EVENTS, FRAME, GOAL, GOAL_PERCEPT, PERCEPT, PLAN, Output, Topic
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.local import Pump
from saccade.shared.loop.stepper import Stepper
from saccade.shared.render.objects import names_in_use
from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX
from saccade.shared.world.images import read_image
from saccade.shared.world.task import numbers

Image = NDArray[np.uint8]
RUN = "agent"
ORTHONORMAL = 1e-3  # how far the columns of a rotation may be from orthonormal


class Agent:
    """Perception, belief and planner of a configuration, stepped by the program that owns the camera.

    `goal` is the image to reach: a file, or an array [H, W, 3] of uint8. Without a goal the agent explores.
    `intrinsics` are (fx, fy, cx, cy) of your images, in pixels. Without them, an image of 480x480 pixels is taken as an
    image of the training's camera, and of any other image the central square is used. Raises SaccadeError if the
    configuration or the goal cannot be used.
    """

    def __init__(self, config: Config, *, agent: str = DEFAULT_AGENT, goal: str | Path | ArrayLike | None = None,
                 intrinsics: Sequence[float] | None = None) -> None:
        self.intrinsics, self._agent = intrinsics, agent
        self.config = config.with_values({"scene.names": list(names_in_use(config.scene)), "bus.kind": "local",
                                          "scene.explore": goal is None})
        self._pairs = agent_pairs(agent, self.config)
        self._episode = -1
        self.reset(goal)

    def reset(self, goal: str | Path | ArrayLike | None = None) -> None:
        """Begins a new scene, about which nothing is known yet. `goal` is the new goal image: a file, or an array
        [H, W, 3] of uint8. Without a goal the agent explores. Raises SaccadeError if the goal cannot be used."""
        if (goal is None) != self.config.scene.explore:
            self.config = self.config.with_values({"scene.explore": goal is None})
            self._pairs = agent_pairs(self._agent, self.config)
        rgb = None if goal is None else self._as_trained(image_of(goal, "goal image"))
        self._episode, self._step = self._episode + 1, 0
        self.percepts: dict[str, Percept] = {}
        self.goal_percepts: dict[str, Percept] = {}
        self.beliefs: dict[str, Belief] = {}
        self.events: Events | None = None
        self.plan: Plan | None = None
        self._action: Action | None = None
        self._pump = Pump([Stepper(service, core, self.config.names) for service, core in self._pairs], self._take)
        self._goal = Goal(run=RUN, episode=self._episode, step=0, rgb=rgb, intrinsics_px=np.array(INTRINSICS_PX))

    def step(self, rgb: ArrayLike, world_from_camera: ArrayLike,
             intrinsics: Sequence[float] | None = None) -> Action:
        """Returns the next move for an image [H, W, 3] of uint8 and the camera's pose [4, 4]. The pose is in metres and
        follows OpenGL: the camera looks along its -z axis, and its +y axis is up.

        `intrinsics` are those of this image, if they differ from those of the other images. Raises SaccadeError if the
        image or the pose is not valid, or if the agent does not answer.
        """
        image = self._as_trained(image_of(rgb, "image"), intrinsics)
        frame = Frame(run=RUN, episode=self._episode, step=self._step, seq=self._step, rgb=image,
                      intrinsics_px=np.array(INTRINSICS_PX), world_from_camera=_pose(world_from_camera))
        self._action = None
        first = [Output(GOAL, self._goal)] if self._step == 0 else []
        self._pump.run([*first, Output(FRAME, frame)])
        self._step += 1
        if self._action is None:
            raise SaccadeError("the agent did not answer this image: one of its services needs other inputs")
        return self._action

    def _take(self, topic: Topic, part: str | None, message: Message, payload: bytes | None) -> None:
        if topic == PLAN and isinstance(message, Plan):
            self.plan = message
        elif topic == ACTION and isinstance(message, Action):
            self._action = message
        elif topic == EVENTS and isinstance(message, Events):
            self.events = message
        elif part is not None:
            kept: Mapping[Topic, dict] = {PERCEPT: self.percepts, GOAL_PERCEPT: self.goal_percepts,
                                          BELIEF: self.beliefs}
            if topic in kept:
                kept[topic][part] = message

    def _as_trained(self, rgb: Image, intrinsics: Sequence[float] | None = None) -> Image:
        """Returns the image [480, 480, 3] that the training's camera would have seen from the same pose."""
        intrinsics = self.intrinsics if intrinsics is None else intrinsics
        if intrinsics is None and rgb.shape == (IMAGE_SIZE_PX, IMAGE_SIZE_PX, 3):
            return rgb
        return VirtualCamera((rgb.shape[1], rgb.shape[0]), intrinsics).see(rgb)


def image_of(given: str | Path | ArrayLike, what: str) -> Image:
    """Reads an image file, or checks an array [H, W, 3] of uint8. Raises SaccadeError, which begins with `what`, if it
    is no such image."""
    if isinstance(given, (str, Path)):
        return read_image(Path(given), what=what)
    try:
        rgb = np.asarray(given)
    except ValueError as error:  # lists of different lengths
        raise SaccadeError(f"{what} is no array of numbers: give [height, width, 3] of uint8") from error
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise SaccadeError(f"{what} of shape {list(rgb.shape)} and type {rgb.dtype}: give [height, width, 3] of uint8")
    return np.ascontiguousarray(rgb)


def _pose(given: ArrayLike) -> NDArray[np.float64]:
    """Checks a pose [4, 4]. Raises SaccadeError if it is not finite, or not a rigid transform."""
    pose = numbers(given, (4, 4), "world_from_camera", "4x4 finite numbers")
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > ORTHONORMAL:
        raise SaccadeError("world_from_camera does not end in the row 0 0 0 1: is it transposed?")
    rotation = pose[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > ORTHONORMAL or np.linalg.det(rotation) < 0:
        raise SaccadeError("world_from_camera: its upper left 3x3 numbers are no rotation")
    return pose
