"""What stands around a service in a container: which worlds it serves, how it is seen to be well, what ends it."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from saccade.app.run.launch import resolve
from saccade.app.run.registry import agent_processes
from saccade.deploy.container import LATEST, OVER, Container, mine, worlds_of
from saccade.deploy.director import prepare
from saccade.shared.config import PACKAGE, Config
from saccade.shared.errors import SaccadeError

HEALTHY = PACKAGE / "deploy" / "healthy.sh"


def names(folders) -> list[str]:
    return [folder.name for folder in folders]


def test_a_run_of_one_world_is_prepared_where_every_service_looks(tmp_path):
    folder, = prepare(Config(seed=5), 1, tmp_path)
    assert worlds_of(tmp_path / LATEST) == [folder.resolve()]
    assert json.loads((folder / "config.json").read_text())["run"] == folder.name
    (folder / OVER).touch()
    assert worlds_of(tmp_path / LATEST) == []


def test_worlds_have_names_seeds_and_runs_of_their_own(tmp_path):
    folders = prepare(Config(seed=5), 3, tmp_path)
    told = [json.loads((folder / "config.json").read_text()) for folder in folders]
    assert [t["seed"] for t in told] == [5, 6, 7]
    assert [t["bus"]["world"] for t in told] == names(folders) == ["table-0", "table-1", "table-2"]
    assert len({t["run"] for t in told}) == 3
    (folders[0] / OVER).touch()
    assert names(worlds_of(tmp_path / LATEST)) == names(folders)  # the others go on


def test_a_container_serves_all_worlds_or_its_own(tmp_path, monkeypatch):
    folders = prepare(Config(), 2, tmp_path)
    assert mine("belief", folders) == folders
    assert mine("router", folders) == folders[:1]
    monkeypatch.setenv("SACCADE_WORLD", "1")
    assert mine("simulator", folders) == folders[1:]
    monkeypatch.setenv("SACCADE_WORLD", "2")
    with pytest.raises(SaccadeError, match="SACCADE_WORLD=2, but the run has 2 worlds"):
        mine("simulator", folders)


def test_a_folder_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "runs").write_text("a file")
    with pytest.raises(SaccadeError, match=rf"runs cannot be written by user {os.getuid()} \(.*SACCADE_UID"):
        prepare(Config(), 1, tmp_path / "runs")


def test_where_no_run_goes_on_it_ends_and_says_so(tmp_path):
    done = subprocess.run([sys.executable, "-m", "saccade.deploy.container", "belief"], capture_output=True, text=True,
                          cwd=PACKAGE, env={**os.environ, "SACCADE_RUNS": str(tmp_path)})
    assert (done.returncode, done.stderr) == (0, f"saccade: belief: no run goes on in {tmp_path}\n")


def test_a_service_that_cannot_run_says_so_once_and_stays_down_until_the_run_is_over(tmp_path):
    folder, = prepare(Config(bus={"endpoint": "tcp/127.0.0.1:9"}), 1, tmp_path)
    process = subprocess.Popen([sys.executable, "-m", "saccade.deploy.container", "evaluator"], text=True, cwd=PACKAGE,
                               stderr=subprocess.PIPE, env={**os.environ, "SACCADE_RUNS": str(tmp_path),
                                                            "SACCADE_HEARTBEATS": str(tmp_path / "beats")})
    line = process.stderr.readline()
    assert line.startswith("saccade: configuration key 'scene.names' is empty")
    time.sleep(1.0)  # until it has ended
    assert process.poll() is None
    (folder / OVER).touch()
    rest = process.communicate(timeout=30)[1]
    assert (process.returncode, rest) == (2, "")


def test_who_is_stopped_before_it_has_begun_is_not_waited_for_long(tmp_path, monkeypatch):
    """Such as one that waits for a router: its signal handler has no turn while Zenoh waits."""
    prepare(Config(), 1, tmp_path)
    monkeypatch.setenv("SACCADE_RUNS", str(tmp_path))
    monkeypatch.setenv("SACCADE_HEARTBEATS", str(tmp_path / "beats"))
    monkeypatch.setattr("saccade.deploy.container.STOP_S", math.inf)
    monkeypatch.setattr("saccade.deploy.container.STOP_UNBEGUN_S", 0.1)
    deaf = subprocess.Popen(["sh", "-c", "trap '' TERM; echo; while :; do sleep 0.1; done"], stdout=subprocess.PIPE)
    assert deaf.stdout.readline() == b"\n"
    container = Container("belief")
    monkeypatch.setattr(container, "_start", lambda world: deaf)
    container.stop()
    assert container.run() == 0
    assert deaf.returncode == -signal.SIGKILL


def test_a_service_that_the_agent_does_without_waits_for_the_end_of_the_run_and_is_well(tmp_path, monkeypatch, capfd):
    folder, = prepare(resolve(Config().with_values({"scene.objects": "pantry"}), agent_processes("lexa")), 1, tmp_path)
    monkeypatch.setenv("SACCADE_RUNS", str(tmp_path))
    monkeypatch.setenv("SACCADE_HEARTBEATS", str(tmp_path / "beats"))
    container = Container("belief")
    monkeypatch.setattr(container, "_start", lambda world: pytest.fail("it was started"))
    watching = threading.Timer(1.0, (folder / OVER).touch)
    watching.start()
    assert container.run() == 0
    watching.join()
    assert "belief has no part in this run" in capfd.readouterr().err
    assert list((tmp_path / "beats").iterdir())


@pytest.mark.parametrize(("files", "well"), [
    ({}, False), ({"a": ("ready", 0)}, True), ({"a": ("ready", 0), "b": ("busy", 1)}, True),
    ({"a": ("starting", 0)}, False), ({"a": ("ready", 0), "b": ("ready", 10)}, False), ({"a": ("failed", 0)}, False)])
def test_healthy_is_who_beats(tmp_path, files, well):
    for name, (state, age_s) in files.items():
        (tmp_path / name).write_text(state)
        os.utime(tmp_path / name, (time.time() - age_s,) * 2)
    done = subprocess.run(["sh", HEALTHY], env={**os.environ, "SACCADE_HEARTBEATS": str(tmp_path)})
    assert (done.returncode == 0) == well
