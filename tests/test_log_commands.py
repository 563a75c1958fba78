"""`saccade log`, and `topics` of a log: what they print, with which exit code, and what a cut log says of itself."""

from __future__ import annotations

import io
from contextlib import nullcontext
from pathlib import Path

import pytest
from rich.console import Console

from saccade.app.log.check import abbreviated, missing
from saccade.app.log.cut import CUT, Range, cut, range_of
from saccade.app.log.recover import recover
from saccade.app.run.run import run as run_agent
from saccade.services.recorder.core import to_be_finished
from saccade.shared.bus.topics import ACTION, FRAME, GOAL, PERCEPT, RESULT, STATUS, TRUTH
from saccade.shared.bus.wire import encode
from saccade.shared.errors import SaccadeError
from saccade.shared.log.migrations import FORMAT
from saccade.shared.log.reading import RunReader
from saccade.shared.log.recording import RunLog
from saccade.tests.fixtures.make import CONFIG
from saccade.tests.front_door import call, rows
from saccade.tests.samples import sample

STEPS = 6
GOLDEN = Path(__file__).with_name("fixtures") / "golden.mcap"


def story(episodes=2):
    """(topic, part, message) of a run in lockstep, numbered as on the bus; every step has a status."""
    beats = 0
    for episode in range(episodes):
        def new(topic, step, seq, episode=episode, **changes):
            return topic, changes.get("object"), sample(topic.type, run="r", episode=episode, step=step, seq=seq,
                                                        **changes)

        for step in range(STEPS + 1):
            done = step == STEPS
            yield new(TRUTH, step, step, done=done)
            if done:
                yield new(RESULT, step, 0, success=True, steps=STEPS, target="mug")
                break
            if step == 0:
                yield new(GOAL, 0, 0)
            yield from (new(FRAME, step, step), new(PERCEPT, step, step, object="mug"), new(ACTION, step, step))
            yield STATUS, "planner", sample(STATUS.type, run="r", episode=0, step=0, seq=beats, service="planner")
            beats += 1


def write(path, messages, **metadata):
    log = RunLog(path, world="table", configuration='{"seed": 3}', metadata=metadata)
    for i, (topic, part, message) in enumerate(messages):
        log.write(topic, part, encode(message), sequence=message.seq, log_time_ns=(1_700_000_000_000 + i * 100) * 10**6)
    log.close()
    return path


@pytest.fixture
def run(tmp_path):
    """A run's folder."""
    write(tmp_path / "run" / "run.mcap", story(), versions={"x": "1"}, weights_sha256={"w": "0123456789abcdef"},
          run={"run": "r7", "seed": "3", "commit": "abc"})
    return tmp_path / "run"


def test_info_tells_origin_episodes_and_keys(monkeypatch, capsys, run):
    for where in (run, run / "run.mcap"):
        code, out, _ = call(monkeypatch, capsys, "log", "info", where)
        assert code == 0
        for words in ("r7, world table", f"format {FORMAT}", "seed 3, commit abc", "x 1", "w 0123456789ab\n",
                      "mug reached in 6 steps", "episode 1: ", "saccade/table/percept/mug", "2023-11-14"):
            assert words in out
    row = rows(out)["saccade/table/frame"]
    assert (row[1], row[-1]) == ("12", "0")


def test_info_of_a_log_that_lacks_messages_and_its_end(monkeypatch, capsys, run, tmp_path):
    messages = [m for i, m in enumerate(story(1)) if not (m[0] == FRAME and m[2].step == 2)]
    path = write(tmp_path / "g.mcap", messages)
    path.write_bytes(path.read_bytes()[:-4])
    code, out, _ = call(monkeypatch, capsys, "log", "info", path)
    assert code == 0
    assert rows(out)["saccade/table/frame"][-1] == "1"
    assert "is cut or damaged" in out


