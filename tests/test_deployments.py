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
from saccade.shared.config import PACKAGE, set_folder

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
