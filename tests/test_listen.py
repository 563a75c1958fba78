"""`echo`, `hz` and `topics`: messages of a bus or a log as text, as rates, by key; who listens slowly harms nobody."""

from __future__ import annotations

import io
import math
import os
import signal
import threading
import time
from contextlib import closing

import numpy as np
import pytest
from rich.console import Console

from saccade.app.log.traffic import Keys
from saccade.app.look.echo import block, of_array, show
from saccade.app.look.hz import Rates, follow
from saccade.app.look.listen import Heard, Live, Logged, Wanted, live, newest_run, on_bus
from saccade.app.look.topics import survey
from saccade.shared.bus.outbox import Outbox
from saccade.shared.bus.topics import ACTION, FRAME, GOAL, GOAL_PERCEPT, PERCEPT, TOPICS, TRUTH
from saccade.shared.bus.transport import ZenohBus, free_endpoint
from saccade.shared.bus.wire import encode
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.tests.fakes.logs import story, write
from saccade.tests.front_door import call, rows
from saccade.tests.samples import sample

WAIT_S = 30


@pytest.fixture
def bus():
    with closing(ZenohBus(free_endpoint("tcp/127.0.0.1:0"), world="table", listen=True)) as router:
        yield router


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write(tmp_path_factory.mktemp("run") / "run.mcap", list(story()))


class Publishing:
    """Publishes one message again and again on a thread, so that a listener need not be awaited."""

    def __init__(self, bus, *items) -> None:
        self._bus, self._items, self._end = bus, items, threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        while not self._end.wait(0.005):
            for item in self._items:
                self._bus.publish(*item)

    def __enter__(self):
        self._thread.start()

    def __exit__(self, *_):
        self._end.set()
        self._thread.join(WAIT_S)


def press_ctrl_c():
    """Once it is handled differently from now; returns how it is handled now."""
    before = signal.getsignal(signal.SIGINT)

    def press() -> None:
        while signal.getsignal(signal.SIGINT) is before:
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=press, daemon=True).start()
    return before


@pytest.mark.parametrize(("key", "meant"), [
    ("frame", {"frame"}), ("percept", {"percept/mug", "percept/can"}), ("percept/m*", {"percept/mug"}),
    ("saccade/table/percept/mug", {"percept/mug"}), ("*percept/can", {"percept/can", "goal_percept/can"}),
    ("saccade/*/frame", {"frame"}), ("saccade/table/**", None), ("*", None)])
def test_keys_and_what_they_mean(key, meant):
    wanted = Wanted.parse(key)
    there = [(t, p) for t in TOPICS.values() for p in (("mug", "can") if t.parts else (None,))]
    found = {"/".join(filter(None, (t.name, p))) for t, p in there if wanted.matches(t, p)}
    assert found == (meant or {"/".join(filter(None, (t.name, p))) for t, p in there})


@pytest.mark.parametrize("key", ["", "nothing", "frame/mug", "saccade/table", "saccade/table/nothing",
                                 "saccade/t b/frame", "saccade/#/frame", "saccade/ta*/frame"])
def test_keys_that_cannot_be_are_refused(key):
    with pytest.raises(SaccadeError, match="is none of Saccade's"):
        Wanted.parse(key)


@pytest.mark.parametrize("topic", TOPICS.values(), ids=lambda t: t.name)
def test_every_message_is_told_field_by_field(topic):
    message = sample(topic.type)
    lines = list(block(Heard(topic, "mug" if topic.parts else None, encode(message), 10**18), "table"))
    assert lines[0].startswith(topic.key("table", "mug") + "  01:46:40.000 UTC, ")
    assert len(lines) == len(vars(message)) - 3
    assert all("\n" not in line for line in lines)


def test_values_as_text():
    assert of_array(np.array([1.5, -0.0])) == "f8 [2] [1.5, 0]"
    assert of_array(np.eye(2, dtype=np.float32)) == "f4 [2, 2] [[1, 0], [0, 1]]"
    assert of_array(np.full((5, 5), 2, np.uint8)) == "u1 [5, 5], min 2, mean 2, max 2"
    assert of_array(np.zeros((0, 3))) == "f8 [0, 3], empty"
    evil = encode(sample(TRUTH.type, scene="a\x1b[2Jb"))
    assert "\x1b" not in "\n".join(block(Heard(TRUTH, None, evil, 0), "table"))
    assert "\n  malformed: not msgpack" in "".join(block(Heard(ACTION, None, b"\xc1", 0), "table"))


def test_echo_of_a_log(monkeypatch, capsys, log):
    code, out, _ = call(monkeypatch, capsys, "echo", "percept/mug", "--log", log, "--count", 2)
    assert code == 0
    assert out.count("saccade/table/percept/mug  ") == 2
    assert "  object: mug\n" in out
    assert call(monkeypatch, capsys, "echo", "percept", "--log", log.parent)[1].count("saccade/table/percept/") == 12