def test_topics_of_a_log(monkeypatch, capsys, run):
    code, out, err = call(monkeypatch, capsys, "topics", "--log", GOLDEN)
    sizes = {}
    for topic, part, payload, _ in RunReader(GOLDEN).entries():
        sizes.setdefault(topic.key("table", part), [topic.type.__name__]).append(len(payload))
    found = rows(out)
    assert (code, err) == (0, "")
    assert list(found) == sorted(sizes)
    for key, (name, *of_key) in sizes.items():
        assert found[key][:3] == [name, str(len(of_key)), f"{sum(of_key):,}"]
    assert [found[f"saccade/table/{name}"][4] for name in ("truth", "frame", "goal")] == [
        "0:0 to 0:4", "0:0 to 0:3", "0:0"]
    found = rows(call(monkeypatch, capsys, "topics", "--log", run)[1])
    assert found["saccade/table/percept/mug"][4] == "0:0 to 1:5"
    assert found["saccade/table/status/planner"][4] == ""  # belongs to no step


def test_topics_of_a_log_that_is_cut_or_has_nothing(monkeypatch, capsys, run, tmp_path):
    (tmp_path / "cut.mcap").write_bytes((run / "run.mcap").read_bytes()[:-4])
    code, out, _ = call(monkeypatch, capsys, "topics", "--log", tmp_path / "cut.mcap")
    assert code == 0
    assert "is cut or damaged" in out
    code, out, _ = call(monkeypatch, capsys, "topics", "--log", write(tmp_path / "none.mcap", []))
    assert (code, out) == (0, f"log {tmp_path / 'none.mcap'} holds no message\n")


def test_check_says_what_is_missing_by_its_exit_code_too(monkeypatch, capsys, run, tmp_path):
    code, out, _ = call(monkeypatch, capsys, "log", "check", run)
    assert (code, out.split(":")[0]) == (0, "complete")
    write(tmp_path / "g.mcap", [m for m in story() if not (m[0] == ACTION and m[2].step in (1, 2, 4))])
    code, out, err = call(monkeypatch, capsys, "log", "check", tmp_path / "g.mcap")
    assert (code, err) == (1, "")
    assert "saccade/table/action: 6 messages lost, by their sequence numbers\n" in out
    assert "saccade/table/action: not there in episode 1 of r, step 1-2, 4\n" in out
    RunLog(tmp_path / "none.mcap", world="table").close()
    code, out, _ = call(monkeypatch, capsys, "log", "check", tmp_path / "none.mcap")
    assert (code, out) == (1, "holds no message\n")


def test_numbers_are_abbreviated():
    assert abbreviated([]) == ""
    assert abbreviated([1, 2, 3, 7, 9, 10]) == "1-3, 7, 9-10"
    assert abbreviated(range(0, 20, 2)).endswith("10 and 4 stretches more")


