"""Recorded inputs give again what was recorded, to the byte; where they do not, it is said which field, where, by how
much."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from saccade.app.log.check import missing
from saccade.app.replay.comparison import Comparison, differences
from saccade.app.replay.replay import REPLAYABLE
from saccade.app.replay.tolerances import TOLERANCES, tolerance_of
from saccade.app.run.registry import configuration
from saccade.app.run.run import run
from saccade.shared.bus.messages import field_types
from saccade.shared.bus.topics import (
    ACTION,
    BELIEF,
    EVENTS,
    FRAME,
    GOAL,
    GOAL_PERCEPT,
    PERCEPT,
    PLAN,
    STATUS,
    TOPICS,
    TRUTH,
)
from saccade.shared.bus.wire import encode
from saccade.shared.log.migrations import FORMAT, OLDEST
from saccade.shared.log.reading import RunReader
from saccade.shared.log.recording import RunLog
from saccade.tests.fixtures.make import CONFIG, GOLDEN, IN_WORDS, WORDS, changes, in_words
from saccade.tests.samples import sample

FORMAT_1, FORMAT_2, FORMAT_3, FORMAT_4, FORMAT_5, FORMAT_6, FORMAT_7, _ = OLDER = tuple(
    GOLDEN.with_name(f"format_{number}.mcap") for number in (1, 2, 3, 4, 5, 6, 7, 8))
WAIT_S = 300


def saccade(*arguments: str | Path, keys: str = "") -> subprocess.CompletedProcess:
    """`saccade replay` as a user gives it, with these key presses."""
    return subprocess.run([sys.executable, "-m", "saccade", "replay", *map(str, arguments)],
                          capture_output=True, text=True, input=keys, timeout=WAIT_S,
                          env=os.environ | {"COLUMNS": "200"})


def messages(log: Path, *topics) -> list:
    return [(t.name, p, encode(m)) for t, p, m in RunReader(log) if t in topics]


@pytest.mark.parametrize("name", ["perception", "belief", "planner"])
def test_each_service_says_again_what_the_golden_log_holds(tmp_path, name):
    """A changed result fails here and names the field. If it is meant: `make fixtures`, and look at golden.txt."""
    done = saccade(GOLDEN, "--into", name, "--check", "--bus", "local", "--out", tmp_path / "replay")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 beyond what is tolerated" in done.stdout
    assert "; 0 answers" not in done.stdout


def test_the_golden_log_in_words_is_that_of_the_log():
    assert WORDS.read_text().splitlines() == in_words(GOLDEN)
    assert changes(GOLDEN, GOLDEN) == []


def test_the_oldest_format_still_replays_to_the_byte(tmp_path):
    """Also its sequence numbers, which ran through all episodes then. Its weights are those of today: when they change,
    this compares no more, but must still run."""
    reader = RunReader(FORMAT_1)
    first = {(t.name, p, m.episode): m.seq for t, p, m in reversed(list(reader)) if t.in_step}
    assert reader.format == 1
    assert set(first.values()) == {0}
    done = saccade(FORMAT_1, "--into", "perception,belief,planner", "--bus", "local", "--out", tmp_path / "replay")
    assert done.returncode == 0, done.stderr
    assert missing(tmp_path / "replay" / "run.mcap").complete
    again = {(name, p) for name, p, _ in messages(tmp_path / "replay" / "run.mcap", *IN_WORDS)}
    assert again == {(name, p) for name, p, _ in messages(FORMAT_1, *IN_WORDS)} | {("events", None)}


def test_the_golden_log_has_the_present_format_and_each_older_one_has_a_log():
    readers = [RunReader(log) for log in (*OLDER, GOLDEN)]
    assert all(list(reader) for reader in readers)
    assert [reader.format for reader in readers] == list(range(OLDEST, FORMAT + 1))


@pytest.mark.parametrize(("log", "lacks"), [(FORMAT_2, "mask_bits"), (FORMAT_3, "camera_from_object"),
                                            (FORMAT_4, "rotations"), (FORMAT_6, "goal_agreement")])
def test_what_a_format_did_not_have_is_no_difference(tmp_path, log, lacks):
    """Format 2 had neither masks nor candidates, format 3 no poses, format 4 no more than one, format 6 no
    comparison with the goal image; all else is compared."""
    assert {getattr(m, lacks) is None for t, _, m in RunReader(log) if t == PERCEPT} == {True}
    done = saccade(log, "--into", "perception,belief,planner", "--check", "--bus", "local", "--out",
                   tmp_path / "replay")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 beyond what is tolerated" in done.stdout


def test_a_log_without_places_and_instances_tells_a_scene_of_the_paper():
    """Format 5: goal and truth lacked them. All that was in it is as it was."""
    goal, = (m for t, _, m in RunReader(FORMAT_5) if t == GOAL)
    truths = [m for t, _, m in RunReader(FORMAT_5) if t == TRUTH]
    assert goal.workspace_m is None
    assert {(t.target_instance, t.instances, t.events) for t in truths} == {(1, None, None)}
    assert truths[0].labels() == truths[0].names
    assert not changes(FORMAT_5, FORMAT_6)


def test_a_log_without_motion_tells_objects_that_rest():
    """Format 6: beliefs lacked it, and there was no topic for events."""
    assert all(t != EVENTS for t, _, _ in RunReader(FORMAT_6))
    assert {m.velocity_m is None and m.since_step == 0 for t, _, m in RunReader(FORMAT_6) if t == BELIEF} == {True}


def test_a_belief_without_rolled_goals_is_one_of_an_upright_world():
    """Format 6: beliefs lacked them."""
    assert {b.goal_rotations is None for t, _, b in RunReader(FORMAT_6) if t == BELIEF} == {True}


def test_a_log_without_instances_tells_of_the_first_of_each_kind():
    """Format 7: percepts and beliefs had no further ones of a kind, plans and events no numbers. All else that the
    agent says is as it was."""
    said = [m for t, _, m in RunReader(FORMAT_7) if t in (PERCEPT, BELIEF, PLAN)]
    assert {m.further == [] for m in said if hasattr(m, "further")} == {True}
    assert {m.instance for m in said if hasattr(m, "instance")} == {1}
    assert {m.target_instance for m in said if hasattr(m, "target_instance")} == {1}
    assert not changes(FORMAT_7, GOLDEN)


def test_on_the_bus_as_in_one_process_nothing_is_lost(tmp_path):
    """Of a log that this machine recorded: another processor's last digits may be others."""
    run(CONFIG, agent="sceneccn", out=tmp_path / "golden", plain=True)
    recorded = tmp_path / "golden" / "run.mcap"
    done = saccade(recorded, "--into", ",".join(REPLAYABLE), "--check", "--out", tmp_path / "replay")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 differ in a byte" in done.stdout
    assert "loss: 0 of" in done.stdout
    last = {p: m for t, p, m in RunReader(tmp_path / "replay" / "run.mcap") if t == STATUS}
    assert {name: status.refused for name, status in last.items()} == dict.fromkeys(
        ("router", "recorder", *REPLAYABLE), 0)
    topics = [topic for topic in TOPICS.values() if topic != STATUS]
    assert sorted(messages(tmp_path / "replay" / "run.mcap", *topics)) == sorted(messages(recorded, *topics))


