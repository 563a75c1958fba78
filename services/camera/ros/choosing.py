"""Finds out which topics and frames of ROS are a camera's, from the first messages."""

from __future__ import annotations

from collections.abc import Collection
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Any

from saccade.services.camera.ros.calibration import base_of, info_topic, is_rectified, lens_of
from saccade.services.camera.ros.pixels import rgb_of
from saccade.services.camera.ros.storage import Raw
from saccade.services.camera.ros.transforms import TransformTree, name_of
from saccade.services.camera.trajectories.lens import Lens
from saccade.shared.config import CameraConfig
from saccade.shared.errors import SaccadeError, printable
from saccade.shared.ros.types import CAMERA_INFO, IMAGES, ODOMETRY, POSE, TF, RosError, decode, stamp_ns
from saccade.shared.world.images import Size

STATIC = "tf_static"
TRANSFORMS = ("tf", STATIC)
MOST_TOPICS = 1000
NAMED = 6  # topics in an error


@dataclass(frozen=True)
class Choice:
    """What is taken: the topics of the images, of their CameraInfo and of poses (None: there is none, or tf is enough),
    and the frames between which the camera's pose is. Without frames the poses are not asked for. `pose_frame` is the
    frame whose pose a PoseStamped tells. `moves` is whether a transform between the frames can change."""

    image: str
    kind: str
    size_px: Size
    info: str | None = None
    lens: Lens | None = None
    pose: str | None = None
    pose_frame: str = ""
    world_frame: str = ""
    camera_frame: str = ""
    period_s: float | None = None
    path: tuple[str, ...] = ()
    moves: bool = True

    def wants(self, topic: str) -> bool:
        """Whether a topic is read once it is chosen what to take."""
        return topic in (self.image, self.pose) or (bool(self.path) and topic.rsplit("/", 1)[-1] in TRANSFORMS)

    @property
    def told(self) -> str:
        """What was taken, in words."""
        words = [f"images {self.image} ({self.kind})", f"intrinsics {self.info}" if self.lens else "no CameraInfo used"]
        if self.path:
            words.append(f"poses of {self.camera_frame} in {self.world_frame} by {' -> '.join(self.path)}"
                         f"{f' and {self.pose}' if self.pose else ''}{'' if self.moves else ', which never changes'}")
        return ", ".join(words)


def add_transforms(tree: TransformTree, raw: Raw, pose_frame: str = "") -> None:
    """Adds what a message of tf, or of a topic of poses, says to the tree. `pose_frame` is the frame whose pose a
    PoseStamped tells. Raises RosError if it cannot be decoded, or says what cannot be."""
    if raw.data is None:
        raise RosError("it is too large or damaged")
    message = decode(raw.kind, raw.data)
    if raw.kind == TF:
        fixed = raw.topic.rsplit("/", 1)[-1] == STATIC
        for one in message.transforms:
            at, turn = one.transform.translation, one.transform.rotation
            tree.add(one.header.frame_id, one.child_frame_id, stamp_ns(one.header), (at.x, at.y, at.z),
                     (turn.x, turn.y, turn.z, turn.w), fixed=fixed)
        return
    pose = message.pose if raw.kind == POSE else message.pose.pose
    child = message.child_frame_id if raw.kind == ODOMETRY else pose_frame
    at, turn = pose.position, pose.orientation
    tree.add(message.header.frame_id, child, stamp_ns(message.header), (at.x, at.y, at.z),
             (turn.x, turn.y, turn.z, turn.w))


