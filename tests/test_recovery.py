"""Whatever process is killed at whatever moment: the run goes on, and its log is that of an undisturbed run."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import pytest

from saccade.app.log.check import missing
from saccade.app.run.launch import PROCESSES, ROUTER, launch
from saccade.app.run.registry import local_pairs
from saccade.app.run.supervisor import Supervisor
from saccade.shared.bus.topics import FRAME, STATUS
from saccade.shared.bus.wire import stamp_of
from saccade.shared.config import Config
from saccade.shared.log.reading import RunReader
from saccade.shared.loop.local import run_local
from saccade.tests.fakes.launch import FAKES, PARTS, configuration, processes_of
from saccade.tests.fakes.services import pairs

EPISODES, STEPS = 3, 12
NAMES = [process.name for process in PROCESSES]


def disturbed(run_dir: Path, at: dict[tuple[int, int], Callable[[], None]]) -> tuple[list, list[str]]:
    """Results and notices of a run in which something happens when the frame of (episode, step) is seen."""
    said = []

    def on_message(topic, part, message):
        if topic == FRAME and (message.episode, message.step) in at:
            at[message.episode, message.step]()

    results = launch(configuration(EPISODES, STEPS), run_dir, on_message, FAKES, said.append)
    return results, said


def logged(path: Path) -> dict:
    """By number: what was lost stands in the file where its publisher was asked for it."""
    keys = defaultdict(list)
    for topic, part, payload, _ in sorted(RunReader(path).entries(), key=lambda entry: stamp_of(entry.payload)):
        if topic != STATUS:
            keys[topic.name, part].append(payload)
    return dict(keys)


def undisturbed(run: str) -> dict:
    keys = defaultdict(list)
    run_local(pairs(configuration(EPISODES, STEPS)), PARTS, run, None,
              lambda t, p, m, payload: keys[t.name, p].append(payload), encoded=True)
    return dict(keys)


def assert_as_if_nothing_had_happened(run_dir: Path, results: list) -> None:
    assert [r.episode for r in results] == list(range(EPISODES))
    report = missing(run_dir / "run.mcap")
    assert report.complete, report
    assert logged(run_dir / "run.mcap") == undisturbed(run_dir.name)


@pytest.mark.parametrize("name", NAMES)
def test_a_service_killed_at_any_moment_goes_on_where_it_was(tmp_path, name):
    """Three random moments, one of them maybe between two episodes; what is said names the service each time."""
    rng, run_dir = random.Random(f"moments of {name}"), tmp_path / "run"
    moments = [(episode, rng.randrange(STEPS)) for episode in range(EPISODES)]

    def kill() -> None:
        time.sleep(rng.random() * 0.02)
        if (process := processes_of(run_dir).get(name)) is not None:
            os.kill(process, signal.SIGKILL)

    results, said = disturbed(run_dir, dict.fromkeys(moments, kill))
    assert_as_if_nothing_had_happened(run_dir, results)
    assert [text for text in said if text.startswith(f"{name} is started again: ")]


def test_a_router_killed_before_anyone_is_on_the_bus_is_started_again(tmp_path, monkeypatch):
    start, killed = Supervisor.start, []

    def start_and_kill(self, process):
        start(self, process)
        if process == ROUTER and not killed:
            killed.append(process)
            while not (pids := processes_of(tmp_path / "run")):
                time.sleep(0.001)
            os.kill(pids["router"], signal.SIGKILL)

    monkeypatch.setattr(Supervisor, "start", start_and_kill)
    results, said = disturbed(tmp_path / "run", {})
    assert killed
    assert any("router" in text for text in said)
    assert_as_if_nothing_had_happened(tmp_path / "run", results)


def test_a_service_that_hangs_is_named_and_goes_on_when_it_is_let(tmp_path, monkeypatch):
    monkeypatch.setattr("saccade.app.run.supervisor.HUNG_KILLED_S", 1e9)
    run_dir, said = tmp_path / "run", []
    stopped = []

    def say(text: str) -> None:
        said.append(text)
        if text.startswith("belief hangs: nothing was heard of it for "):
            os.kill(stopped[0], signal.SIGCONT)

    def stop(topic, part, message):
        if topic == FRAME and not stopped:
            stopped.append(processes_of(run_dir)["belief"])
            os.kill(stopped[0], signal.SIGSTOP)

    results = launch(configuration(EPISODES, STEPS), run_dir, stop, FAKES, say)
    assert_as_if_nothing_had_happened(run_dir, results)
    assert [text.split(":")[0] for text in said] == ["belief hangs", "belief is heard again"]


def test_a_service_that_hangs_for_long_is_ended_and_started_again(tmp_path, monkeypatch):
    monkeypatch.setattr("saccade.app.run.supervisor.HUNG_KILLED_S", 3.0)
    run_dir = tmp_path / "run"
    results, said = disturbed(
        run_dir, {(0, 0): lambda: os.kill(processes_of(run_dir)["perception"], signal.SIGSTOP)})
    assert_as_if_nothing_had_happened(run_dir, results)
    assert [text.split(":")[0] for text in said][:3] == [
        "perception hangs", "perception is ended", "perception is started again"]


def test_a_launcher_that_was_suspended_blames_nobody(tmp_path):
    run_dir = tmp_path / "run"
    launcher = subprocess.Popen([sys.executable, "-m", "saccade.tests.fakes.launch", str(run_dir), "1", "1000"],
                                stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        while "recorder" not in processes_of(run_dir):
            time.sleep(0.05)
        time.sleep(1.5)
        os.kill(launcher.pid, signal.SIGSTOP)
        time.sleep(4.0)  # twice what makes a silent service a hung one
        os.kill(launcher.pid, signal.SIGCONT)
        told, _ = launcher.communicate(timeout=300)
    finally:
        launcher.kill()
    assert told == "1\n"


def test_the_shipped_agent_ends_where_it_would_have_ended(tmp_path):
    """The real services: networks, particles and plans come back to the same bytes."""
    config = Config().with_values({"scene.names": ["soup_can", "rice_box"], "scene.count": 1, "seed": 11,
                                   "simulator.max_steps": 9})
    run_dir, moments = tmp_path / "run", {2: "perception", 4: "belief", 6: "planner", 7: "simulator"}

    def kill(topic, part, message):
        if topic == FRAME and (name := moments.pop(message.step, None)):
            os.kill(processes_of(run_dir)[name], signal.SIGKILL)

    launch(config, run_dir, kill, say=lambda text: None)
    assert not moments
    assert missing(run_dir / "run.mcap").complete
    expected = defaultdict(list)
    run_local(local_pairs("sceneccn", config), config.names, "run", None,
              lambda t, p, m, payload: expected[t.name, p].append(payload), encoded=True)
    assert logged(run_dir / "run.mcap") == dict(expected)