def test_a_swapped_service_is_held_against_the_old_log(tmp_path):
    out = tmp_path / "replay"
    done = saccade(GOLDEN, "--into", "perception,belief,planner", "--check", "--bus", "local", "--out", out, "--set",
                   "perception.passes=1")
    assert done.returncode == 1
    assert "percept/soup_can episode 0 step 0: pixel: recorded [" in done.stdout
    table = (out / "moved.txt").read_text()
    for what in ("pixel (px)", "position (cm)", "goal view (rad)", "viewpoint (cm)", "move (cm)"):
        assert what in table
    assert (out / "moved.png").read_bytes().startswith(b"\x89PNG")


def test_a_part_of_a_log(tmp_path):
    """Perception needs no past: its answers from step 2 on are those of the recording."""
    done = saccade(GOLDEN, "--into", "perception", "--check", "--bus", "local", "--start", "2", "--end", "2", "--out",
                   tmp_path / "replay")
    played = [m.step for t, _, m in RunReader(tmp_path / "replay" / "run.mcap") if t == FRAME]
    assert played == [2]
    assert "percept" not in "".join(line for line in done.stdout.splitlines() if "only" in line and "goal" not in line)


def test_nothing_to_compare_is_no_success(tmp_path):
    done = saccade(GOLDEN, "--into", "planner", "--check", "--bus", "local", "--topics", "goal", "--start", "4",
                   "--out", tmp_path / "replay")
    assert done.returncode == 1
    assert "0 answers compared" in done.stdout
    assert "nothing could be compared: play more of the log" in done.stdout


