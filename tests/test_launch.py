"""A run as real processes: the log equals the in-process run to the byte, and whatever ends a run leaves no process."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections import defaultdict
from contextlib import closing, nullcontext

import pytest

from saccade.app.log.check import missing
from saccade.app.run.launch import PROCESSES, launch, launched
from saccade.app.run.supervisor import Process, Supervisor
from saccade.shared.bus.messages import Status
from saccade.shared.bus.topics import FRAME, GOAL, RESULT, STATUS
from saccade.shared.bus.transport import ZenohBus, free_endpoint
from saccade.shared.bus.wire import encode
from saccade.shared.config import load
from saccade.shared.errors import SaccadeError
from saccade.shared.log.reading import RunReader, is_whole
from saccade.shared.loop.local import run_local
from saccade.tests.fakes.launch import FAKES, PARTS, configuration, processes_of
from saccade.tests.fakes.logs import so_far
from saccade.tests.fakes.services import pairs
from saccade.tests.samples import sample

WAIT_S = 60


def until(condition) -> bool:
    """Waits for what must come to pass; nothing is asserted about how long it takes."""
    end = time.monotonic() + WAIT_S
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("launch") / "run"
    seen = []
    results = launch(configuration(3, 8), run_dir, lambda *item: seen.append(item), FAKES)
    return run_dir, results, seen


def test_the_log_equals_the_run_in_one_process(run):
    run_dir, results, _ = run
    expected, logged = defaultdict(list), defaultdict(list)
    run_local(pairs(load(run_dir / "config.json")), PARTS, run_dir.name, None,
              lambda t, p, m, payload: expected[t.name, p].append(payload), encoded=True)
    for entry in RunReader(run_dir / "run.mcap").entries():
        if entry.topic != STATUS:
            logged[entry.topic.name, entry.part].append(entry.payload)
    assert logged == expected
    assert [(r.episode, r.steps) for r in results] == [(0, 8), (1, 8), (2, 8)]


def test_the_log_is_whole_and_says_where_it_comes_from(run):
    run_dir, _, _ = run
    report = missing(run_dir / "run.mcap")
    assert report.complete, report
    reader = RunReader(run_dir / "run.mcap")
    services = {p for t, p, _ in reader if t == STATUS}
    assert services == {process.name for process in PROCESSES}
    assert reader.metadata["run"]["seed"] == "5"
    assert re.fullmatch("[0-9a-f]{64}", reader.metadata["run"]["configuration_sha256"])
    assert reader.configuration.strip() == (run_dir / "config.json").read_text().strip()


def test_the_caller_sees_every_message(run):
    run_dir, _, seen = run
    frames = [m for t, _, m in seen if t == FRAME]
    assert [(m.episode, m.step) for m in frames] == [(e, s) for e in range(3) for s in range(8)]
    assert sum(t == RESULT for t, _, _ in seen) == 3
    last = {p: m for t, p, m in seen if t == STATUS and isinstance(m, Status)}
    assert {name: s.state for name, s in last.items()} == {process.name: "stopped" for process in PROCESSES}
    assert all((s.refused, s.gaps, s.skipped) == (0, 0, 0) for s in last.values())
    assert processes_of(run_dir) == {}


@pytest.mark.parametrize(("wish", "message"), [
    ("planner breaks", "planner: the fake planner has had enough: give it a break"),
    ("planner dies", "planner: it said nothing .*SIGKILL.*; it has died 6 times"),
    ("belief breaks at start", "belief: weights are missing: fetch them")])
def test_a_service_that_ends_is_named_with_its_reason(tmp_path, wish, message):
    with pytest.raises(SaccadeError, match=message):
        launch(configuration(3, 8, wish), tmp_path / "run", None, FAKES)
    assert processes_of(tmp_path / "run") == {}
    assert not missing(tmp_path / "run" / "run.mcap").cut


@pytest.mark.parametrize(("module", "reason"), [("saccade.tests.fakes.nothing", "it has died 6 times"),
                                                ("saccade.services.viewer", "cannot be opened")])
def test_a_run_goes_on_without_one_who_only_looks_on(tmp_path, module, reason):
    """Who dies again and again, or cannot have its port, says why; nothing else happens."""
    said, looking = [], Process("viewer", module, onlooker=True)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        config = configuration(2, 100).with_values({"viewer.port": taken.getsockname()[1]})
        results = launch(config, tmp_path / "run", None, (*FAKES, looking), said.append)
    assert [result.episode for result in results] == [0, 1]
    assert any(text.startswith("the run goes on without the viewer: ") and reason in text for text in said), said
    assert missing(tmp_path / "run" / "run.mcap").complete


def test_one_who_looks_on_stays_when_the_others_are_stopped(tmp_path):
    looking = Process("replayer", "saccade.tests.fakes.onlooker", onlooker=True)
    with launched(configuration(1, 3), tmp_path / "run", None, (*FAKES, looking)) as ended:
        assert len(ended.results) == 1
        assert ended.runs("replayer")
        assert set(processes_of(tmp_path / "run")) == {"onlooker"}
    assert processes_of(tmp_path / "run") == {}


def test_a_port_in_use_starts_no_service(tmp_path):
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    other = ZenohBus(endpoint, world="test", listen=True)
    try:
        with pytest.raises(SaccadeError, match="in use"):
            launch(configuration(1, 1).with_values({"bus.endpoint": endpoint}), tmp_path, None, FAKES)
    finally:
        other.close()
    assert processes_of(tmp_path) == {}


def test_a_log_is_never_written_over(tmp_path, run):
    run_dir, _, _ = run
    before = (run_dir / "run.mcap").read_bytes()
    with pytest.raises(SaccadeError, match="already holds a log"):
        launch(configuration(1, 1), run_dir, None, FAKES)
    assert (run_dir / "run.mcap").read_bytes() == before
    (tmp_path / "file").write_text("")
    with pytest.raises(SaccadeError, match="cannot be made"):
        launch(configuration(1, 1), tmp_path / "file" / "run", None, FAKES)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL], ids=lambda s: s.name)
def test_an_interrupted_launcher_leaves_no_process_and_a_readable_log(tmp_path, number):
    run_dir = tmp_path / "run"
    launcher = subprocess.Popen([sys.executable, "-m", "saccade.tests.fakes.launch", str(run_dir), "1", "1000000"],
                                stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    try:
        log = run_dir / "run.mcap"
        assert until(lambda: any(t == FRAME for t, _, _ in so_far(log)))
        assert len(processes_of(run_dir)) == len(PROCESSES)
        os.kill(launcher.pid, number)
        launcher.wait(WAIT_S)
        assert until(lambda: processes_of(run_dir) == {})
        report = missing(log)
        assert report.cut is None
        assert report.lost == {}
        assert report.messages > 0
        assert report.unfinished.startswith("the run was not finished: it was ended in episode 0")
    finally:
        launcher.kill()
        launcher.stdout.close()
        for left in processes_of(run_dir).values():
            os.kill(left, signal.SIGKILL)


def test_a_run_that_cannot_go_on_says_why_and_ends(tmp_path, monkeypatch):
    """Every service is alive, and each waits for another one."""
    monkeypatch.setattr("saccade.app.run.halt.HALTED_S", 2.5)
    with pytest.raises(SaccadeError, match=r"came to a halt: .*simulator waits for action of step 0 of episode 1"):
        launch(configuration(3, 8, "planner is silent"), tmp_path / "run", None, FAKES)
    assert processes_of(tmp_path / "run") == {}
    assert not missing(tmp_path / "run" / "run.mcap").cut


@pytest.mark.parametrize("forged", ["another run", "an episode to come", "a result of another run"])
def test_whoever_is_not_of_this_run_is_named_and_never_stops_it_silently(tmp_path, monkeypatch, forged):
    """A message of another run changes nothing; one that looks like this run's next episode may hold it up, and then
    the run says so."""
    monkeypatch.setattr("saccade.app.run.halt.HALTED_S", 2.5)
    said: list[str] = []
    config = configuration(3, 400).with_values({"bus.endpoint": free_endpoint("tcp/127.0.0.1:0")})
    run, episode = ("run", 1) if forged == "an episode to come" else ("zz", 7)
    forger = Forger(config.bus.endpoint)

    def see(topic, part, message):
        if topic == FRAME and (message.episode, message.step) == (0, 5):
            forger.say(RESULT if "result" in forged else GOAL, run, episode)
            forger.say(FRAME, run, episode)

    with closing(forger), pytest.raises(SaccadeError) if run == "run" else nullcontext() as caught:
        results = launch(config, tmp_path / "run", see, FAKES, said.append)
    if run == "run":
        assert str(caught.value).startswith("the run came to a halt: ")
    else:
        assert [result.episode for result in results] == [0, 1, 2]
        assert any("of another run, 'zz', came on the bus" in text for text in said), said


class Forger:
    """Someone on the bus who says what others should."""

    def __init__(self, endpoint: str) -> None:
        self.endpoint, self.bus = endpoint, None

    def say(self, topic, run: str, episode: int) -> None:
        self.bus = self.bus or ZenohBus(self.endpoint, world="table")
        message = sample(topic.type, run=run, episode=episode, step=0, seq=0)
        self.bus.publish(topic, None, encode(message))

    def close(self) -> None:
        if self.bus is not None:
            self.bus.close()


def test_a_recorder_that_is_killed_at_the_very_end_is_told_and_its_log_gets_an_index(tmp_path, monkeypatch):
    stop = Supervisor.stop

    def killing(self, *, onlookers=True):
        child = self._children.get("recorder")
        if child is not None and child.poll() is None:
            child.kill()
            child.wait()
        stop(self, onlookers=onlookers)

    monkeypatch.setattr(Supervisor, "stop", killing)
    with launched(configuration(2, 8), tmp_path / "run", None, FAKES) as ended:
        assert len(ended.results) == 2
        assert any("the recorder was killed before it had closed" in text for text in ended.lacks)
    assert is_whole(tmp_path / "run" / "run.mcap")
