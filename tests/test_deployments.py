"""compose.yaml, Kubernetes and the local launcher start the same processes."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import kubernetes_validate
import pytest
import yaml

from saccade.app.run.registry import agent_processes
from saccade.app.run.supervisor import GUIDE, ROS
from saccade.deploy.director import main as direct
from saccade.shared.config import PACKAGE, Config, set_folder

PROCESSES = {process.name: process.module for process in agent_processes("sceneccn", view=True)}
BESIDE = {"director"}  # in the launcher's place
KUBERNETES = PACKAGE / "deploy" / "kubernetes"
VERSION = "1.31"
UNITS = {"m": 2 ** 20, "g": 2 ** 30, "Mi": 2 ** 20, "Gi": 2 ** 30}


def bytes_of(size: str) -> int:
    number = size.rstrip("MGimg")
    return int(number) * UNITS[size.removeprefix(number)]


@pytest.fixture(scope="module")
def compose() -> dict:
    """With the defaults of the variables that name images."""
    text = re.sub(r"\$\{SACCADE_\w+_IMAGE:-(\w+)\}", r"\1", (PACKAGE / "compose.yaml").read_text())
    return yaml.safe_load(text)["services"]


@pytest.fixture(scope="module")
def kubernetes() -> list[dict]:
    """Rendered, where kubectl is installed; else as they are written."""
    if shutil.which("kubectl"):
        text = subprocess.run(["kubectl", "kustomize", KUBERNETES], capture_output=True, text=True, check=True).stdout
        return list(yaml.safe_load_all(text))
    names = yaml.safe_load((KUBERNETES / "kustomization.yaml").read_text())["resources"]
    return [tree for name in names for tree in yaml.safe_load_all((KUBERNETES / name).read_text())]


def containers(kubernetes: list[dict]) -> dict[str, dict]:
    return {container["name"]: container for tree in kubernetes if "template" in tree.get("spec", {})
            for container in tree["spec"]["template"]["spec"]["containers"]}


def test_all_start_the_same_processes(compose, kubernetes):
    in_kubernetes = containers(kubernetes)
    in_compose = {name: service for name, service in compose.items()
                  if service.get("profiles", ["simulator"]) == ["simulator"] and service["build"]["target"] == name}
    assert set(in_compose) - BESIDE == set(PROCESSES) == set(in_kubernetes) - BESIDE
    for name in (*PROCESSES, *BESIDE):
        assert in_compose[name]["image"] == in_kubernetes[name]["image"].removesuffix(":latest") == f"saccade/{name}"
        assert bytes_of(in_compose[name]["mem_limit"]) == bytes_of(in_kubernetes[name]["resources"]["limits"]["memory"])


def test_the_pages_and_bridges_that_are_asked_for_have_an_image_too(compose):
    """They are profiles of Compose: `docker compose up` alone starts none of them."""
    dockerfile = (PACKAGE / "deploy" / "Dockerfile").read_text()
    stages = {stage.split()[2]: stage for stage in dockerfile.split("\nFROM ")[1:]}
    for process in (GUIDE, ROS):
        name = process.name
        assert (compose[name]["profiles"], compose[name]["image"]) == ([name], f"saccade/{name}")
        assert compose[name]["build"]["target"] == name
        assert f'CMD ["{name}"]' in stages[name]
        assert f"COPY services/{name} services/{name}" in stages[name]
    port, = compose["guide"]["ports"]
    assert port == "127.0.0.1:${SACCADE_GUIDE_PORT:-9092}:${SACCADE_GUIDE_PORT:-9092}"


def told_by_compose(compose, monkeypatch, **variables) -> Config:
    """The configuration of a run that Compose starts with these variables."""
    given = {name: str(value) for name, value in variables.items()}

    def filled(text: str) -> str:
        for _ in range(2):  # one variable may stand in another's
            text = re.sub(r"\$\{(\w+):\+([^{}]*)\}", lambda m: m[2] if given.get(m[1]) else "", text)
            text = re.sub(r"\$\{(\w+):-([^{}]*)\}", lambda m: given.get(m[1]) or m[2], text)
        return text

    directed = []
    monkeypatch.setattr("saccade.deploy.director.direct", lambda config, agent, world, *_: directed.append(
        (config, world)))
    direct([filled(argument) for argument in compose["director"]["command"]])
    (config, world), = directed
    assert world == ("camera" if "camera" in given.get("COMPOSE_PROFILES", "") else "simulator")
    return config


def test_a_webcam_a_board_and_a_goal_are_wired_through_to_the_run(compose, monkeypatch, capsys):
    config = told_by_compose(compose, monkeypatch, COMPOSE_PROFILES="camera,guide", SACCADE_WEBCAM="/dev/video2",
                             SACCADE_BOARD="my_board.json", SACCADE_CALIBRATION="my.toml", SACCADE_GOAL="photo.jpg",
                             SACCADE_GUIDE_PORT=9099)
    camera, mounted = config.camera, {volume["target"] for volume in compose["camera"]["volumes"]
                                      if isinstance(volume, dict)}
    assert (camera.source, config.planner.moved_by, config.scene.explore) == ("webcam:0", "hand", False)
    assert {str(camera.board), camera.calibration, str(config.scene.goal_image)} <= mounted
    assert compose["camera"]["devices"] == ["${SACCADE_WEBCAM:-/dev/null}:/dev/video0"]
    assert config.viewer.guide_port == 9099
    assert "where to go next: http://localhost:9099" in capsys.readouterr().out
    assert not config.ros.publish


def test_nodes_of_ros_are_wired_through_to_the_run(compose, monkeypatch):
    config = told_by_compose(compose, monkeypatch, COMPOSE_PROFILES="camera,ros", SACCADE_ROS_TOPIC="/camera/image")
    assert (config.camera.source, config.ros.publish, config.scene.explore) == ("ros:/camera/image", True, True)
    for name in ("camera", "ros"):
        assert compose[name]["extra_hosts"] == ["host.docker.internal:host-gateway"]
    assert config.ros.router == "tcp/host.docker.internal:7447"
    plain = told_by_compose(compose, monkeypatch)
    assert (plain.camera, plain.ros, plain.scene.goal_image) == (Config().camera, Config().ros, None)


def test_whoever_reads_objects_or_what_is_learnt_of_them_has_the_users_own_sets(compose):
    readers = {"director", "simulator", "perception", "belief", "planner", "evaluator", "recorder", "viewer", "replay"}
    for name in readers:
        sets, = (volume for volume in compose[name]["volumes"]
                 if isinstance(volume, dict) and volume["target"] == "/sets")
        assert compose[name]["environment"]["SACCADE_OBJECTS"] == "/sets"
        assert sets["read_only"]
        assert sets["source"] == "${SACCADE_SETS:-${XDG_DATA_HOME:-${HOME:-.}/.local/share}/saccade/objects}"
    assert "--objects=${SACCADE_OBJECTS:-pantry}" in compose["director"]["command"]


def test_the_folder_of_sets_in_a_container_is_where_a_run_finds_them(tmp_path, monkeypatch):
    monkeypatch.setenv("SACCADE_OBJECTS", "/sets")  # as compose.yaml sets it
    assert set_folder("my") == Path("/sets/my")
    monkeypatch.delenv("SACCADE_OBJECTS")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert set_folder("my") == tmp_path / "saccade" / "objects" / "my"  # which compose.yaml mounts there


def test_each_has_an_image_whose_container_starts_its_module(kubernetes):
    dockerfile = (PACKAGE / "deploy" / "Dockerfile").read_text()
    stages = {stage.split()[2]: stage for stage in dockerfile.split("\nFROM ")[1:]}
    for name, module in PROCESSES.items():
        assert module == f"saccade.services.{name}"  # as deploy/container.py starts it
        assert f'CMD ["{name}"]' in stages[name]
        assert f"COPY services/{name} services/{name}" in stages[name]
        assert containers(kubernetes)[name]["args"] == [name]


def test_kubernetes_manifests_are_valid(kubernetes):
    for tree in kubernetes:
        kubernetes_validate.validate(tree, VERSION, strict=True)


def test_no_pod_is_root_and_no_container_may_write_its_image(kubernetes):
    if not shutil.which("kubectl"):
        pytest.skip("kubectl is not installed: the patches of deploy/kubernetes are not applied here")
    for tree in kubernetes:
        if "template" in tree.get("spec", {}):
            spec = tree["spec"]["template"]["spec"]
            assert spec["securityContext"]["runAsNonRoot"]
            for container in spec["containers"]:
                assert container["securityContext"]["readOnlyRootFilesystem"]
                assert container["securityContext"]["capabilities"] == {"drop": ["ALL"]}
                assert container["readinessProbe"]["exec"]["command"] == ["sh", "deploy/healthy.sh"]


def test_every_world_of_the_stateful_set_is_prepared(kubernetes):
    worlds = next(tree for tree in kubernetes if tree["kind"] == "StatefulSet")["spec"]["replicas"]
    literals = yaml.safe_load((KUBERNETES / "kustomization.yaml").read_text())["configMapGenerator"][0]["literals"]
    assert f"SACCADE_WORLDS={worlds}" in literals
