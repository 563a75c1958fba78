"""Fan-out: on this machine with joblib, on a cluster with Ray; what fails is named, what is interrupted ends."""

from __future__ import annotations

import io
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from saccade.app.bench.bench import bench, prepare
from saccade.app.bench.workers import in_processes
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.tests.fakes.work import fails, square
from saccade.tests.test_bench import timeless

WORK = {f"scene {k}": (k,) for k in range(6)}
INTERRUPTED = """
import sys, time
from saccade.app.bench.workers import in_processes
from saccade.tests.fakes.work import slow
for scene, process in in_processes(slow, {str(k): (k,) for k in range(50)}, 2):
    print(process, flush=True)
"""


def dies(k: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def is_free(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) != 0


@pytest.fixture(scope="module")
def cluster():
    """A Ray of one node. Its server forks while threads of gRPC run, in which the handlers of gRPC may crash."""
    port = next(port for port in range(20_100, 21_000) if is_free(port))  # beyond those of Ray's workers
    ray = str(Path(sys.executable).with_name("ray"))
    started = subprocess.run([ray, "start", "--head", "--port", "0", "--ray-client-server-port", str(port),
                              "--num-cpus", "2", "--include-dashboard", "false", "--disable-usage-stats"],
                             env=os.environ | {"GRPC_ENABLE_FORK_SUPPORT": "0"}, capture_output=True, text=True)
    assert started.returncode == 0, started.stderr
    yield f"ray://127.0.0.1:{port}"
    subprocess.run([ray, "stop", "--force"], capture_output=True)


def test_all_work_is_done_by_one_thread_each():
    assert dict(in_processes(square, WORK, 2)) == {f"scene {k}": (k * k, "1") for k in range(6)}
    assert list(in_processes(square, {}, 2)) == []


def test_what_fails_names_its_scene():
    with pytest.raises(SaccadeError, match=r"^scene a: no 3$"):
        list(in_processes(fails, {"a": (3,)}, 1))


def test_a_process_that_dies_is_told():
    with pytest.raises(SaccadeError, match="one of the processes has died"):
        list(in_processes(dies, {"a": (3,), "b": (4,)}, 2))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_no_process_outlives_an_interruption(number):
    process = subprocess.Popen([sys.executable, "-c", INTERRUPTED], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                               text=True)
    workers = {int(process.stdout.readline()) for _ in range(4)}
    process.send_signal(number)
    process.wait(20)
    end_s = time.monotonic() + 20
    while any(Path(f"/proc/{worker}").exists() for worker in workers):
        assert time.monotonic() < end_s, "they work on"
        time.sleep(0.05)


def test_a_cluster_does_the_same(cluster):
    assert dict(in_processes(square, WORK, 1, cluster)) == {f"scene {k}": (k * k, "1") for k in range(6)}
    with pytest.raises(SaccadeError, match=r"^scene a: no 3$"):
        list(in_processes(fails, {"a": (3,)}, 1, cluster))


def test_a_benchmark_on_a_cluster_has_the_same_results(cluster, tmp_path):
    """With no jobs here: whatever is done, is done there."""
    def results(out, jobs, **where):
        plan = prepare("oracle", Config(), tmp_path / out, limit=3)
        return timeless(bench(plan, jobs=jobs, command="saccade bench", console=Console(file=io.StringIO()), **where))

    here, there = results("here.json", 1), results("there.json", 0, cluster=cluster)
    assert here == there
    assert len({record["scene"] for record in here}) == 3


def test_a_cluster_that_is_not_there_is_told(monkeypatch):
    monkeypatch.setattr("ray.util.client.worker.INITIAL_TIMEOUT_SEC", 1)
    monkeypatch.setattr("ray.util.client.worker.MAX_TIMEOUT_SEC", 1)
    with pytest.raises(SaccadeError, match=r"no Ray cluster answers at ray://127\.0\.0\.1:1"):
        list(in_processes(square, WORK, 1, "ray://127.0.0.1:1"))
