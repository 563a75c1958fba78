"""What Foxglove and Rerun are given of a log says what the run's messages said, in their conventions."""

from __future__ import annotations

import io
import json
import math
from collections import defaultdict

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from PIL import Image
from scipy.spatial.transform import Rotation

from saccade.app.log import foxglove as scene
from saccade.app.log.export import export_foxglove
from saccade.app.log.fields import kinds
from saccade.app.palette import COLOURS
from saccade.shared.bus.messages import ArraySpec
from saccade.shared.bus.topics import BELIEF, FRAME, GOAL, PERCEPT, PLAN, STATUS, TOPICS
from saccade.shared.log.migrations import FORMAT
from saccade.shared.log.reading import RunReader
from saccade.shared.world.geometry import project
from saccade.tests.fakes.logs import CENTERS, GOAL_CAMERA, INTRINSICS, SIZE, START_NS, camera_at, of, story, write
from saccade.tests.samples import sample


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A log, its messages, and its export: {topic: [(time, message as its schema in the file decodes it)]}."""
    folder = tmp_path_factory.mktemp("run")
    messages = list(story())
    log = write(folder / "run.mcap", messages)
    counts = export_foxglove(log, folder / "out.mcap")
    return log, messages, counts, decoded(folder / "out.mcap")


def decoded(path):
    """{topic: [(time, message)]}, the messages decoded by the schemas in the file."""
    told = defaultdict(list)
    with path.open("rb") as stream:
        for schema, channel, record, message in make_reader(
                stream, validate_crcs=True, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
            told[channel.topic].append((record.log_time, message))
    return dict(told)


def matrix(transform):
    """world_from_frame [4, 4] of a FrameTransform."""
    result = np.eye(4)
    result[:3, :3] = Rotation.from_quat([getattr(transform.rotation, c) for c in "xyzw"]).as_matrix()
    result[:3, 3] = xyz(transform.translation)
    return result


def xyz(vector):
    return [vector.x, vector.y, vector.z]


def points(cloud):
    """Positions [N, 3] and colours [N, 4] as the message's own description of its fields says."""
    types = {1: "u1", 7: "<f4"}
    names = [f.name for f in cloud.fields]
    packed = np.frombuffer(cloud.data, np.dtype({
        "names": names, "formats": [types[f.type] for f in cloud.fields], "offsets": [f.offset for f in cloud.fields],
        "itemsize": cloud.point_stride}))
    return (np.stack([packed[c] for c in "xyz"], axis=-1),
            np.stack([packed[c] for c in ("red", "green", "blue", "alpha")], axis=-1))


def test_every_topic_is_counted_and_has_the_times_of_the_log(run):
    log, messages, counts, told = run
    assert counts == {topic: len(entries) for topic, entries in told.items()}
    times = {}
    for entry in RunReader(log).entries():
        times.setdefault((entry.topic, entry.part), []).append(entry.log_time_ns)
    assert [t for t, _ in told["/camera/image"]] == times[FRAME, None]
    assert [t for t, _ in told["/belief/mug/particles"]] == times[BELIEF, "mug"]
    assert [t for t, _ in told["/values/status/planner"]] == times[STATUS, "planner"]
    stamp = told["/camera/image"][1][1].timestamp
    assert stamp.seconds * 10 ** 9 + stamp.nanos == told["/camera/image"][1][0]
    assert {name for name in told if name.startswith("/values/")} == {
        f"/values/{t.name}" + (f"/{p}" if p else "") for t, p, _ in messages}


def test_images_are_exact(run):
    _, messages, _, told = run
    for topic, source in (("/camera/image", FRAME), ("/goal/image", GOAL)):
        for (_, shown), message in zip(told[topic], of(messages, source), strict=True):
            assert shown.format == "png"
            assert np.array_equal(np.asarray(Image.open(io.BytesIO(shown.data))), message.rgb)
    _, depth = told["/camera/depth"][0]
    assert (depth.width, depth.height, depth.encoding) == (SIZE[1], SIZE[0], "32FC1")
    assert np.array_equal(np.frombuffer(depth.data, "<f4").reshape(SIZE), of(messages, FRAME)[0].depth_m)


@pytest.mark.parametrize(("name", "camera"), [("camera", camera_at(1)), ("goal", GOAL_CAMERA), ("plan", camera_at(2))])
def test_the_optical_frames_map_a_world_point_onto_the_pixel_of_our_camera(run, name, camera):
    told = run[3]
    pose, calibration = told[f"/{name}/pose"][1][1], told[f"/{name}/calibration"][1][1]
    assert (pose.parent_frame_id, pose.child_frame_id) == ("world", calibration.frame_id)
    assert (calibration.width, calibration.height) == (SIZE[1], SIZE[0])
    if name != "plan":
        assert told[f"/{name}/image"][1][1].frame_id == calibration.frame_id
    point = np.array([0.12, 0.03, 0.02, 1.0])
    seen = np.linalg.inv(matrix(pose)) @ point
    pixel, depth = project(point[:3], camera, INTRINSICS)
    assert seen[2] == pytest.approx(float(depth))
    for projected in (np.array(calibration.K).reshape(3, 3) @ seen[:3], np.array(calibration.P).reshape(3, 4) @ seen):
        assert projected[:2] / projected[2] == pytest.approx(pixel)


