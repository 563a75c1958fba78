"""Turns what the agent wants and believes into messages of ROS 2, for the planner of an arm or a screen."""

from __future__ import annotations

import colorsys
import hashlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from saccade.shared.bus.messages import Belief, Message, Plan
from saccade.shared.bus.topics import BELIEF, PLAN, Topic
from saccade.shared.ros.types import MARKERS, NANOSECONDS, POSE, make
from saccade.shared.world.geometry import Array

OPTICAL = np.diag([1.0, -1.0, -1.0, 1.0])  # Saccade: z backward and y up; ROS: z forward and y down
PRESENT = 0.5  # objects that are less probable are removed
DEVIATIONS = 2.0  # radius of a belief's ellipsoid, in standard deviations
MIN_DIAMETER_M, TEXT_M, OPACITY = 0.005, 0.03, 0.4
SPHERE, TEXT, ADD, DELETE = 2, 9, 0, 2  # of visualization_msgs/Marker
_TIME, _VECTOR, _POINT = "builtin_interfaces/msg/Time", "geometry_msgs/msg/Vector3", "geometry_msgs/msg/Point"


class Teller:
    """Tells ROS, once for each plan, the viewpoint to move to (PoseStamped) and the beliefs (MarkerArray).

    Poses are those of the camera's optical frame (z forward, y down) in `frame`. `names` are the objects of the run.
    """

    topics: tuple[Topic, ...] = (PLAN, BELIEF)

    def __init__(self, names: Sequence[str], frame: str) -> None:
        self._names, self._frame = tuple(names), frame
        self._beliefs: dict[str, Belief] = {}
        self._shown: dict[str, dict[int, Belief]] = {}  # by object and number: the instances that were told last
        self._episode = ("", -1)

    def take(self, message: Message, time_ns: int) -> list[tuple[str, Any]]:
        """Takes a plan or a belief. Returns the type and the content of each message to publish at `time_ns`."""
        if (message.run, message.episode) != self._episode:
            self._episode, self._beliefs = (message.run, message.episode), {}
        if isinstance(message, Belief):
            if message.object in self._names:
                self._beliefs[message.object] = message
            return []
        if not isinstance(message, Plan):
            return []
        told = [(POSE, viewpoint(message.viewpoint, self._frame, time_ns))]
        if self._beliefs:
            markers = [marker for k, name in enumerate(self._names) if name in self._beliefs
                       for marker in self._markers(self._beliefs[name], k, time_ns)]
            told.append((MARKERS, make(MARKERS, {"markers": markers})))
        return told


    def _markers(self, belief: Belief, number: int, time_ns: int) -> list[Any]:
        """The markers of all instances of object `number`. Those of instances that are not believed in any more are
        removed."""
        each = {one.instance: one for one in belief.each()}
        gone = {instance: replace(one, presence=0.0) for instance, one in self._shown.get(belief.object, {}).items()
                if instance not in each}
        self._shown[belief.object] = each
        return [marker for instance, one in sorted({**gone, **each}.items())
                for marker in markers_of(one, number + len(self._names) * (instance - 1), self._frame, time_ns)]


def viewpoint(world_from_camera: Array, frame: str, time_ns: int) -> Any:
    """A pose [4, 4] (OpenGL) as the PoseStamped of the camera's optical frame."""
    return make(POSE, {"header": _header(frame, time_ns), "pose": _pose(world_from_camera @ OPTICAL)})


def markers_of(belief: Belief, number: int, frame: str, time_ns: int) -> list[Any]:
    """The markers of an object: an ellipsoid of two standard deviations, and its name. If the object is believed not to
    be there, they remove those from before."""
    action = ADD if belief.presence > PRESENT else DELETE
    variances, axes = np.linalg.eigh(belief.covariance_m2)
    if np.linalg.det(axes) < 0:
        axes = axes * (-1, 1, 1)
    diameters_m = np.maximum(2 * DEVIATIONS * np.sqrt(np.maximum(variances, 0)), MIN_DIAMETER_M)
    shape = np.eye(4)
    shape[:3, :3], shape[:3, 3] = axes, belief.mean_m
    label = np.eye(4)
    label[:3, 3] = belief.mean_m
    label[2, 3] += diameters_m.max() / 2 + TEXT_M
    text = f"{belief.label()} {belief.presence:.0%}"
    return [
        _marker("beliefs", number, SPHERE, action, frame, time_ns, shape, diameters_m, colour_of(belief.object)),
        _marker("names", number, TEXT, action, frame, time_ns, label, (0.0, 0.0, TEXT_M), (1.0, 1.0, 1.0, 1.0), text)]


def colour_of(name: str) -> tuple[float, float, float, float]:
    """A colour that is always the same for an object."""
    hue = hashlib.blake2b(name.encode(), digest_size=1).digest()[0] / 256
    return (*colorsys.hsv_to_rgb(hue, 0.8, 1.0), OPACITY)


def _marker(space: str, number: int, kind: int, action: int, frame: str, time_ns: int, pose: Array,
            scale: Sequence[float] | Array, colour: Sequence[float], text: str = "") -> Any:
    nothing = {"header": _header("", 0), "format": "", "data": np.zeros(0, np.uint8)}
    return make("visualization_msgs/msg/Marker", {
        "header": _header(frame, time_ns), "ns": space, "id": number, "type": kind, "action": action,
        "pose": _pose(pose), "scale": _xyz(_VECTOR, scale),
        "color": make("std_msgs/msg/ColorRGBA", dict(zip("rgba", map(float, colour), strict=True))),
        "lifetime": make("builtin_interfaces/msg/Duration", {"sec": 0, "nanosec": 0}), "frame_locked": False,
        "points": [], "colors": [], "texture_resource": "", "uv_coordinates": [], "text": text, "mesh_resource": "",
        "texture": make("sensor_msgs/msg/CompressedImage", nothing), "mesh_use_embedded_materials": False,
        "mesh_file": make("visualization_msgs/msg/MeshFile", {"filename": "", "data": np.zeros(0, np.uint8)})})


def _header(frame: str, time_ns: int) -> Any:
    stamp = make(_TIME, {"sec": time_ns // NANOSECONDS, "nanosec": time_ns % NANOSECONDS})
    return make("std_msgs/msg/Header", {"stamp": stamp, "frame_id": frame})


def _pose(pose: Array) -> Any:
    turn = dict(zip("xyzw", map(float, Rotation.from_matrix(pose[:3, :3]).as_quat()), strict=True))
    return make("geometry_msgs/msg/Pose", {"position": _xyz(_POINT, pose[:3, 3]),
                                           "orientation": make("geometry_msgs/msg/Quaternion", turn)})


def _xyz(kind: str, values: Sequence[float] | Array) -> Any:
    return make(kind, dict(zip("xyz", map(float, values), strict=True)))