def test_a_service_that_the_recorded_run_did_without_is_told(tmp_path):
    config, agent = configuration(None, {"scene.names": ["soup_can"], "simulator.max_steps": 2, "bus.kind": "local"},
                                  "random-walk")
    run(config, agent=agent, out=tmp_path / "walk", plain=True, console=Console(quiet=True))
    done = saccade(tmp_path / "walk", "--into", "perception,planner", "--bus", "local", "--out", tmp_path / "replay")
    assert "nothing of perception is in what was played: either the recorded run had no such service" in done.stdout
    assert "0 differ in a byte" in done.stdout
    assert "only now" not in done.stdout


def test_key_presses_give_one_message_each(tmp_path):
    done = saccade(GOLDEN, "--into", "perception", "--bus", "local", "--step", "--out", tmp_path / "a", keys="  q")
    assert "2 messages played" in done.stdout
    done = saccade(GOLDEN, "--into", "perception", "--bus", "local", "--rate", "1", "--out", tmp_path / "b", keys=" q")
    assert "paused" in done.stdout
    assert "0 messages played" in done.stdout


def test_two_logs_at_once_and_more_than_once(tmp_path):
    done = saccade(GOLDEN, GOLDEN, "--into", "planner", "--check", "--bus", "local", "--loop", "2", "--out",
                   tmp_path / "replay")
    assert done.returncode == 0, done.stderr
    logs = sorted((tmp_path / "replay").rglob("run.mcap"))
    assert len(logs) == 4
    assert len({tuple(messages(log, ACTION)) for log in logs}) == 1


@pytest.mark.parametrize(("arguments", "reason"), [
    (["--into", "simulator"], "--into simulator: choose from perception, belief, planner, evaluator"),
    (["--into", "belief", "--rate", "0"], "--rate 0: give a number from 0.1 to 100, or max"),
    (["--into", "belief", "--start", "x"], "--start and --end: give two steps such as 3, or two times such as 2.5s"),
    (["--into", "belief", "--start", "500s"], "the time asked for is empty"),
    (["--into", "belief", "--start", "900"], "has the steps 0 to 4: none of from 900 on"),
    (["--into", "belief", "--start", "7", "--end", "9"], "has the steps 0 to 4: none of 7 to 9"),
    (["--into", "belief", "--episode", "3"], "has no episode 3: choose from 0 to 0"),
    (["--into", "belief", "--topics", "frames"], "--topics frames: choose from frame"),
    (["--into", "belief", "--perception", "nowhere"], "--perception nowhere: "),
    (["--into", "belief", "--set", "belief.colour=1"], "configuration key 'belief.colour' is unknown"),
])
def test_what_makes_no_sense_is_one_line(tmp_path, arguments, reason):
    done = saccade(GOLDEN, *arguments, "--bus", "local", "--out", tmp_path / "replay")
    assert done.returncode == 2
    assert done.stderr.startswith("saccade: ")
    assert done.stderr.count("\n") == 1
    assert reason in done.stderr
    assert not (tmp_path / "replay").exists()


