"""The core of the camera service: it publishes real images with their poses, in the place of the simulator."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from saccade.services.camera.calibration import read_calibration
from saccade.services.camera.charuco import read_boards
from saccade.services.camera.poses import Poses, asked_of, read_poses
from saccade.services.camera.ros.source import RosSource, is_ros, open_ros_source
from saccade.services.camera.ros.stream import with_lens
from saccade.services.camera.sources import Folder, Source, SourceImage, open_source
from saccade.services.camera.trajectories.lens import Lens
from saccade.services.camera.virtual_camera import VirtualCamera
from saccade.shared.bus.messages import Frame, Goal
from saccade.shared.bus.topics import ACTION, FRAME, GOAL, Output
from saccade.shared.config import CameraConfig, Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.service import Inputs, Service
from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX
from saccade.shared.world.goal_image import LONGEST_PX, GoalImage, read_goal_image
from saccade.shared.world.photographs import read_photograph
from saccade.shared.world.task import start_pose

if TYPE_CHECKING:
    from saccade.services.camera.board_poses import BoardPoses

SERVICE = Service("camera", inputs=(ACTION,), trigger=ACTION, outputs=(FRAME, GOAL))
BOARD_NEEDS = ("camera.board needs the camera's intrinsics: calibrate it with `saccade calibrate` and give "
               "camera.calibration, or give camera.intrinsics_px")
WHOLE = 0.995  # share of the networks' field of view; if the camera covers less, the user is told


class Camera:
    """Turns the images of a source into frames like those of the training, with INTRINSICS_PX and their poses.

    All images belong to one episode. A camera that is started again within a run begins another episode. The caller
    asks for the next frame every `period_s` seconds. Images without a pose are left out and counted in `skipped`, and
    messages of a ROS source that cannot be used in `refused`. With `loop` the source begins anew when it has ended.
    `goal_rgb` is the goal image [480, 480, 3]; without it the agent explores. `notes` tells the user what is assumed,
    one line for each assumption.
    """

    episodes = 1

    def __init__(self, source: Source, poses: Poses | BoardPoses, virtual_camera: VirtualCamera, *,
                 goal_rgb: NDArray[np.uint8] | None = None, loop: bool = False, notes: tuple[str, ...] = ()):
        self.source, self.poses, self.virtual_camera = source, poses, virtual_camera
        self.goal_rgb, self.loop, self.notes = goal_rgb, loop, notes
        self.period_s, self.skipped = source.period_s, 0

    @property
    def refused(self) -> int:
        """How many messages of the source could not be used."""
        return getattr(self.source, "left_out", 0)

    def begin(self, run: str, episode: int) -> list[Output]:
        """Returns the goal and the first frame. Raises SaccadeError if no image has a pose."""
        self._run, self._episode, self._published, self.skipped = run, episode, 0, 0
        self._first: SourceImage | None = None
        self._images = self._all_images()
        frame = self.next_frame()
        if not frame:
            seen = f"{self.skipped} images of {self.source.name} ({self._first} to {self._last})"
            raise SaccadeError(f"none of the {seen} has a pose in {self.poses}: {self.poses.advice}")
        goal = Goal(run=run, episode=episode, step=0, rgb=self.goal_rgb, intrinsics_px=np.array(INTRINSICS_PX))
        return [Output(GOAL, goal), *frame]

    def next_frame(self) -> list[Output]:
        """Returns the frame of the next image that has a pose, or nothing if there is no such image any more.

        Raises SaccadeError if an image cannot be read or has another size.
        """
        for image in self._images:
            self._first, self._last = self._first or image, image
            world_from_camera = self.poses.of(image)
            if world_from_camera is not None:
                frame = Frame(run=self._run, episode=self._episode, step=self._published,
                              rgb=self.virtual_camera.see(image.rgb), intrinsics_px=np.array(INTRINSICS_PX),
                              world_from_camera=world_from_camera)
                self._published += 1
                return [Output(FRAME, frame)]
            self.skipped += 1
            if self.source.endless and self.poses.end_before(image):
                break
        return []

    def step(self, inputs: Inputs) -> list[Output]:
        """Ignores the action, because somebody else moves this camera. Returns nothing."""
        return []

    def _all_images(self) -> Iterator[SourceImage]:
        yield from self.source
        while self.loop and self._published:
            yield from self.source


def build(config: Config) -> Camera:
    """Creates the camera from a configuration.

    Raises SaccadeError if the source, the poses, the board, the calibration, the intrinsics or the goal image are
    missing, damaged or do not fit.
    """
    camera = config.camera
    require_one_of_each(camera)
    if camera.source is None:
        raise SaccadeError("camera.source is not given: give a folder of images, a video file, a ROS 2 bag, or "
                           "a webcam (webcam:0)")
    ros = open_ros_source(config)
    source = ros.source if ros else open_source(camera.source, rate_hz=camera.rate_hz)
    poses = _poses_of(config, ros)
    poses = poses.matched([path.name for path in getattr(source, "paths", ())])
    lens, told = _lens(camera, poses, source)
    virtual_camera = VirtualCamera(source.size_px, lens=lens)
    goal = _goal_of(config, virtual_camera)
    still = ros is None and camera.poses is None and camera.board is None
    assumed = _notes(virtual_camera, lens, still=still)
    notes = (*((ros.told,) if ros else ()), *poses.notes, *told, *assumed, *((goal.note,) if goal else ()))
    return Camera(source, _by_board(camera, source, lens) or poses, virtual_camera,
                  goal_rgb=goal.rgb if goal else None, loop=camera.loop, notes=notes)


def require_one_of_each(camera: CameraConfig) -> None:
    """Raises SaccadeError if two keys tell the same, or if the board's poses need what is not given."""
    if camera.board is not None and camera.poses is not None:
        raise SaccadeError("camera.board and camera.poses both tell the camera's poses: give one of them")
    if camera.more_boards and camera.board is None:
        raise SaccadeError("camera.more_boards without camera.board: the first board, whose middle is the world's "
                           "origin, is camera.board")
    if camera.calibration is not None and camera.intrinsics_px is not None:
        raise SaccadeError("camera.calibration and camera.intrinsics_px both tell the intrinsics: give one of them")
    given = camera.calibration is not None or camera.intrinsics_px is not None
    if camera.board is not None and not given and not is_ros(camera.source or ""):  # ROS may tell them
        raise SaccadeError(BOARD_NEEDS)


