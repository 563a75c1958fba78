"""The table in three dimensions: the camera and its path, particles, beliefs, candidates and the chosen viewpoint."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import ArrayLike, NDArray

from saccade.services.viewer.layout import PATH, PLANNED, TABLE, TRUE, VIEW_PX, Colour, between
from saccade.services.viewer.words import SEEN, plain
from saccade.shared.bus.messages import Belief, Events, Frame, Plan, Truth
from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX, quaternion
from saccade.shared.world.task import LOWER_M, UPPER_M

CAMERA, VIEWPOINT, GOAL, TRUTH = "world/camera", "world/viewpoint", "world/goal", "world/true"
EVENTS = "world/events"
# Cleared in the next episode
OF_EPISODE = ("world/objects", "world/path", "world/candidates", VIEWPOINT, GOAL, TRUTH, EVENTS)
FRUSTUM_M, PLANNED_M, GHOST_M = 0.10, 0.07, 0.04  # size of the cameras, and half size of an object of unknown size
PATH_LENGTH = 500  # positions of the path that are shown: it is drawn at every step and must not grow with the run
CHI_95 = 2.80  # a Gaussian in space is within this many standard deviations with probability 0.95
PARTICLE_M, CANDIDATE_M, EVENT_M = 0.0025, 0.006, 0.012
UNSEEN_GREY = 110  # particles of an object that is believed absent fade towards this grey


def _path_of(label: str) -> str:
    return f"world/objects/{rr.escape_entity_path_part(label)}"


class World:
    """Logs to `world/`.

    `colour_of(name)` gives the colour of an object. `sizes_m` holds the extents [3] of the known objects' boxes.
    """

    def __init__(self, recording: rr.RecordingStream, colour_of: Callable[[str], Colour],
                 sizes_m: dict[str, NDArray[np.float64]]) -> None:
        self._to, self._colour_of, self._sizes_m = recording, colour_of, sizes_m
        self._path: deque[NDArray[np.float64]] = deque(maxlen=PATH_LENGTH)
        self._looks: dict[str, object] = {}  # by path: properties that are logged only when they change
        self._shown: dict[str, set[str]] = {}  # by object: its instances that are shown
        self._to.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        side = (UPPER_M - LOWER_M)[:2]
        self._to.log("world/table", rr.Boxes3D(centers=[(0, 0, -0.006)], sizes=[(*side, 0.01)], colors=[TABLE],
                                               fill_mode="solid"), static=True)

    def begin(self) -> None:
        """Starts another episode: removes what belongs to the last one."""
        self._path.clear()
        self._looks.clear()
        self._shown.clear()
        for path in OF_EPISODE:
            self._to.log(path, rr.Clear(recursive=True))

    def frame(self, frame: Frame) -> None:
        """Logs the camera and its path."""
        height, width = frame.rgb.shape[:2]
        self._camera(CAMERA, frame.world_from_camera, frame.intrinsics_px, (width, height), FRUSTUM_M, PATH)
        self._path.append(frame.world_from_camera[:3, 3])
        self._to.log("world/path", rr.LineStrips3D([np.array(self._path)], colors=[PATH], radii=[0.0015]))

    def belief(self, belief: Belief) -> None:
        """Logs all instances of an object, and removes those that are not believed in any more."""
        labels = {each.label() for each in belief.each()}
        for label in sorted(self._shown.get(belief.object, set()) - labels):
            path = _path_of(label)
            self._to.log(path, rr.Clear(recursive=True))
            self._looks = {at: look for at, look in self._looks.items() if not at.startswith(f"{path}/")}
        self._shown[belief.object] = labels
        for each in belief.each():
            self._instance(each)

    def _instance(self, belief: Belief) -> None:
        """Logs the particles of an instance, and the ellipsoid that contains it with probability 0.95."""
        path, colour = _path_of(belief.label()), self._colour_of(belief.object)
        share = 0.2 + 0.8 * round(8 * belief.presence) / 8
        faded = [round(UNSEEN_GREY + (part - UNSEEN_GREY) * share) for part in colour]
        cloud = rr.Points3D.from_fields(positions=belief.particles_m)
        if self._changed(f"{path}/particles", share):
            cloud = rr.Points3D(belief.particles_m, colors=[faded], radii=PARTICLE_M)
        self._to.log(f"{path}/particles", cloud)
        seen = belief.presence >= SEEN
        appears = self._changed(f"{path}/belief", seen)
        if not seen:
            if appears:
                self._to.log(f"{path}/belief", rr.Clear(recursive=False))
            return
        values, vectors = np.linalg.eigh(belief.covariance_m2)
        vectors[:, 0] *= np.sign(np.linalg.det(vectors))
        look: dict[str, Any] = {}
        if appears:
            look = {"colors": [colour], "labels": [plain(belief.label())], "show_labels": True}
        self._to.log(f"{path}/belief", rr.Ellipsoids3D.from_fields(
            centers=[belief.mean_m], half_sizes=[CHI_95 * np.sqrt(np.maximum(values, 1e-8))],
            quaternions=[rr.Quaternion(xyzw=quaternion(vectors))], **look))

    def events(self, events: Events) -> None:
        """Logs a mark where something was noticed, which stays until something else is."""
        if events.objects:
            self._to.log(EVENTS, rr.Points3D(
                events.positions_m, radii=EVENT_M, colors=[self._colour_of(name) for name in events.objects],
                labels=[f"{plain(name)}: {kind}" for name, kind in zip(events.labels(), events.kinds, strict=False)],
                show_labels=True))

    def plan(self, plan: Plan) -> None:
        """Logs the best candidates (the very best is green), and the chosen viewpoint as a camera."""
        imagined_px = np.array(INTRINSICS_PX) * (VIEW_PX / IMAGE_SIZE_PX)
        self._camera(VIEWPOINT, plan.viewpoint, imagined_px, (VIEW_PX,) * 2, PLANNED_M, PLANNED)
        if plan.best_eyes_m is not None and plan.best_g is not None:
            above = plan.best_g - plan.best_g.min()
            shares = above / max(float(above.max()), 1e-6)
            self._to.log("world/candidates", rr.Points3D(
                plan.best_eyes_m, colors=[between(float(share)) for share in shares], radii=CANDIDATE_M))

    def truth(self, truth: Truth) -> None:
        """Logs what only the simulator knows: the camera at the goal, and the objects as transparent boxes."""
        self._camera(GOAL, truth.goal_world_from_camera, INTRINSICS_PX, (IMAGE_SIZE_PX,) * 2, FRUSTUM_M, TRUE)
        half = np.zeros((len(truth.names), 3)) + GHOST_M
        for k, name in enumerate(truth.names):
            half[k] = self._sizes_m.get(name, 2 * half[k]) / 2
        turned = [rr.Quaternion(xyzw=(0, 0, np.sin(yaw / 2), np.cos(yaw / 2))) for yaw in truth.yaws_rad]
        if truth.rotations is not None:
            turned = [rr.Quaternion(xyzw=quaternion(rotation)) for rotation in truth.rotations]
        self._to.log(TRUTH, rr.Boxes3D(
            centers=truth.centers_m, half_sizes=half, quaternions=turned,
            labels=[plain(label) for label in truth.labels()],
            colors=[(*self._colour_of(name), 70) for name in truth.names], fill_mode="solid", show_labels=False))

    def _camera(self, path: str, world_from_camera: NDArray[np.float64], intrinsics_px: ArrayLike,
                size_px: tuple[int, int], distance_m: float, colour: Colour) -> None:
        fx, fy, cx, cy = np.asarray(intrinsics_px)
        self._to.log(path, rr.Transform3D(translation=world_from_camera[:3, 3], mat3x3=world_from_camera[:3, :3]),
                     rr.Pinhole(focal_length=(fx, fy), principal_point=(cx, cy), resolution=size_px, color=colour,
                                camera_xyz=rr.ViewCoordinates.RUB, image_plane_distance=distance_m))

    def _changed(self, path: str, look: object) -> bool:
        before = self._looks.get(path)
        self._looks[path] = look
        return before != look