def test_hz_of_a_log(monkeypatch, capsys, log):
    code, out, _ = call(monkeypatch, capsys, "hz", "*", "--log", log)
    assert code == 0
    assert "saccade/table/frame: 6 messages, " in out
    assert call(monkeypatch, capsys, "hz", "frame", "--log", log)[1].count("\n") == 1
    few = call(monkeypatch, capsys, "hz", "frame", "--log", log, "--count", 1)[1]
    assert few == "saccade/table/frame: 1 message, too few for a rate\n"


def test_rates_within_a_window():
    rates = Rates(window_s=10.0)
    for i in range(21):
        rates.take(FRAME, None, 100, i * 0.5)
    rates.take(ACTION, None, 7, 0.0)
    assert rates.rows("table", 10.0) == [("saccade/table/action", "1", *"----"),
                                         ("saccade/table/frame", "21", "2.00", "500.0", "0.0", "200")]
    assert rates.rows("table", 100.0)[1] == ("saccade/table/frame", "21", *"----")
    uneven = Rates()
    for at_s in (0.0, 1.0, 4.0):
        uneven.take(FRAME, None, 100, at_s)
    assert uneven.rows("table") == [("saccade/table/frame", "3", "0.50", "2000.0", "1000.0", "50")]
    assert uneven._rates[FRAME, None].values()[3] == pytest.approx(1.0)
    assert not math.isnan(uneven._rates[FRAME, None].values()[4])


def test_gaps_of_what_came_live():
    """It listens from somewhere on: what came before is not missing."""
    keys, console = Keys(), Console(file=io.StringIO(), width=120)
    for seq in (3, 7, 4):  # the last out of its turn
        keys.take(FRAME, None, 10, seq * 10**9, sample(FRAME.type, episode=1, step=seq, seq=seq))
    console.print(keys.table("table"))
    assert rows(console.file.getvalue()) == {"saccade/table/frame": ["Frame", "3", "30", "0.50", "1:3 to 1:7", "2"]}


def test_echo_live_with_what_is_malformed(monkeypatch, capsys, bus):
    with Publishing(bus, (PERCEPT, "mug", encode(sample(PERCEPT.type))), (ACTION, None, b"junk")):
        code, out, err = call(monkeypatch, capsys, "echo", "*", "--endpoint", bus.endpoint, "--count", 60)
    assert (code, err) == (0, "")
    assert out.count("saccade/table/") == 60  # some come before all is subscribed to
    assert "saccade/table/action" in out
    assert "malformed: not a map of at most 64 fields" in out
    assert "  presence: 0.5\n" in out


def test_hz_live_ends_by_count_and_by_ctrl_c(monkeypatch, capsys, bus):
    item = (PERCEPT, "mug", encode(sample(PERCEPT.type)))
    with Publishing(bus, item):
        code, out, _ = call(monkeypatch, capsys, "hz", "percept/*", "--endpoint", bus.endpoint, "--count", 3)
        assert code == 0
        assert "saccade/table/percept/mug: " in out.splitlines()[-1]
        with closing(Live(Wanted.parse("percept"), bus.endpoint, "table")) as source:
            before = press_ctrl_c()
            console = Console(file=io.StringIO(), force_terminal=True, width=120)
            follow(source, None, console)
            assert signal.getsignal(signal.SIGINT) is before
    assert "saccade/table/" in console.file.getvalue() or "no messages" in console.file.getvalue()


def test_ctrl_c_ends_echo(bus):
    lines = []
    with closing(Live(Wanted.parse("frame"), bus.endpoint, "table")) as source:
        press_ctrl_c()
        assert show(source, None, lines.append) == 0
    assert lines == []


def test_what_holds_for_the_episode_is_asked_for(bus):
    """The goal was published before anybody listened."""
    outbox, goal = Outbox(), sample(GOAL.type, run="r", episode=0, step=0)
    bus.answer([GOAL, GOAL_PERCEPT], outbox.answer)
    outbox.keep(GOAL, None, goal, encode(goal))
    lines = []
    with closing(Live(Wanted.parse("goal"), bus.endpoint, "table")) as source:
        assert show(source, 1, lines.append) == 1
    assert lines[0].startswith("saccade/table/goal  ")


def test_topics_live(monkeypatch, capsys, bus):
    """Also what was published before, and what is malformed."""
    outbox, goal = Outbox(), sample(GOAL.type, run="r", episode=2, step=0)
    bus.answer([GOAL], outbox.answer)
    outbox.keep(GOAL, None, goal, encode(goal))
    percept = encode(sample(PERCEPT.type, episode=2, step=7))
    with Publishing(bus, (PERCEPT, "mug", percept), (ACTION, None, b"junk")):
        code, out, err = call(monkeypatch, capsys, "topics", "--endpoint", bus.endpoint, "--seconds", 1)
    assert (code, err) == (0, "")
    found = rows(out)
    assert list(found) == [f"saccade/table/{name}" for name in ("action", "goal", "percept/mug")]
    assert found["saccade/table/goal"] == ["Goal", "1", f"{len(encode(goal)):,}", "", "2:0", "0"]
    name, count, size, _, steps, gaps = found["saccade/table/percept/mug"]
    assert (name, steps, gaps) == ("Percept", "2:7", "0")
    assert int(size.replace(",", "")) == int(count.replace(",", "")) * len(percept)
    assert found["saccade/table/action"][0::4] == ["Action", ""]


