"""The core of a real camera: its images with their poses, in the simulator's place."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from saccade.services.camera.poses import Poses, read_poses
from saccade.services.camera.sources import Source, SourceImage, open_source
from saccade.services.camera.virtual_camera import VirtualCamera
from saccade.shared.bus.messages import Frame, Goal
from saccade.shared.bus.topics import ACTION, FRAME, GOAL, Output
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.service import Inputs, Service
from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX
from saccade.shared.world.images import image_size, read_goal_image, read_image
from saccade.shared.world.task import start_pose

SERVICE = Service("camera", inputs=(ACTION,), trigger=ACTION, outputs=(FRAME, GOAL))
WHOLE = 0.995  # of the field of view; what is less is said


class Camera:
    """The images of a source as the networks know them, with INTRINSICS_PX and their poses.

    They are one episode, the first; a camera that is started again in a run begins another one. Whoever drives it asks
    for the next frame every `period_s` seconds. Images without a pose are `skipped`. With `loop`
    the source begins anew when it has ended. `goal_rgb` [480, 480, 3]; without it the agent explores. `notes`: what is
    assumed, a line each, for the user.
    """

    episodes = 1

    def __init__(self, source: Source, poses: Poses, virtual_camera: VirtualCamera, *,
                 goal_rgb: NDArray[np.uint8] | None = None, loop: bool = False, notes: tuple[str, ...] = ()):
        self.source, self.poses, self.virtual_camera = source, poses, virtual_camera
        self.goal_rgb, self.loop, self.notes = goal_rgb, loop, notes
        self.period_s, self.skipped = source.period_s, 0

    def begin(self, run: str, episode: int) -> list[Output]:
        """The goal and the first frame. Raises SaccadeError where no image has a pose."""
        self._run, self._episode, self._published, self.skipped = run, episode, 0, 0
        self._first: SourceImage | None = None
        self._images = self._all_images()
        frame = self.next_frame()
        if not frame:
            seen = f"{self.skipped} images of {self.source.name} ({self._first} to {self._last})"
            raise SaccadeError(f"none of the {seen} has a pose in {self.poses}: give poses by the images' names, "
                               "indices or times")
        goal = Goal(run=run, episode=episode, step=0, rgb=self.goal_rgb, intrinsics_px=np.array(INTRINSICS_PX))
        return [Output(GOAL, goal), *frame]

    def next_frame(self) -> list[Output]:
        """The frame of the next image that has a pose; nothing when there is none. Raises SaccadeError for an image
        that cannot be read."""
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
        """Nothing: an action is the viewpoint to move to, and this camera is moved by others."""
        return []

    def _all_images(self) -> Iterator[SourceImage]:
        yield from self.source
        while self.loop and self._published:
            yield from self.source


def build(config: Config) -> Camera:
    """The camera of a configuration. Raises SaccadeError for what is missing or damaged, before anything runs."""
    camera = config.camera
    if camera.source is None:
        raise SaccadeError("camera.source is not given: give a folder of images, a video file, or a webcam (webcam:0)")
    source = open_source(camera.source, rate_hz=camera.rate_hz)
    virtual_camera = VirtualCamera(source.size_px, camera.intrinsics_px)
    poses = Poses.still(start_pose()) if camera.poses is None else read_poses(camera.poses, camera.pose_convention)
    return Camera(source, poses, virtual_camera, goal_rgb=_goal_rgb(config, virtual_camera), loop=camera.loop,
                  notes=_notes(config, virtual_camera))


def _goal_rgb(config: Config, virtual_camera: VirtualCamera) -> NDArray[np.uint8] | None:
    """The goal image, of the camera's own size (and then resampled like its images) or of 480x480 pixels."""
    path = config.scene.goal_image
    if path is None or config.scene.explore:
        return None
    size, (width, height) = image_size(path, what="goal image"), virtual_camera.size_px
    if size == (width, height):
        return virtual_camera.see(read_image(path, what="goal image"))
    if size != (IMAGE_SIZE_PX, IMAGE_SIZE_PX):
        raise SaccadeError(f"goal image {path} is {size[0]}x{size[1]} pixels: give one of {width}x{height}, as the "
                           f"camera's images, or of {IMAGE_SIZE_PX}x{IMAGE_SIZE_PX}")
    return read_goal_image(path)


def _notes(config: Config, virtual_camera: VirtualCamera) -> tuple[str, ...]:
    notes = []
    if config.camera.intrinsics_px is None:
        notes.append(f"camera.intrinsics_px is not given: the simulator's (focal length {INTRINSICS_PX[0]:.0f} px) are "
                     f"assumed of the images' central square at {IMAGE_SIZE_PX}x{IMAGE_SIZE_PX} pixels; ranges are as "
                     "wrong as the focal length")
    if virtual_camera.coverage < WHOLE:
        notes.append(f"the camera covers {virtual_camera.coverage:.0%} of the networks' field of view: the rest is "
                     "grey, and what is there counts as not seen")
    if config.camera.poses is None:
        x, y, z = start_pose()[:3, 3]
        notes.append(f"camera.poses is not given: the camera is taken to stand still at ({x:.2f}, {y:.2f}, {z:.2f}) m, "
                     "looking at the table's centre; positions cannot be fused over views, viewpoints cannot be placed "
                     "in the world")
    return tuple(notes)
