"""Shows a run as Foxglove's messages: what the camera saw and where it was, what was believed and planned, and the
truth.

Frames: `world` is the same as everywhere. Each camera has an optical frame, as Foxglove and Rerun expect it: it looks
along +z, +x is right and +y is down. Saccade's own camera looks along -z, and +y is up. Both viewers draw everything
except the SceneUpdates (labels, ellipsoids, the path as a line). Only Foxglove draws those; apart from names they show
nothing that is not drawn in another way.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from typing import Any

import foxglove.messages as fm
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from saccade.app.palette import COLOURS
from saccade.shared.bus.messages import Belief, Frame, Goal, Message, Plan, Truth
from saccade.shared.bus.topics import BELIEF, FRAME, GOAL, PLAN, TRUTH, Topic

Told = tuple[str, Any]  # a topic and a message for it

WORLD, CAMERA, GOAL_CAMERA, VIEWPOINT = "world", "camera_optical", "goal_optical", "viewpoint_optical"
NOWHERE = ""  # if a frame had no transform to the world, Rerun would not draw the others together
CAMERA_FROM_OPTICAL = np.diag([1.0, -1.0, -1.0, 1.0])
MOST_VIEWS = 2000  # of the path; each message holds all of it, so that it can be seen at any time of the log
TRUE, PATH = (0.9, 0.1, 0.9), (0.6, 0.6, 0.6)  # on dark and on light ground
LABEL_M, MARK_M, YAW_M = 0.03, 0.02, 0.08  # sizes of letters, of the mark of a true centre, of the arrow along its yaw

POINT = np.dtype([("xyz", "<f4", 3), ("rgba", "u1", 4)])
_FLOAT, _BYTE = fm.PackedElementFieldNumericType.Float32, fm.PackedElementFieldNumericType.Uint8
POINT_FIELDS = [*(fm.PackedElementField(name=name, offset=4 * i, type=_FLOAT) for i, name in enumerate("xyz")),
                *(fm.PackedElementField(name=name, offset=12 + i, type=_BYTE)
                  for i, name in enumerate(("red", "green", "blue", "alpha")))]


class Scene:
    """Takes the messages of a log in their order. `goal_view_is_known`: the goal's pose in the truth is that of the
    goal image."""

    def __init__(self, *, goal_view_is_known: bool) -> None:
        self.goal_view_is_known = goal_view_is_known
        self._objects: set[str] = set()
        self._colours: dict[str, tuple[float, float, float]] = {}
        self._episode = -1
        self._ways: dict[int, NDArray[np.float64]] = {}  # the camera's position at each step of the episode
        self._seen: Frame | None = None
        self._goal_seen: Goal | None = None
        self._goal_posed = -1  # the episode whose goal pose was published

    def take(self, topic: Topic, part: str | None, message: Message, time_ns: int) -> Iterator[Told]:
        """Yields what can be shown of a message that was logged at `time_ns`."""
        show: dict[Topic, Callable[[Any, fm.Timestamp], Iterator[Told]]] = {
            FRAME: self._frame, GOAL: self._goal, BELIEF: self._belief, PLAN: self._plan, TRUTH: self._truth}
        if part is not None and topic.in_step:
            self._objects.add(part)
        if topic in show:
            yield from show[topic](message, fm.Timestamp(*divmod(time_ns, 10 ** 9)))

    def _frame(self, frame: Frame, at: fm.Timestamp) -> Iterator[Told]:
        self._seen = frame
        yield "/camera/image", image(frame.rgb, CAMERA, at)
        yield "/camera/calibration", calibration(frame.intrinsics_px, frame.rgb.shape[:2], CAMERA, at)
        if frame.depth_m is not None:
            yield "/camera/depth", depth_image(frame.depth_m, CAMERA, at)
        yield from camera_pose("/camera/pose", frame.world_from_camera, CAMERA, at)
        yield from self._way(frame, at)

    def _goal(self, goal: Goal, at: fm.Timestamp) -> Iterator[Told]:
        self._goal_seen = goal
        if goal.rgb is not None and goal.episode != self._goal_posed:
            yield "/goal/image", image(goal.rgb, NOWHERE, at)
        else:
            yield from self._goal_view(at)

    def _goal_view(self, at: fm.Timestamp) -> Iterator[Told]:
        """Yields the goal image at its pose, when both are known."""
        goal = self._goal_seen
        if goal is not None and goal.rgb is not None and goal.episode == self._goal_posed:
            yield "/goal/image", image(goal.rgb, GOAL_CAMERA, at)
            yield "/goal/calibration", calibration(goal.intrinsics_px, goal.rgb.shape[:2], GOAL_CAMERA, at)

    def _truth(self, truth: Truth, at: fm.Timestamp) -> Iterator[Told]:
        if self.goal_view_is_known:
            yield from camera_pose("/goal/pose", truth.goal_world_from_camera, GOAL_CAMERA, at)
            if truth.episode != self._goal_posed:
                self._goal_posed = truth.episode
                yield from self._goal_view(at)
        turned = [Rotation.from_euler("z", yaw).as_matrix() for yaw in truth.yaws_rad]
        if truth.rotations is not None and all(_is_rotation(rotation) for rotation in truth.rotations):
            turned = list(truth.rotations)
        yield "/truth/objects", cloud(truth.centers_m, TRUE, 1.0, at)
        yield "/truth/labels", update("objects", at, spheres=[
            fm.SpherePrimitive(pose=pose(np.eye(3), center), size=vector([MARK_M] * 3), color=colour(TRUE))
            for center in truth.centers_m], arrows=[
            fm.ArrowPrimitive(pose=pose(rotation, center), color=colour(TRUE, 0.5),
                              shaft_length=YAW_M, shaft_diameter=0.005, head_length=0.02, head_diameter=0.012)
            for center, rotation in zip(truth.centers_m, turned, strict=False)], texts=[
            label(f"{name} (target)" if name == truth.target else name, center, TRUE)
            for name, center in zip(truth.labels(), truth.centers_m, strict=False)])
        yield from self._way(truth, at)

    def _way(self, message: Frame | Truth, at: fm.Timestamp) -> Iterator[Told]:
        """Yields the path so far, once for each step.

        The last step has a truth and no frame, and the camera stays where it took its last image. A real camera has
        frames and no truth. A step that was recorded late is put in its place.
        """
        if message.episode > self._episode:
            self._episode, self._ways = message.episode, {}
        if message.episode < self._episode or message.step in self._ways:
            return
        self._ways[message.step] = message.world_from_camera[:3, 3]
        if len(self._ways) > MOST_VIEWS:
            del self._ways[min(self._ways)]
        path = np.array([self._ways[step] for step in sorted(self._ways)])
        yield "/camera/path", cloud(path, PATH, 1.0, at)
        yield "/camera/track", update("track", at, lines=[
            fm.LinePrimitive(points=[fm.Point3(x=x, y=y, z=z) for x, y, z in path.tolist()], thickness=2.0,
                             scale_invariant=True, color=colour(PATH))])

    def _belief(self, belief: Belief, at: fm.Timestamp) -> Iterator[Told]:
        """All instances of an object, on topics of their own."""
        for each in belief.each():
            yield from self._instance(each, at)

    def _instance(self, belief: Belief, at: fm.Timestamp) -> Iterator[Told]:
        name = belief.label().replace("#", "/")
        rgb = self._colour(belief.object)
        yield f"/belief/{name}/particles", cloud(belief.particles_m, rgb, belief.presence, at)
        text = f"{belief.label()} {belief.presence:.0%}"
        yield f"/belief/{name}/spread", update(belief.label(), at, spheres=[ellipsoid(belief, rgb)],
                                                        texts=[label(text, belief.mean_m, rgb)])

    def _colour(self, name: str) -> tuple[float, float, float]:
        """The colour of an object, as in the run's picture. Colours follow the order of the names; all objects have
        percepts before the first belief."""
        if name not in self._colours:
            for new in sorted(self._objects - self._colours.keys()):
                self._colours[new] = _rgb(COLOURS[len(self._colours) % len(COLOURS)])
        return self._colours[name]

    def _plan(self, plan: Plan, at: fm.Timestamp) -> Iterator[Told]:
        yield from camera_pose("/plan/pose", plan.viewpoint, VIEWPOINT, at)
        if self._seen is not None:  # with its calibration a viewer draws the viewpoint's frustum
            yield "/plan/calibration", calibration(self._seen.intrinsics_px, self._seen.rgb.shape[:2], VIEWPOINT, at)


def image(rgb: NDArray[np.uint8], frame: str, at: fm.Timestamp) -> fm.CompressedImage:
    """Returns an image [H, W, 3] of uint8 as PNG, without loss. At the lowest level of compression this takes 5 ms, and
    for flat-shaded scenes it needs no more space than a good JPEG."""
    data = io.BytesIO()
    Image.fromarray(rgb).save(data, format="PNG", compress_level=1)
    return fm.CompressedImage(timestamp=at, frame_id=frame, data=data.getvalue(), format="png")


def depth_image(depth_m: NDArray[np.float32], frame: str, at: fm.Timestamp) -> fm.RawImage:
    """Returns the depth along the optical axis [H, W], in metres."""
    height, width = depth_m.shape
    return fm.RawImage(timestamp=at, frame_id=frame, width=width, height=height, encoding="32FC1", step=4 * width,
                       data=depth_m.astype("<f4").tobytes())


def calibration(intrinsics_px: ArrayLike, size_px: tuple[int, int], frame: str,
                at: fm.Timestamp) -> fm.CameraCalibration:
    """Returns a pinhole camera without distortion, from (fx, fy, cx, cy) and (height, width) in pixels."""
    fx, fy, cx, cy = (float(x) for x in np.asarray(intrinsics_px))
    height, width = size_px
    return fm.CameraCalibration(timestamp=at, frame_id=frame, width=width, height=height,
                                K=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], R=np.eye(3).ravel().tolist(),
                                P=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0])


def camera_pose(topic: str, world_from_camera: NDArray[np.float64], frame: str, at: fm.Timestamp) -> Iterator[Told]:
    """Yields the pose of an OpenGL camera [4, 4] as the transform of its optical frame. Yields nothing if the matrix is
    not a pose."""
    world_from_optical = world_from_camera @ CAMERA_FROM_OPTICAL
    rotation = world_from_optical[:3, :3]
    if _is_rotation(rotation):
        yield topic, fm.FrameTransform(timestamp=at, parent_frame_id=WORLD, child_frame_id=frame,
                                       translation=vector(world_from_optical[:3, 3]), rotation=quaternion(rotation))


def _is_rotation(matrix: NDArray[np.float64]) -> bool:
    return bool(np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3) and np.linalg.det(matrix) > 0)


def cloud(points_m: NDArray[Any], rgb: tuple[float, float, float], alpha: float, at: fm.Timestamp) -> fm.PointCloud:
    """Returns points [N, 3] (metres, world) in one colour."""
    packed = np.empty(len(points_m), POINT)
    packed["xyz"], packed["rgba"] = points_m, np.round(255 * np.array([*rgb, alpha]))
    return fm.PointCloud(timestamp=at, frame_id=WORLD, pose=pose(np.eye(3), np.zeros(3)), point_stride=POINT.itemsize,
                         fields=POINT_FIELDS, data=packed.tobytes())


def ellipsoid(belief: Belief, rgb: tuple[float, float, float]) -> fm.SpherePrimitive:
    """Returns the believed position as an ellipsoid of one standard deviation along each axis."""
    variances, axes = np.linalg.eigh(belief.covariance_m2)
    axes = axes * np.sign(np.linalg.det(axes))  # a rotation, not a mirror
    return fm.SpherePrimitive(pose=pose(axes, belief.mean_m), color=colour(rgb, 0.3 * belief.presence),
                              size=vector(2 * np.sqrt(np.maximum(variances, 1e-10))))


def label(text: str, at_m: ArrayLike, rgb: tuple[float, float, float]) -> fm.TextPrimitive:
    """Returns a text that faces the viewer, above a position [3] (metres, world)."""
    above = np.add(at_m, (0.0, 0.0, LABEL_M))
    return fm.TextPrimitive(pose=pose(np.eye(3), above), billboard=True, font_size=LABEL_M, color=colour(rgb),
                            text=text)


def update(name: str, at: fm.Timestamp, **primitives: Any) -> fm.SceneUpdate:
    """Returns one entity in the world. It replaces the entity of the same name on its topic."""
    return fm.SceneUpdate(entities=[fm.SceneEntity(timestamp=at, frame_id=WORLD, id=name, **primitives)])


def pose(rotation: ArrayLike, position_m: ArrayLike) -> fm.Pose:
    """Returns the pose of a rotation [3, 3] and a position [3] in metres."""
    return fm.Pose(position=vector(position_m), orientation=quaternion(rotation))


def vector(xyz: ArrayLike) -> fm.Vector3:
    """Returns three numbers as a vector."""
    x, y, z = (float(value) for value in np.asarray(xyz))
    return fm.Vector3(x=x, y=y, z=z)


def quaternion(rotation: ArrayLike) -> fm.Quaternion:
    """Returns the quaternion of a rotation [3, 3]."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return fm.Quaternion(x=x, y=y, z=z, w=w)


def colour(rgb: tuple[float, float, float], alpha: float = 1.0) -> fm.Color:
    """Returns a colour from parts between 0 and 1."""
    return fm.Color(r=rgb[0], g=rgb[1], b=rgb[2], a=alpha)


def _rgb(code: str) -> tuple[float, float, float]:
    """Returns the parts, between 0 and 1, of a colour "#rrggbb"."""
    red, green, blue = bytes.fromhex(code[1:])
    return red / 255, green / 255, blue / 255
