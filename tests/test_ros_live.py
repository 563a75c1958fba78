"""ROS 2 live: frames from nodes with rmw_zenoh, and the viewpoint and the beliefs back to them, over a real router."""

from __future__ import annotations

import itertools
import queue
import threading
from contextlib import closing, contextmanager

import numpy as np
import pytest
import zenoh
import zenoh.ext
from scipy.spatial.transform import Rotation

from saccade.app.run.registry import agent_processes
from saccade.services.camera.core import build
from saccade.services.camera.ros import live
from saccade.services.camera.ros.choosing import Chooser
from saccade.services.camera.ros.live import Ears, LiveSource
from saccade.services.camera.ros.storage import Raw
from saccade.services.ros import bridge
from saccade.services.ros.bridge import Node
from saccade.services.ros.core import PRESENT, Teller
from saccade.shared.bus.messages import Belief, Plan
from saccade.shared.bus.session import open_session
from saccade.shared.bus.topics import BELIEF, PLAN
from saccade.shared.bus.transport import free_endpoint
from saccade.shared.bus.wire import encode
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.process import Health, Inbox
from saccade.shared.ros.keys import attachment, key_of, keys_of, parse_key
from saccade.shared.ros.types import IMAGE as IMAGE_TYPE
from saccade.shared.ros.types import MARKERS, POSE, decode, hash_of
from saccade.tests.fakes import ros
from saccade.tests.fakes.camera import HERE, THERE, complaint
from saccade.tests.fakes.ros import FIRST_NS, IMAGE, INFO, OPTICAL, SIZE, STEP_NS, TF, TF_STATIC, WORLD
from saccade.tests.samples import sample

WAIT_S = 30  # for what must come; nothing is asserted about how long it takes


@pytest.fixture
def endpoint():
    """A router of ROS 2."""
    where = free_endpoint("tcp/127.0.0.1:0")
    with closing(open_session(where, listen=True, onlooker=False, timeout_s=WAIT_S)):
        yield where


def config_of(endpoint, source=f"ros:{IMAGE}", **values):
    return Config().with_values({"ros.router": endpoint, "camera.source": source, "camera.rate_hz": 100,
                                 "camera.world_frame": WORLD, **values})


class CameraNode:
    """Publishes an image, its CameraInfo and the base's pose in every period, and the camera's pose on it once."""

    def __init__(self, endpoint, type_hash=None):
        config = zenoh.Config.from_json5(
            f'{{mode: "client", connect: {{endpoints: ["{endpoint}"]}}, timestamping: {{enabled: true}}}}')
        self._session, self._hash = zenoh.open(config), type_hash
        self._stop, self.sent = threading.Event(), 0
        fixed = ros.tf(FIRST_NS, ("base", OPTICAL, ros.optical(HERE)))
        self._fixed = zenoh.ext.declare_advanced_publisher(
            self._session, self._key(TF_STATIC, fixed), cache=zenoh.ext.CacheConfig(1), publisher_detection=True)
        self._fixed.put(ros.cdr(fixed))
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _key(self, topic, message):
        return key_of(0, topic, message.__msgtype__, self._hash or hash_of(message.__msgtype__))

    def publish(self, topic, message):
        self._session.put(self._key(topic, message), ros.cdr(message), attachment=attachment(1, 0, bytes(16)))

    def once(self):
        time_ns = FIRST_NS + self.sent * STEP_NS
        base = np.eye(4)
        base[0, 3] = 0.001 * self.sent
        self.publish(TF, ros.tf(time_ns, (WORLD, "base", base)))
        self.publish(INFO, ros.info(time_ns))
        self.publish(IMAGE, ros.image(time_ns, np.full((SIZE[1], SIZE[0], 3), self.sent % 200, np.uint8)))
        self.sent += 1

    def _run(self):
        while not self._stop.wait(0.01):
            self.once()

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()
        self._fixed.undeclare()
        self._session.close()


@contextmanager
def camera_on(config):
    camera = build(config)
    try:
        yield camera
    finally:
        camera.source.close()