def test_particles_come_back_in_the_colours_of_the_picture(run):
    _, messages, _, told = run
    for name, code in zip(("can", "mug"), COLOURS, strict=False):  # by the order of their names
        for (_, cloud), belief in zip(told[f"/belief/{name}/particles"], of(messages, BELIEF, name), strict=True):
            positions, colours = points(cloud)
            assert cloud.frame_id == "world"
            assert np.array_equal(positions, belief.particles_m)
            assert set(map(tuple, colours.tolist())) == {(*bytes.fromhex(code[1:]), round(255 * 0.8))}


def test_the_ellipsoid_is_the_covariance(run):
    _, messages, _, told = run
    entity = told["/belief/mug/spread"][0][1].entities[0]
    sphere, belief = entity.spheres[0], of(messages, BELIEF, "mug")[0]
    axes = Rotation.from_quat([getattr(sphere.pose.orientation, c) for c in "xyzw"]).as_matrix()
    assert axes @ np.diag(np.square(xyz(sphere.size)) / 4) @ axes.T == pytest.approx(belief.covariance_m2, abs=1e-9)
    assert xyz(sphere.pose.position) == pytest.approx(belief.mean_m)
    assert entity.texts[0].text == "mug 80%"


def test_true_objects_are_marked_with_their_names(run):
    told = run[3]
    entity = told["/truth/labels"][0][1].entities[0]
    assert [text.text for text in entity.texts] == ["mug (target)", "can"]
    assert np.array([xyz(sphere.pose.position) for sphere in entity.spheres]) == pytest.approx(CENTERS)
    arrow = entity.arrows[1].pose.orientation
    assert Rotation.from_quat([arrow.x, arrow.y, arrow.z, arrow.w]).as_euler("xyz") == pytest.approx([0, 0, -1.0])
    assert points(told["/truth/objects"][0][1])[0] == pytest.approx(CENTERS, abs=1e-7)


def test_the_path_grows_step_by_step_and_starts_anew_with_an_episode(run):
    told = run[3]
    paths = [points(cloud)[0] for _, cloud in told["/camera/path"]]
    assert [len(path) for path in paths] == [1, 2, 3, 4] * 2  # three views, and where the last move went
    assert paths[7] == pytest.approx(np.array([camera_at(step, 1)[:3, 3] for step in range(4)]), abs=1e-6)
    line = told["/camera/track"][7][1].entities[0].lines[0]
    assert np.array([xyz(point) for point in line.points]) == pytest.approx(paths[7], abs=1e-6)
    assert matrix(told["/camera/pose"][-1][1])[:3, 3] == pytest.approx(camera_at(2, 1)[:3, 3])  # that of the last image


def test_a_late_message_goes_where_it_belongs_in_the_path(tmp_path, monkeypatch):
    monkeypatch.setattr(scene, "MOST_VIEWS", 3)
    frames = [(FRAME, None, sample(FRAME.type, episode=episode, step=step, world_from_camera=camera_at(step, episode)))
              for episode, step in ((0, 0), (0, 2), (0, 1), (0, 1), (0, 3), (1, 0), (0, 4))]
    export_foxglove(write(tmp_path / "run.mcap", frames), tmp_path / "out.mcap")
    paths = [points(cloud)[0] for _, cloud in decoded(tmp_path / "out.mcap")["/camera/path"]]
    expected = [(0, [0]), (0, [0, 2]), (0, [0, 1, 2]), (0, [1, 2, 3]), (1, [0])]
    assert len(paths) == len(expected)
    for path, (episode, steps) in zip(paths, expected, strict=True):
        assert path == pytest.approx(np.array([camera_at(step, episode)[:3, 3] for step in steps]), abs=1e-6)


def test_numbers_are_there_to_be_plotted(run):
    _, messages, _, told = run
    for (_, shown), belief in zip(told["/values/belief/can"], of(messages, BELIEF, "can"), strict=True):
        assert (shown.presence, shown.step, shown.f_pose, shown.object) == (0.8, belief.step, belief.f_pose, "can")
        assert shown.free_energy == belief.free_energy
        assert shown.spread_cm == pytest.approx(100 * math.sqrt(np.trace(belief.covariance_m2)))
        assert list(shown.mean_m) == belief.mean_m.tolist()
        assert list(shown.covariance_m2) == belief.covariance_m2.ravel().tolist()
    entropies = [shown.goal_entropy_nats for _, shown in told["/values/belief/can"]]
    assert entropies == pytest.approx([math.nan, math.log(42), math.log(42)] * 2, nan_ok=True, rel=1e-6)
    believed = [shown.believed_distance_m for _, shown in told["/values/plan"]]
    assert believed == pytest.approx([math.nan, 0.2, 0.2] * 2, nan_ok=True)
    assert told["/values/plan"][0][1].g == of(messages, PLAN)[0].g
    true = [np.linalg.norm(camera_at(step)[:3, 3] - GOAL_CAMERA[:3, 3]) for step in range(4)]
    assert [shown.distance_m for _, shown in told["/values/truth"]][:4] == pytest.approx(true)
    assert told["/values/status/planner"][0][1].milliseconds == 7.5