def _lens(camera: CameraConfig, poses: Poses, source: Source) -> tuple[Lens | None, tuple[str, ...]]:
    """The lens of the images, and notes about it: what the user gives, else what the file of the poses or a CameraInfo
    tells, else what the first picture of a folder says of itself. None if nothing is known."""
    size_px = source.size_px
    if camera.calibration is not None:
        read = read_calibration(camera.calibration)
        lens = read.lens.at(size_px, "the calibration")
        told = f"intrinsics ({', '.join(f'{x:.2f}' for x in lens.of(size_px))}) px are those of the calibration"
        return lens, (f"{told} {camera.calibration}", *_removed(lens))
    if camera.intrinsics_px is not None:
        kept = any(lens.distorts for lens in poses.lenses)
        note = f"the distortion that {poses.lens_from} tells of is not removed, because camera.intrinsics_px is given"
        return Lens(camera.intrinsics_px, size_px), (note,) if kept else ()
    found, notes = poses.lens(size_px)
    if found is None and isinstance(source, Folder):
        return _photographed(source)
    return found, (*notes, *_removed(found))


def _photographed(source: Folder) -> tuple[Lens | None, tuple[str, ...]]:
    """The lens by the EXIF data of the first picture, and a note about it. None if they say nothing of it."""
    first = source.paths[0]
    photo = read_photograph(first, longest_px=max(source.size_px), what="image")
    if photo.assumed:
        return None, ()
    return Lens(photo.intrinsics_px, photo.size_px), (f"image {first.name}: {photo.told}, for all images",)


def _removed(lens: Lens | None) -> tuple[str, ...]:
    return (f"{lens.note()}, is removed",) if lens is not None and lens.distorts else ()


def _by_board(camera: CameraConfig, source: Source, lens: Lens | None) -> BoardPoses | None:
    """The poses from a board, None if there is none. Images of a folder may be taken far from one another. Raises
    SaccadeError if nothing tells the intrinsics."""
    if camera.board is None:
        return None
    if lens is None:
        raise SaccadeError(BOARD_NEEDS)
    from saccade.services.camera.board_poses import BoardPoses  # loads a filter that nothing else here needs

    board, *more = read_boards((camera.board, *camera.more_boards))
    return BoardPoses(board, lens, camera.board, smooth=not isinstance(source, Folder), more=more)


def _goal_of(config: Config, virtual_camera: VirtualCamera) -> GoalImage | None:
    """The goal image, or None if the agent explores.

    A file of the size of the camera's images is taken as one of them if its intrinsics are not given. Raises
    SaccadeError as `read_goal_image` does.
    """
    scene = config.scene
    if scene.goal_image is None or scene.explore:
        return None
    if scene.goal_intrinsics_px is None:
        longest_px = max(LONGEST_PX, *virtual_camera.size_px)
        photo = read_photograph(scene.goal_image, longest_px=longest_px, what="goal image")
        if photo.size_px == virtual_camera.size_px:
            return GoalImage(virtual_camera.see(photo.rgb), f"goal image {scene.goal_image.name}: as it has the size "
                             "of the camera's images, their intrinsics are used")
    return read_goal_image(scene.goal_image, scene.goal_intrinsics_px)


def _poses_of(config: Config, ros: RosSource | None) -> Poses:
    """The poses of a file, else those of a ROS source, else the one of a camera that stands still."""
    camera = config.camera
    if camera.poses is None:
        return ros.poses if ros else Poses.still(start_pose())
    poses = read_poses(camera.poses, asked=asked_of(camera))
    return with_lens(poses, ros.poses) if ros else poses


def _notes(virtual_camera: VirtualCamera, lens: Lens | None, *, still: bool) -> tuple[str, ...]:
    """Texts for the user, one line each: what is assumed because it is not given, and whether grey is filled in."""
    notes = []
    if lens is None:
        notes.append("camera.intrinsics_px is not given: the central square of each image, resized to "
                     f"{IMAGE_SIZE_PX}x{IMAGE_SIZE_PX} pixels, is assumed to have the simulator's intrinsics (focal "
                     f"length {INTRINSICS_PX[0]:.0f} px); if the true focal length differs, ranges are wrong by the "
                     "same factor")
    if virtual_camera.coverage < WHOLE:
        notes.append(f"the camera covers {virtual_camera.coverage:.0%} of the networks' field of view: the rest is "
                     "grey, and objects there count as not seen")
    if still:
        x, y, z = start_pose()[:3, 3]
        notes.append(f"camera.poses is not given: the camera is assumed to stand still at ({x:.2f}, {y:.2f}, {z:.2f}) "
                     "m and to look at the table's centre; if it moves or stands elsewhere, the positions of objects "
                     "and viewpoints are wrong; `saccade see --map` makes a map of the objects from pictures alone")
    return tuple(notes)