@pytest.mark.parametrize("type_hash", [None, "TypeHashNotSupported"])  # as in Jazzy, and as in Humble
def test_the_images_of_a_node_come_with_their_poses(endpoint, type_hash):
    """The fixed transform was published before the camera service was there."""
    with CameraNode(endpoint, type_hash), camera_on(config_of(endpoint)) as camera:
        frames = [camera.begin("r", 0)[1].message, *(camera.next_frame()[0].message for _ in range(5))]
    numbers = [int(np.median(frame.rgb)) for frame in frames]
    assert len(set(numbers)) == 6
    for number, frame in zip(numbers, frames, strict=True):
        moved = frame.world_from_camera[:3, 3] - HERE[:3, 3]
        assert (moved[0] * 1000 - number) % 200 == pytest.approx(0, abs=1e-6)  # the pose is that of this image
        np.testing.assert_allclose(frame.world_from_camera[:3, :3], HERE[:3, :3], atol=1e-9)
    assert camera.notes[0] == (f"ROS at {endpoint}: images {IMAGE} ({IMAGE_TYPE}), intrinsics {INFO}, poses of "
                               f"{OPTICAL} in {WORLD} by {WORLD} -> base -> {OPTICAL}")


def test_messages_that_are_none_are_counted(endpoint):
    with CameraNode(endpoint) as node, camera_on(config_of(endpoint)) as camera:
        camera.begin("r", 0)
        for payload in (b"", b"\0\1\0\0", bytes(100)):
            node._session.put(key_of(0, IMAGE, IMAGE_TYPE, "x"), payload)
            node._session.put(f"0{IMAGE}/odd/x", payload)
        while camera.refused < 3:
            assert camera.next_frame()
        assert camera.next_frame()


def test_what_is_missing_is_said(endpoint, monkeypatch):
    monkeypatch.setattr(live, "FOUND_S", 1.0)
    assert f"ros:{IMAGE} gives no image: is its name right" in complaint(build, config_of(endpoint))
    assert "topic '/a b' is not a name of ROS" in complaint(build, config_of(endpoint, "ros:/a b"))


class Script:
    """Ears that hear one period after the other. From the fourth on, one topic is silent."""

    dropped = 0

    def __init__(self, silent):
        self._silent, self.count = silent, 0
        self._raws = [Raw(topic, message.__msgtype__, ros.cdr(message), time_ns)
                      for topic, time_ns, message in ros.plain(100, HERE)]

    def heard(self, _timeout_s):
        k, self.count = self.count, self.count + 1
        period = self._raws[:4] if k == 0 else self._raws[3 * k + 1:3 * k + 4]
        return [raw for raw in period if k < 3 or raw.topic != self._silent]


def test_the_root_of_tf_is_chosen_when_all_of_it_was_heard():
    """The fixed transform is there at once, the one above it some periods later."""
    class Late(Script):
        def heard(self, timeout_s):
            raws = super().heard(timeout_s)
            return raws if self.count > 8 else [raw for raw in raws if raw.topic != TF]

    for camera in (Config().camera, config_of("x").camera):
        chooser, clock = Chooser("here", camera), itertools.count(0, 0.1)
        choice = live._chosen(chooser, Late(""), IMAGE, lambda clock=clock: next(clock))
        assert choice.path == (WORLD, "base", OPTICAL)


@pytest.mark.parametrize(("silent", "words", "without_pose"), [
    (IMAGE, f"ros:{IMAGE} gives no image: does the node that publishes it still run", False),
    (TF, "no transform led from camera_optical to world: is tf still published", True)])
def test_a_topic_or_tf_that_falls_silent_is_said(silent, words, without_pose):
    """By a clock that goes on by a tenth of a second whenever it is asked."""
    chooser, clock, images = Chooser("here", Config().camera), itertools.count(0, 0.1), []
    for raw in Script("").heard(0):
        chooser.take(raw)
    source = LiveSource(None, [], Script(silent), chooser.choose(), chooser, 10.0, clock=lambda: next(clock))
    with pytest.raises(SaccadeError, match=words):
        images.extend(source)
    assert [image.index for image in images[:3]] == [0, 1, 2]
    assert all(image.world_from_camera is not None for image in images[:3])
    assert (images[-1].world_from_camera is None) == without_pose