@dataclass
class Chooser:
    """Takes the first messages, and then says what to take. `where` names the source in errors."""

    where: str
    camera: CameraConfig
    tree: TransformTree = field(default_factory=TransformTree)
    images: dict[str, Raw] = field(default_factory=dict)  # the first message of each topic that can be decoded
    undecodable: dict[str, str] = field(default_factory=dict)  # why not, by topic
    infos: dict[str, Any] = field(default_factory=dict)
    poses: dict[str, list[Raw]] = field(default_factory=dict)
    stamps_ns: dict[str, list[int]] = field(default_factory=dict)
    seen: int = 0

    def take(self, raw: Raw) -> None:
        """Takes a message. What cannot be decoded is left out here, and counted when it is read."""
        self.seen += 1
        try:
            if raw.kind in IMAGES:
                self._take_image(raw)
            elif raw.kind == TF:
                add_transforms(self.tree, raw)
            elif raw.kind == CAMERA_INFO and raw.data is not None and raw.topic not in self.infos:
                if len(self.infos) < MOST_TOPICS:
                    self.infos[raw.topic] = decode(raw.kind, raw.data)
            elif raw.kind in (POSE, ODOMETRY) and len(self.poses) < MOST_TOPICS:
                kept = self.poses.setdefault(raw.topic, [])
                if len(kept) < 2:
                    kept.append(raw)
        except RosError:
            return

    def _take_image(self, raw: Raw) -> None:
        if raw.topic in self.images:
            stamps = self.stamps_ns[raw.topic]
            if len(stamps) < 50:
                stamps.append(raw.time_ns)
        elif len(self.images) + len(self.undecodable) < MOST_TOPICS:
            try:
                if raw.data is None:
                    raise RosError("it is too large or damaged")
                rgb_of(raw.kind, decode(raw.kind, raw.data))
            except RosError as error:
                self.undecodable.setdefault(raw.topic, str(error))
                return
            self.undecodable.pop(raw.topic, None)
            self.images[raw.topic], self.stamps_ns[raw.topic] = raw, [raw.time_ns]

    @property
    def complete(self) -> bool:
        """Whether it is clear what to take."""
        try:
            self.choose()
        except SaccadeError:
            return False
        return True

    def choose(self) -> Choice:
        """Says what to take. Raises SaccadeError if there are no images, if it is not clear which ones, or if nothing
        connects the camera with the world."""
        topic = self._image_topic()
        raw = self.images[topic]
        message = decode(raw.kind, raw.data or b"")
        height, width = rgb_of(raw.kind, message).shape[:2]
        info = info_topic(topic, self.infos) or (
            next(iter(self.infos)) if len(self.infos) == len(_bases(self.images)) == 1 else None)
        lens = self._lens(topic, info)
        stamps = sorted(self.stamps_ns[topic])
        period_s = (stamps[-1] - stamps[0]) / (len(stamps) - 1) / 1e9 if len(stamps) > 1 else 0.0
        choice = Choice(topic, raw.kind, (width, height), info if lens else None, lens,
                        period_s=period_s if 1e-3 <= period_s <= 60 else None)
        if self.camera.poses is not None or self.camera.board is not None:  # these tell the poses
            return choice
        return self._with_frames(choice, message.header.frame_id)

    def _image_topic(self) -> str:
        asked = self.camera.image_topic
        if asked is not None:
            asked = asked if asked in self.images else f"/{asked.lstrip('/')}"  # people leave the slash out
            if asked in self.images:
                return asked
            if asked in self.undecodable:
                raise SaccadeError(f"{self.where}: no image of {asked} can be decoded: {self.undecodable[asked]}")
            raise SaccadeError(f"{self.where} has no images {printable(asked)}: camera.image_topic can be "
                               f"{_listed([*self.images, *self.undecodable]) or 'nothing, because it has no images'}")
        if not self.images and self.undecodable:
            topic, why = next(iter(self.undecodable.items()))
            raise SaccadeError(f"{self.where}: no image of {printable(topic)} can be decoded: {why}")
        if not self.images:
            raise SaccadeError(f"{self.where} has no images: record a topic of sensor_msgs/Image or CompressedImage")
        candidates = _bases(self.images)
        with_info = {base: topic for base, topic in candidates.items() if info_topic(topic, self.infos)}
        if len(candidates) > 1 and len(with_info) == 1:
            candidates = with_info
        if len(candidates) > 1:
            which = "more than one has a CameraInfo" if with_info else "none has a CameraInfo"
            raise SaccadeError(f"{self.where} has images of several topics, {_listed(candidates.values())}, and {which}"
                               ": give --image-topic")
        return next(iter(candidates.values()))

    def _lens(self, topic: str, info: str | None) -> Lens | None:
        if info is None or self.camera.intrinsics_px is not None or self.camera.calibration is not None:
            return None
        try:
            return lens_of(self.infos[info], rectified=is_rectified(topic))
        except RosError as error:
            raise SaccadeError(f"{self.where}: {info}: {error}: give --intrinsics or --calibration") from error

    def _with_frames(self, choice: Choice, frame: str) -> Choice:
        """The choice with the frames between which the pose is taken: those of tf, or of a topic of poses."""
        need = "give --camera-frame and --world-frame, or the poses with --poses or --board"
        try:
            camera = name_of(self.camera.camera_frame or frame)
        except RosError as error:
            raise SaccadeError(f"{self.where}: the images of {choice.image} name no frame: give --camera-frame, or the "
                               "poses with --poses or --board") from error
        tree, topic, root = self._tree_with_poses(camera)
        world = name_of(self.camera.world_frame) if self.camera.world_frame else tree.up(camera)[-1]
        path = tree.path(world, camera)
        if not tree.knows(camera) and camera != world:
            raise SaccadeError(f"{self.where}: no transform leads from the camera's frame {camera} to the world: "
                               f"{need}")
        if path is None or len(path) < 2:
            ends = f"; from {camera} they lead to {tree.up(camera)[-1]}" if tree.knows(camera) else ""
            raise SaccadeError(f"{self.where}: no transform leads from the camera's frame {camera} to the world"
                               f"{f' ({world})' if world != camera else ''}{ends}: {need}")
        return replace(choice, pose=topic, pose_frame=root, world_frame=world, camera_frame=camera, path=tuple(path),
                       moves=tree.moves(path))

    def _tree_with_poses(self, camera: str) -> tuple[TransformTree, str | None, str]:
        """The tree, the topic of poses that is needed beside tf, and the frame at which tf ends.

        Odometry is taken if its frame is the one at which tf ends. A PoseStamped does not say whose pose it is: it is
        taken for that of the frame at which tf ends, if no transform moves the camera.
        """
        asked, tree = self.camera.pose_topic, deepcopy(self.tree)
        if asked is not None and asked not in self.poses:
            raise SaccadeError(f"{self.where} has no poses {printable(asked)}: camera.pose_topic can be "
                               f"{_listed(self.poses) or 'nothing, because it has no PoseStamped and no Odometry'}")
        up = tree.up(camera)
        root, stands = up[-1], not tree.moves(up)
        fitting = [asked] if asked else [
            topic for topic, raws in self.poses.items()
            if (raws[0].kind == ODOMETRY and _child_of(raws[0]) == root) or (raws[0].kind == POSE and stands)]
        if not fitting:
            return tree, None, root
        if len(fitting) > 1:
            raise SaccadeError(f"{self.where} has poses of several topics, {_listed(fitting)}: give "
                               "camera.pose_topic")
        for raw in self.poses[fitting[0]]:
            try:
                add_transforms(tree, raw, root)
            except RosError as error:
                raise SaccadeError(f"{self.where}: {fitting[0]} holds no pose: {error}: give --poses") from error
        return tree, fitting[0], root


def _child_of(raw: Raw) -> str:
    try:
        return name_of(decode(raw.kind, raw.data or b"").child_frame_id)
    except RosError:
        return ""


def _bases(topics: Collection[str]) -> dict[str, str]:
    """One topic for each camera: the images themselves rather than those that image_transport compresses."""
    found: dict[str, str] = {}
    for topic in sorted(topics, key=len):
        found.setdefault(base_of(topic), topic)
    return found


def _listed(topics: Collection[str]) -> str:
    names = [printable(topic, 100) for topic in sorted(topics)]
    return ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")