def test_topics_of_the_run_that_goes_on_where_nobody_speaks(monkeypatch, capsys, bus, tmp_path):
    Config().with_values({"bus.endpoint": bus.endpoint, "bus.world": "kitchen"}).save(tmp_path / "config.json")
    with Publishing(bus, (ACTION, None, encode(sample(ACTION.type)))):
        code, out, err = call(monkeypatch, capsys, "topics", "--live", "--run", tmp_path, "--seconds", 1)
        assert (code, err) == (0, "")
        assert out.startswith("nothing was heard in world 'kitchen': ")
        out = call(monkeypatch, capsys, "topics", "--run", tmp_path, "--world", "table", "--seconds", 1)[1]
    assert list(rows(out)) == ["saccade/table/action"]


def test_ctrl_c_ends_topics_with_what_was_heard(bus):
    with closing(Live(Wanted.parse("*"), bus.endpoint, "table")) as source:
        press_ctrl_c()
        assert survey(source, WAIT_S).found == {}
        assert source.inbox.stopping.is_set()


def test_a_slow_reader_drops_and_says_so_and_nobody_waits(bus):
    """The reader takes nothing until all is published: publishing must have come to its end."""
    payload, lines = encode(sample(ACTION.type)), []
    with closing(Live(Wanted.parse("action"), bus.endpoint, "table", limit_bytes=3 * len(payload))) as source:
        heard = source.heard()
        while next(heard) is not None:
            pass  # it listens
        published = threading.Event()

        def publish() -> None:
            while not source.dropped:
                bus.publish(ACTION, None, payload)
            published.set()

        threading.Thread(target=publish).start()
        assert published.wait(WAIT_S)
        source.heard = lambda: heard
        assert show(source, 3, lines.append) == 3
    assert "messages were dropped: they came faster than they could be shown" in lines[0]


def test_the_bus_of_a_run_and_of_the_newest_that_answers(bus, tmp_path):
    for i, (name, endpoint) in enumerate((("old", bus.endpoint), ("dead", free_endpoint("tcp/127.0.0.1:0")))):
        (tmp_path / name).mkdir()
        Config().with_values({"bus.endpoint": endpoint, "bus.world": "table"}).save(tmp_path / name / "config.json")
        os.utime(tmp_path / name / "config.json", (i, i))
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "config.json").write_text("{")
    assert on_bus(newest_run(tmp_path)).bus.endpoint == bus.endpoint
    with closing(live(Wanted.parse("frame"), endpoint=None, run=tmp_path / "old")) as source:
        assert source.world == "table"
    (tmp_path / "local").mkdir()
    Config().save(tmp_path / "local" / "config.json")
    with pytest.raises(SaccadeError, match="has no bus: give its log with --log"):
        live(Wanted.parse("frame"), endpoint=None, run=tmp_path / "local")


@pytest.mark.parametrize(("arguments", "words"), [
    (("echo", "nothing"), "key 'nothing' is none of Saccade's"),
    (("hz", "frame/mug"), "is none of Saccade's"),
    (("echo", "frame"), "is on a bus now: give --endpoint, --run or --log"),
    (("echo", "frame", "--run", "none"), "none/config.json cannot be read"),
    (("echo", "frame", "--run", "none", "--endpoint", "tcp/127.0.0.1:1"), "give one of them"),
    (("hz", "frame", "--log", "none"), "none cannot be read"),
    (("hz", "frame", "--endpoint", "nonsense"), "nonsense"),
    (("topics", "--live"), "is on a bus now: give --endpoint, --run or --log"),
    (("topics", "--run", "none"), "none/config.json cannot be read"),
    (("topics", "--endpoint", "nonsense"), "nonsense"),
    (("topics", "--live", "--world", "t b"), "is none of Saccade's"),
    (("topics", "--log", "none"), "none cannot be read"),
    (("topics", "--log", "none", "--live"), "--log is for a log"),
    (("topics", "--log", "none", "--world", "table"), "--log is for a log"),
])
def test_what_the_user_can_mend_is_one_line(monkeypatch, capsys, tmp_path, arguments, words):
    monkeypatch.chdir(tmp_path)
    code, out, err = call(monkeypatch, capsys, *arguments)
    assert (code, out) == (2, "")
    assert err.startswith("saccade: ")
    assert words in err
    assert err.count("\n") == 1


def test_a_log_of_another_world(log):
    with pytest.raises(SaccadeError, match="is of world 'table', not 'kitchen'"):
        show(Logged(Wanted.parse("saccade/kitchen/frame"), log), None)