def test_a_router_that_is_not_there_is_said(monkeypatch):
    monkeypatch.setattr("saccade.shared.ros.session.ROUTER_S", 0.2)
    said = complaint(build, config_of("tcp/127.0.0.1:9"))
    assert said.startswith("ros.router: at tcp/127.0.0.1:9 does not answer")
    assert said.endswith("`ros2 run rmw_zenoh_cpp rmw_zenohd` starts the router of ROS 2")


def test_what_nobody_takes_is_bounded(monkeypatch):
    monkeypatch.setattr(live, "MOST_HELD_BYTES", 1000)
    ears = Ears()
    for _ in range(20):
        ears.hear(Raw(IMAGE, IMAGE_TYPE, bytes(100), 0))
    assert (len(ears.heard(0)), ears.dropped) == (10, 10)
    ears.hear(Raw(IMAGE, IMAGE_TYPE, bytes(100), 0))
    assert len(ears.heard(0)) == 1


def test_keys_are_those_of_rmw_zenoh():
    """The examples are those of its documentation."""
    kind, type_hash = "std_msgs/msg/String", "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    key = f"0/chatter/std_msgs::msg::dds_::String_/{type_hash}"
    assert key_of(0, "/chatter", kind, type_hash) == key
    assert parse_key(key) == ("/chatter", kind)
    assert parse_key("0/a/b/sensor_msgs::msg::dds_::Image_/TypeHashNotSupported") == ("/a/b", IMAGE_TYPE)
    assert [parse_key(text) for text in ("saccade/table/frame", "0/x", "0/chatter/String/x")] == [None] * 3
    for topic in (key_of(0, "/chatter", kind), keys_of(0, "/chatter")):
        assert zenoh.KeyExpr(topic).includes(zenoh.KeyExpr(key))
    number, time_ns, gid = zenoh.ext.z_deserialize(
        tuple[zenoh.ext.Int64, zenoh.ext.Int64, bytes], zenoh.ZBytes(attachment(7, 2 ** 60, bytes(range(16)))))
    assert (int(number), int(time_ns), gid) == (7, 2 ** 60, bytes(range(16)))


def believed(name="mug", presence=0.9, **more):
    turn = Rotation.from_euler("z", 0.3).as_matrix()
    covariance = turn @ np.diag([0.01, 0.0004, 0.0001]) @ turn.T
    return sample(Belief, run="r", episode=0, step=3, object=name, presence=presence, mean_m=np.array([0.1, 0.2, 0.3]),
                  covariance_m2=covariance, **more)


def planned(**more):
    return sample(Plan, run="r", episode=0, step=3, viewpoint=THERE, **more)


def test_the_viewpoint_is_that_of_the_optical_frame():
    (kind, pose), = Teller(("mug",), "table").take(planned(), 5 * 10 ** 9 + 7)
    assert kind == POSE
    assert (pose.header.frame_id, pose.header.stamp.sec, pose.header.stamp.nanosec) == ("table", 5, 7)
    at, turn = pose.pose.position, pose.pose.orientation
    np.testing.assert_allclose((at.x, at.y, at.z), THERE[:3, 3])
    axes = Rotation.from_quat((turn.x, turn.y, turn.z, turn.w)).as_matrix()
    np.testing.assert_allclose(axes[:, 2], -THERE[:3, 2], atol=1e-9)  # forward
    np.testing.assert_allclose(axes[:, 1], -THERE[:3, 1], atol=1e-9)  # down