def test_recover_on_the_command_line(monkeypatch, capsys, run, tmp_path):
    whole = (run / "run.mcap").read_bytes()
    code, out, _ = call(monkeypatch, capsys, "log", "recover", run, "--out", tmp_path / "a.mcap")
    assert (code, "nothing is missing" in out) == (0, True)
    (tmp_path / "cut.mcap").write_bytes(whole[:-20])  # of the index
    code, out, _ = call(monkeypatch, capsys, "log", "recover", tmp_path / "cut.mcap", "--out", tmp_path / "b.mcap")
    assert (code, "nothing is missing" in out) == (0, True)
    assert missing(tmp_path / "b.mcap").complete
    monkeypatch.setattr("saccade.shared.log.recording.FLUSH_S", 0.0)
    whole = write(tmp_path / "c.mcap", story(1)).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[:len(whole) // 2])
    code, out, _ = call(monkeypatch, capsys, "log", "recover", tmp_path / "cut.mcap", "--out", tmp_path / "d.mcap")
    assert code == 0
    assert "it lacks:\nlost behind the cut: " in out or "it lacks:\nthe recording was not finished" in out


def test_a_cut_has_its_steps_what_is_latched_and_the_status_of_that_time(run, tmp_path):
    kept = cut(run / "run.mcap", tmp_path / "c.mcap", episode=0, start=2, end=4)
    assert kept == Range(0, 2, 4)
    reader = RunReader(tmp_path / "c.mcap")
    found = [(t, m.episode, m.step, m.seq) for t, _, m in reader]
    assert range_of(reader) == kept
    assert reader.metadata[CUT] == {"episode": "0", "start": "2", "end": "4"}
    assert reader.metadata["run"]["run"] == "r7"
    assert reader.configuration == '{"seed": 3}'
    assert [step for t, _, step, _ in found if t == FRAME] == [2, 3, 4]
    assert [step for t, _, step, _ in found if t == GOAL] == [0]
    assert not [t for t, *_ in found if t == RESULT]  # of a later step
    assert [seq for t, *_, seq in found if t == STATUS] == [2, 3]  # the last one came behind step 4
    assert {episode for _, episode, *_ in found} == {0}
    entries = {(e.topic, e.part, e.payload, e.log_time_ns) for e in RunReader(run / "run.mcap").entries()}
    assert {(e.topic, e.part, e.payload, e.log_time_ns) for e in reader.entries()} <= entries
    assert missing(tmp_path / "c.mcap").complete


def test_a_cut_that_lacks_something_is_not_complete(run, tmp_path):
    write(tmp_path / "g.mcap", [m for m in story() if not (m[0] == ACTION and m[2].step == 3)])
    cut(tmp_path / "g.mcap", tmp_path / "c.mcap", start=2, end=4)
    report = missing(tmp_path / "c.mcap")
    assert report.absent == [("r", 1, "saccade/table/action", 3, 3)]
    assert report.lost == {"saccade/table/action": 1}
    write(tmp_path / "h.mcap", [m for m in story() if m[2].step not in (2, 4)])
    assert cut(tmp_path / "h.mcap", tmp_path / "d.mcap", start=2, end=4) == Range(1, 2, 4)
    assert [at.first for at in missing(tmp_path / "d.mcap").absent] == [2, 4] * 4


def test_a_log_that_was_recorded_from_a_later_step_on_is_complete_from_there(tmp_path):
    messages = [m for m in story() if m[2].step >= 3]
    write(tmp_path / "late.mcap", messages, cut={"start": 3})
    assert missing(tmp_path / "late.mcap").complete
    write(tmp_path / "later.mcap", messages, cut={"start": 2})
    assert {at[3:] for at in missing(tmp_path / "later.mcap").absent} == {(2, 2)}
    assert cut(tmp_path / "late.mcap", tmp_path / "c.mcap", end=4) == Range(1, 3, 4)
    assert missing(tmp_path / "c.mcap").complete


def test_cuts_up_to_the_end_and_of_cuts(monkeypatch, capsys, run, tmp_path):
    code, out, _ = call(monkeypatch, capsys, "log", "cut", run, "--out", tmp_path / "c.mcap", "--start", 3)
    assert (code, out) == (0, f"steps 3 to 6 of episode 1 written to {tmp_path / 'c.mcap'}\n")
    assert call(monkeypatch, capsys, "log", "check", tmp_path / "c.mcap")[0] == 0
    assert [t for t, _, _ in RunReader(tmp_path / "c.mcap") if t == RESULT]
    assert cut(tmp_path / "c.mcap", tmp_path / "d.mcap", end=4) == Range(1, 3, 4)
    assert missing(tmp_path / "d.mcap").complete


@pytest.mark.parametrize(("arguments", "words"), [
    (("info", "none"), "cannot be read"),
    (("check", "none"), "cannot be read"),
    (("recover", "none", "--out", "o.mcap"), "cannot be read"),
    (("recover", "run", "--out", "run/run.mcap"), "is there already: name a new place"),
    (("cut", "run", "--out", "run/run.mcap"), "is there already"),
    (("cut", "run", "--out", "o.mcap", "--episode", 7), "has no episode 7: choose from 0 to 1"),
    (("cut", "run", "--out", "o.mcap", "--start", 9), "has the steps 0 to 6: none of from 9 on"),
    (("cut", "run", "--out", "o.mcap", "--start", 4, "--end", 2), "none of 4 to 2"),
    (("cut", "run", "--out", "run/run.mcap/o"), "cannot be written"),
    (("export", "none", "--out", "o.mcap"), "cannot be read"),
    (("export", "run", "--out", "run/run.mcap", "--tables"), "is there already"),
])
def test_what_the_user_can_mend_is_one_line(monkeypatch, capsys, run, tmp_path, arguments, words):
    monkeypatch.chdir(tmp_path)
    code, out, err = call(monkeypatch, capsys, "log", *arguments)
    assert (code, out) == (2, "")
    assert err.startswith("saccade: ")
    assert words in err
    assert err.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_a_log_whose_own_words_make_no_sense_is_one_clear_error(tmp_path):
    write(tmp_path / "a.mcap", story(1), log={"format": "two"})
    with pytest.raises(SaccadeError, match="'two', which is no number"):
        missing(tmp_path / "a.mcap")
    write(tmp_path / "b.mcap", story(1), cut={"episode": "x"})
    with pytest.raises(SaccadeError, match="does not say to which steps"):
        missing(tmp_path / "b.mcap")


def test_export_is_wired(monkeypatch, capsys, run, tmp_path):
    pytest.importorskip("foxglove")
    pytest.importorskip("pyarrow")
    code, out, _ = call(monkeypatch, capsys, "log", "export", run, "--out", tmp_path / "e.mcap")
    assert (code, "messages written" in out, (tmp_path / "e.mcap").is_file()) == (0, True, True)
    code, out, _ = call(monkeypatch, capsys, "log", "export", run, "--out", tmp_path / "t", "--tables")
    assert (code, "tables written" in out) == (0, True)
    assert (tmp_path / "t" / "frame.parquet").is_file()


def test_a_run_that_was_not_finished_is_told_by_its_exit_code_too(monkeypatch, capsys, tmp_path):
    """Its log knows that an end was awaited, and of how many episodes. A part of it owes none."""
    awaited = to_be_finished()
    write(tmp_path / "a.mcap", story(1), **awaited)
    code, out, err = call(monkeypatch, capsys, "log", "check", tmp_path / "a.mcap")
    assert (code, err, out.count("\n")) == (1, "", 1)
    assert out.startswith("the run was not finished: it was ended in episode 0, ")
    assert "the run was not finished" in call(monkeypatch, capsys, "log", "info", tmp_path / "a.mcap")[1]
    write(tmp_path / "none.mcap", [], **awaited)
    assert "it was ended before its first step" in call(monkeypatch, capsys, "log", "check", tmp_path / "none.mcap")[1]
    cut(tmp_path / "a.mcap", tmp_path / "c.mcap", start=2)
    assert missing(tmp_path / "c.mcap").complete
    recover(tmp_path / "a.mcap", tmp_path / "r.mcap")
    assert missing(tmp_path / "r.mcap").unfinished
    for episodes, lines in (("2", []), ("5", ["episodes that are not there: 2-4"]),
                            (str(2 ** 62), [f"episodes that are not there: 2-{2 ** 62 - 1}"]), ("many", [])):
        path = write(tmp_path / f"{episodes}.mcap", story(), **awaited, finished={"episodes": episodes})
        assert list(missing(path).lines()) == lines


def test_a_run_in_one_process_says_whether_it_was_finished(tmp_path, monkeypatch):
    def ended_by(how, folder):
        def local(pairs, names, run, on_message, encoded):
            for topic, part, message in story(1):
                if topic != STATUS:
                    on_message(topic, part, message, encode(message))
            if how is not None:
                raise how

        monkeypatch.setattr("saccade.app.run.run.run_local", local)
        with pytest.raises(type(how)) if how is not None else nullcontext():
            run_agent(CONFIG, agent="sceneccn", out=folder, plain=True, console=Console(file=io.StringIO()))
        return missing(folder / "run.mcap")

    assert ended_by(None, tmp_path / "a").complete
    assert ended_by(KeyboardInterrupt(), tmp_path / "b").unfinished
    assert ended_by(SaccadeError("the planner has no weights"), tmp_path / "c").unfinished