def test_a_log_without_messages_or_configuration_is_one_line(tmp_path):
    RunLog(tmp_path / "empty.mcap", world="test").close()
    done = saccade(tmp_path / "empty.mcap", "--into", "belief", "--out", tmp_path / "replay")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "holds no messages: nothing to replay" in done.stderr


def test_differences_name_the_field_the_place_and_both_values():
    old = sample(PERCEPT.type, object="mug", episode=1, step=7)
    pixel = old.pixel + np.array([0.0, 3.0])
    new = dataclasses.replace(old, pixel=pixel, presence=0.25, latent_std=old.latent_std + np.float32(1e-4))
    told = {d.field: d for d in differences(PERCEPT, "mug", old, new)}
    assert set(told) == {"pixel", "presence", "latent_std"}
    assert str(told["pixel"]) == "percept/mug episode 1 step 7: pixel: recorded [1] 1, replayed [1] 4"
    assert (told["pixel"].size, told["presence"].size) == (3.0, 0.25)
    assert [told[name].tolerated for name in ("pixel", "presence", "latent_std")] == [False, False, True]


@pytest.mark.parametrize("topic", [PERCEPT, GOAL_PERCEPT])
def test_a_mask_may_differ_in_a_few_cells_and_no_more(topic):
    """Also one that is gone, or stands a cell beside where it was, is another mask."""
    mask = np.zeros((60, 60), bool)
    mask[20:34, 20:34] = True
    outline = mask.copy()
    outline[20, 20:24] = False

    def found(other):
        old, new = (sample(topic.type, episode=1, step=7, mask_bits=np.packbits(m, axis=1)) for m in (mask, other))
        return list(differences(topic, "mug", old, new))

    assert found(mask) == []
    assert [(d.field, d.tolerated) for d in found(outline)] == [("mask_bits", True)]
    for other in (~mask, np.zeros_like(mask), np.roll(mask, 1, axis=1)):
        assert [(d.field, d.tolerated) for d in found(other)] == [("mask_bits", False)]
    told, = found(~mask)
    assert str(told) == f"{topic.name}/mug episode 1 step 7: mask_bits: recorded [0, 0] 0, replayed [0, 0] 255"
    assert told.size == pytest.approx(60 / 64)


def test_a_comparison_waits_for_both_and_tells_what_is_alone():
    comparison, action = Comparison(), sample(ACTION.type, step=1)
    assert not comparison.equal  # nothing was compared
    later = sample(ACTION.type, step=2)
    comparison.replayed(ACTION, None, encode(action))
    comparison.recorded(ACTION, None, encode(later))
    assert not comparison.equal
    comparison.recorded(ACTION, None, encode(action))
    assert (comparison.compared, comparison.unequal) == (1, 0)
    assert comparison.only_recorded == [("action", None, 3, 2)]
    turned = dataclasses.replace(later, arrived=False)
    found = comparison.replayed(ACTION, None, encode(turned))
    assert [(d.field, d.recorded, d.replayed, d.tolerated) for d in found] == [("arrived", "True", "False", False)]
    assert (comparison.beyond, comparison.only_recorded, comparison.equal) == (1, [], False)


def test_every_tolerance_has_a_reason_and_a_field():
    for (topic, name), tolerance in TOLERANCES.items():
        assert tolerance.reason
        assert name == "*" or name in field_types(TOPICS[topic].type)
    assert tolerance_of("truth", "yaws_rad").absolute == 0
    assert tolerance_of("belief", "mean_m") == TOLERANCES[BELIEF.name, "mean_m"]
