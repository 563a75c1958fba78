"""`docker compose up` on a real engine, as a newcomer calls it."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import uuid
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
from rerun.chunk import RrdReader

from saccade.services.viewer.server import binary
from saccade.shared.bus.topics import ACTION, PERCEPT, RESULT
from saccade.shared.bus.transport import ZenohBus
from saccade.shared.bus.wire import encode
from saccade.shared.config import load
from saccade.shared.log.reading import RunReader
from saccade.tests.compose.conftest import BUILD_S, USER
from saccade.tests.fakes.camera import LENS_PX, film
from saccade.tests.samples import sample

SERVICES = ("router", "simulator", "perception", "belief", "planner", "evaluator", "recorder", "viewer")
EPISODES = 4  # of a run in which something is done meanwhile: some seconds more than that takes


def results(path) -> list:
    return [message for topic, _, message in RunReader(path) if topic == RESULT]


def test_up_runs_an_episode_prints_its_result_and_leaves_the_log_to_the_user(compose):
    (compose.folder / "runs").mkdir()
    os.chown(compose.folder / "runs", USER, USER)
    said = compose.up()
    assert "reached the goal in" in said
    assert f"log: runs/{compose.run.name}/run.mcap" in said
    assert compose.log().complete, list(compose.log().lines())
    assert (compose.run / "run.mcap").stat().st_uid == USER
    for service in SERVICES:
        told = compose.inspect(service)
        assert told["State"]["ExitCode"] == 0, service
        assert told["Config"]["User"] == f"{USER}:{USER}"
        assert told["HostConfig"]["ReadonlyRootfs"]
        assert told["HostConfig"]["CapDrop"] == ["ALL"]
        assert "no-new-privileges:true" in told["HostConfig"]["SecurityOpt"]
        assert told["HostConfig"]["Memory"] > 0
        assert any(probe["ExitCode"] == 0 for probe in told["State"]["Health"]["Log"])
        assert told["HostConfig"]["LogConfig"]["Config"]["max-size"]


def test_the_run_can_be_seen_while_it_goes_on_and_for_a_while_after(compose):
    """As a browser comes to it: the page, and the data that it names. It holds nobody up and ends by itself."""
    compose("up", "--detach", SACCADE_VIEW_S="20")
    compose.until_said("the viewer stays for 20 s")
    page = HTTPConnection("127.0.0.1", compose.view_port, timeout=20)
    page.request("GET", "/")
    sent = page.getresponse()
    sent.read()
    data, = parse_qs(urlsplit(sent.headers["Location"]).query)["url"]
    late = compose.folder / "late.rrd"
    with subprocess.Popen([binary(), "--save", late, data], stdout=subprocess.DEVNULL) as browser:
        assert compose.until_ended("viewer") == 0
        browser.send_signal(signal.SIGINT)
    seen = {chunk.entity_path for chunk in RrdReader(late).stream().to_chunks()}
    assert {"/world/camera/image", "/world/candidates", "/crops/image", "/F", "/G", "/decisions"} <= seen
    assert compose.log().complete


def test_killed_containers_are_started_again_and_the_run_ends_as_it_would_have(compose):
    """One after the other, each in an episode of its own."""
    killed = ("perception", "simulator", "recorder", "router")
    compose("up", "--detach", SACCADE_COUNT=str(2 * len(killed)))
    for n, service in enumerate(killed):
        compose.until_said(f"episode {2 * n} step 0")
        compose.kill(service)
    compose.until_said("log: runs/")
    assert compose.until_ended("recorder") == 0
    assert {service: compose.inspect(service)["RestartCount"] for service in killed} == dict.fromkeys(killed, 1)
    assert compose.log().complete, list(compose.log().lines())
    assert [result.success for result in results(compose.run / "run.mcap")] == [True] * 2 * len(killed)


def test_three_replicas_share_the_objects(compose):
    compose.up("--scale", "perception=3")
    assert compose.log().complete, list(compose.log().lines())
    steps = {part: [m.step for topic, p, m in RunReader(compose.run / "run.mcap") if (topic, p) == (PERCEPT, part)]
             for part in ("soup_can", "cereal_box")}
    assert steps["soup_can"] == steps["cereal_box"] == list(range(len(steps["soup_can"])))
    assert {compose.inspect("perception", number)["State"]["ExitCode"] for number in (1, 2, 3)} == {0}


def test_a_replica_that_dies_is_replaced_by_the_others(compose):
    compose("up", "--detach", "--scale", "perception=3", SACCADE_COUNT=str(EPISODES))
    compose.until_said("episode 0 step 0")
    compose.kill("perception", 2)
    compose.until_said("log: runs/")
    assert compose.until_ended("recorder") == 0
    assert compose.log().complete, list(compose.log().lines())
    assert len(results(compose.run / "run.mcap")) == EPISODES


def test_worlds_run_at_once(compose):
    said = compose.up(SACCADE_WORLDS="2")
    for world in ("table-0", "table-1"):
        assert f"{world}: log: runs/{compose.run.name}/{world}/run.mcap" in said
        assert compose.log(world).complete, list(compose.log(world).lines())
    first, second = (results(compose.run / world / "run.mcap")[0].scene for world in ("table-0", "table-1"))
    assert first != second


def test_a_stopped_run_has_closed_its_log(compose):
    compose("up", "--detach", SACCADE_COUNT="20")
    compose.until_said("episode 1 step 0")
    compose("stop")
    assert compose.log().cut is None
    codes = {service: compose.inspect(service)["State"]["ExitCode"] for service in SERVICES}
    assert set(codes.values()) == {0}, codes  # 137: it was killed because it took more than 10 s


def test_a_run_that_is_stopped_at_once_is_over_at_once(compose):
    """Services that have only just begun obey too. (The viewer has what others leave of the processors: maybe none.)"""
    compose("up", "--detach")
    compose("stop")
    codes = {name: compose.inspect(name)["State"]["ExitCode"] for name in SERVICES if name != "viewer"}
    assert 137 not in codes.values(), codes


def test_a_camera_stands_in_the_simulators_place(compose):
    """Its files are named as they lie in the folder of compose.yaml."""
    centers = film(compose.folder / "table.avi", compose.folder / "poses.jsonl", 12)
    said = compose.up(COMPOSE_PROFILES="camera", SACCADE_SOURCE="table.avi", SACCADE_POSES="poses.jsonl",
                      SACCADE_AGENT="sceneccn",  # the film is in flat light, and as short as its networks are fast
                      SACCADE_INTRINSICS=",".join(map(str, LENS_PX)))
    assert all(f"found {name} at" in said for name in centers), said
    assert compose.log().complete, list(compose.log().lines())


def test_a_run_in_a_folder_that_docker_makes_is_the_users_and_is_replayed_into_perception(compose):
    compose.up()
    assert (compose.run / "run.mcap").stat().st_uid == USER
    said = compose("run", "--rm", "--no-TTY", "replay", timeout_s=BUILD_S)
    assert "loss: 0 of" in said, said  # and its exit code says that nothing differs


def test_other_weights_by_name(compose):
    shutil.copytree(compose.folder / "weights" / "pantry", compose.folder / "weights" / "mine")
    assert "reached the goal" in compose.up("--build", SACCADE_PERCEPTION="mine", timeout_s=BUILD_S)
    assert load(compose.run / "config.json").perception.weights.name == "mine"
    compose("up", "--detach", SACCADE_PERCEPTION="nobodys")
    assert "/saccade/weights/nobodys/manifest.json are missing" in compose.until_said("saccade: ")


def test_another_agent_by_name_and_the_services_it_does_without_wait_for_the_end(compose):
    said = compose.up(SACCADE_AGENT="random-walk", SACCADE_SET="simulator.max_steps=5")
    assert "in 5 steps" in said or "reached the goal in" in said
    assert load(compose.run / "config.json").services.planner == "saccade.services.planner.random_walk"
    topics = {topic for topic, _, _ in RunReader(compose.run / "run.mcap")}
    assert ACTION in topics
    assert PERCEPT not in topics
    for service in ("perception", "belief"):
        assert compose.inspect(service)["State"]["ExitCode"] == 0, service
    assert compose.log().complete, list(compose.log().lines())


@pytest.mark.parametrize(("agent", "images"), [
    ("posecnn", {}),
    ("lexa", {"SACCADE_PLANNER_IMAGE": "planner-lexa"}),
    ("render-and-compare", {"SACCADE_PERCEPTION_IMAGE": "perception-meshes"}),
])
def test_the_other_systems_run_in_containers(compose, agent, images):
    scans = os.environ.get("SACCADE_YCB")
    if scans is None:
        pytest.skip("no YCB scans: set SACCADE_YCB to their folder")
    said = compose.up("--build", SACCADE_AGENT=agent, SACCADE_OBJECTS="ycb", SACCADE_YCB=str(Path(scans).resolve()),
                      SACCADE_SET="simulator.max_steps=5", timeout_s=BUILD_S, **images)
    assert "in 5 steps" in said or "reached the goal in" in said, said
    assert compose.log().complete, list(compose.log().lines())
    topics = {topic for topic, _, _ in RunReader(compose.run / "run.mcap")}
    assert ACTION in topics
    assert (PERCEPT in topics) == (agent != "lexa")


def test_a_second_simulator_is_refused_and_the_run_goes_on(compose):
    said = compose.up("--scale", "simulator=2")
    assert said.count("saccade: another simulator is in this world already") == 1
    assert "reached the goal in" in said
    assert compose.log().complete, list(compose.log().lines())


def test_a_message_of_another_release_is_told_by_who_refuses_it(compose):
    compose("up", "--detach", SACCADE_COUNT=str(EPISODES))
    compose.until_said("episode 0 step 0")
    bus = ZenohBus(f"tcp/127.0.0.1:{compose.port}", world="table")
    action = encode(sample(ACTION.type))
    bus.publish(ACTION, None, action.replace(b"\xa7version\x01", b"\xa7version\x02"))
    said = compose.until_said("log: runs/")
    bus.close()
    assert said.count("saccade: simulator: refused: action: version: 2, not 1: it comes from another release") == 1
    assert compose.until_ended("recorder") == 0
    assert [result.success for result in results(compose.run / "run.mcap")] == [True] * EPISODES


def test_scans_are_mounted(compose):
    scans = os.environ.get("SACCADE_YCB")
    if scans is None:
        pytest.skip("no YCB scans: set SACCADE_YCB to their folder")
    assert "reached the goal" in compose.up(SACCADE_OBJECTS="ycb", SACCADE_YCB=str(Path(scans).resolve()))
    assert compose.log().complete, list(compose.log().lines())


def test_missing_scans_are_told_by_the_simulator_alone(compose):
    compose("up", "--detach", SACCADE_OBJECTS="ycb")
    said = compose.until_said("set SACCADE_YCB to a folder")
    assert said.count("saccade: ") == 1
    assert {s for s in SERVICES if compose.inspect(s)["State"]["Status"] == "running"} == set(SERVICES)


def test_a_folder_of_someone_else_is_told_by_the_director(compose):
    (compose.folder / "runs").mkdir()
    os.chown(compose.folder / "runs", USER + 1, USER + 1)
    said = compose("up", "--detach", check=False) + compose("logs", "--no-color")
    assert f"/runs cannot be written by user {USER} (Permission denied)" in said


def test_a_taken_port_is_told(compose):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        said = compose("up", "--detach", check=False, SACCADE_PORT=port)
    assert port in said
    assert "in use" in said or "already allocated" in said


def test_each_image_has_its_own_services_dependencies_alone(built):
    def has(service: str, package: str) -> bool:
        return subprocess.run(["docker", "run", "--rm", "--entrypoint", "python", f"saccade/{service}", "-c",
                               f"import {package}"], capture_output=True).returncode == 0

    assert {(s, p) for s in SERVICES for p in ("torch", "mujoco", "filterpy") if has(s, p)} == {
        ("perception", "torch"), ("simulator", "mujoco"), ("belief", "filterpy")}


def test_a_changed_line_rebuilds_no_dependencies(built):
    core = built.folder / "services" / "belief" / "core.py"
    core.write_text(core.read_text() + f"\n# changed {uuid.uuid4()}\n")  # as it was never built before
    said = built("build", "--progress", "plain", "belief")
    installed = re.findall(r"^(#\d+) \[.*RUN .*pip install", said, re.M)
    assert len(installed) == 2
    assert all(f"{step} CACHED" in said for step in installed)
    copied = re.findall(r"^(#\d+) \[.*COPY services/belief", said, re.M)
    assert not any(f"{step} CACHED" in said for step in copied)