@pytest.mark.parametrize("topic", TOPICS.values(), ids=lambda t: t.name)
def test_every_short_field_of_every_message_has_a_value(tmp_path, topic):
    message = sample(topic.type, object="mug") if topic in (PERCEPT, BELIEF) else sample(topic.type)
    log = write(tmp_path / "run.mcap", [(topic, "mug" if topic.parts else None, message)])
    export_foxglove(log, tmp_path / "out.mcap")
    name = f"/values/{topic.name}" + ("/mug" if topic.parts else "")
    shown = decoded(tmp_path / "out.mcap")[name][0][1]
    for field, kind in kinds(topic.type).items():
        if not isinstance(kind, ArraySpec):
            value, said = getattr(shown, field), getattr(message, field)
            if field == "further":  # of further messages only the number is shown
                said = len(said)
            assert (list(value) if kind == list[str] else value) == said
        elif all(isinstance(side, int) for side in kind.shape):
            assert list(getattr(shown, field)) == getattr(message, field).ravel().tolist()


@pytest.mark.parametrize("settings", [{"goal_image": "my.png"}, {"explore": True}])
def test_a_goal_pose_that_means_nothing_is_not_shown(tmp_path, settings):
    log = write(tmp_path / "run.mcap", story(episodes=1), configuration=json.dumps({"scene": settings}))
    export_foxglove(log, tmp_path / "out.mcap")
    told = decoded(tmp_path / "out.mcap")
    assert "/goal/pose" not in told
    assert "/goal/calibration" not in told
    assert told["/goal/image"][0][1].frame_id == ""
    assert all(math.isnan(shown.distance_m) for _, shown in told["/values/truth"])


def test_a_log_of_a_real_camera_needs_no_truth_or_depth(tmp_path):
    frame = sample(FRAME.type, depth_m=None, world_from_camera=np.eye(4))
    log = write(tmp_path / "run.mcap", [(FRAME, None, frame), (GOAL, None, sample(GOAL.type))])
    counts = export_foxglove(log, tmp_path / "out.mcap")
    assert set(counts) == {"/camera/image", "/camera/calibration", "/camera/pose", "/camera/path", "/camera/track",
                           "/values/frame", "/values/goal", "/goal/image"}
    assert decoded(tmp_path / "out.mcap")["/goal/image"][0][1].frame_id == ""
    log = write(tmp_path / "explore.mcap", [(FRAME, None, frame), (GOAL, None, sample(GOAL.type, rgb=None))])
    assert "/goal/image" not in export_foxglove(log, tmp_path / "explored.mcap")


def test_a_goal_that_comes_before_its_pose_is_shown_at_once_and_put_in_its_place_later(tmp_path):
    messages = list(story(episodes=1))
    goal = next(entry for entry in messages if entry[0] == GOAL)
    log = write(tmp_path / "run.mcap", [goal, *(entry for entry in messages if entry is not goal)])
    export_foxglove(log, tmp_path / "out.mcap")
    told = decoded(tmp_path / "out.mcap")
    assert [(time - START_NS, shown.frame_id) for time, shown in told["/goal/image"]] == [
        (0, ""), (10 ** 6, "goal_optical")]
    assert len(told["/goal/calibration"]) == 1


def test_a_matrix_that_is_no_pose_is_left_out(tmp_path):
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    for i, matrix_ in enumerate((np.zeros((4, 4)), 2 * np.eye(4), mirror)):
        log = write(tmp_path / f"{i}.mcap", [(FRAME, None, sample(FRAME.type, world_from_camera=matrix_))])
        counts = export_foxglove(log, tmp_path / f"out{i}.mcap")
        assert counts["/camera/image"] == 1
        assert "/camera/pose" not in counts


def test_the_origin_of_the_log_is_carried_over(tmp_path):
    log = write(tmp_path / "run.mcap", story(episodes=1), configuration='{"seed": 1}')
    export_foxglove(log, tmp_path / "out.mcap")
    with (tmp_path / "out.mcap").open("rb") as stream:
        reader = make_reader(stream)
        assert {m.name: m.metadata for m in reader.iter_metadata()} == {
            "log": {"format": str(FORMAT)}, "versions": {"x": "1"}, "export": {"log": "run.mcap"}}
        assert [(a.name, a.data) for a in reader.iter_attachments()] == [("config.json", b'{"seed": 1}')]