def test_a_belief_is_an_ellipsoid_with_its_name():
    teller = Teller(("cup", "mug"), "world")
    assert teller.take(believed(), 0) == []
    _, (kind, array) = teller.take(planned(), 0)
    assert kind == MARKERS
    ball, name = decode(MARKERS, ros.cdr(array)).markers
    assert (ball.id, name.id, ball.ns, name.ns, name.text) == (1, 1, "beliefs", "names", "mug 90%")
    turn = Rotation.from_quat([getattr(ball.pose.orientation, axis) for axis in "xyzw"]).as_matrix()
    radii_m = np.array([ball.scale.x, ball.scale.y, ball.scale.z]) / 2
    np.testing.assert_allclose(turn @ np.diag((radii_m / 2) ** 2) @ turn.T, believed().covariance_m2, atol=1e-9)
    assert name.pose.position.z > ball.pose.position.z + radii_m.max()


def test_what_is_believed_to_be_gone_is_removed_and_an_episode_begins_with_nothing():
    teller = Teller(("mug",), "world")
    teller.take(believed(presence=PRESENT - 0.1), 0)
    assert {marker.action for marker in teller.take(planned(), 0)[1][1].markers} == {2}
    teller.take(believed(name="stranger"), 0)
    assert [kind for kind, _ in teller.take(sample(Plan, run="r", episode=1, step=0, viewpoint=HERE), 0)] == [POSE]


def test_nodes_hear_the_viewpoint_and_the_beliefs(endpoint):
    """Under the keys that their subscriptions have, with an attachment; and they see the node."""
    config = config_of(endpoint).ros
    heard, tokens = queue.SimpleQueue(), []
    with closing(open_session(endpoint, listen=False, onlooker=False, timeout_s=WAIT_S)) as session:
        for topic, kind in (("/saccade/viewpoint", POSE), ("/saccade/beliefs", MARKERS)):
            session.declare_subscriber(key_of(0, topic, kind, hash_of(kind)), heard.put)
        with closing(Node(config)) as node:
            while len(tokens) < 3:
                tokens = [str(reply.ok.key_expr) for reply in session.liveliness().get("@ros2_lv/0/**") if reply.ok]
            inbox = Inbox()
            for topic, part, message in ((BELIEF, "mug", believed()), (PLAN, None, planned()), (PLAN, None, planned()),
                                         (PLAN, None, sample(Plan, run="other", viewpoint=HERE))):
                inbox.put(topic, part, encode(message))
            inbox.put(PLAN, None, b"no message")
            health = Health("ros", at=("r", 0, 0))
            thread = threading.Thread(target=bridge.bridge, args=(Teller(("mug",), "world"), node, inbox, health))
            thread.start()
            samples = [heard.get(timeout=WAIT_S) for _ in range(2)]
            inbox.stop()
            thread.join()
    assert {type(decode(parse_key(str(s.key_expr)).kind, s.payload.to_bytes())).__name__ for s in samples} == {
        "geometry_msgs__msg__PoseStamped", "visualization_msgs__msg__MarkerArray"}
    assert all(s.attachment.to_bytes()[:8] == (1).to_bytes(8, "little") and len(s.attachment) == 33 for s in samples)
    assert (health.received, health.published, health.at) == (5, 2, ("r", 0, 3))
    zid = tokens[0].split("/")[2]
    assert sorted(tokens) == sorted([
        f"@ros2_lv/0/{zid}/0/0/NN/%/%/saccade",
        f"@ros2_lv/0/{zid}/0/1/MP/%/%/saccade/%saccade%viewpoint/geometry_msgs::msg::dds_::PoseStamped_/"
        f"{hash_of(POSE)}/::,:,:,:,,",
        f"@ros2_lv/0/{zid}/0/2/MP/%/%/saccade/%saccade%beliefs/visualization_msgs::msg::dds_::MarkerArray_/"
        f"{hash_of(MARKERS)}/::,:,:,:,,"])


def test_the_bridge_is_an_onlooker_of_a_run():
    ordinary, bridged = agent_processes("sceneccn"), agent_processes("sceneccn", ros=True)
    assert bridged[:-1] == ordinary
    assert (bridged[-1].name, bridged[-1].module, bridged[-1].onlooker) == ("ros", "saccade.services.ros", True)
