"""The front door: what it says, with which exit code, and what a run leaves behind."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import typer
from rich.console import Console

import saccade.app.cli.main as cli
from saccade.app.cli import texts
from saccade.app.doctor import Check, Finding, examine
from saccade.app.log.check import missing
from saccade.app.run.display import Progress, line, panel
from saccade.app.run.run import run
from saccade.services.simulator.scenes import PAPER_SCENES
from saccade.shared.bus.messages import Belief, Plan, Status, Truth
from saccade.shared.bus.topics import BELIEF, PLAN, STATUS, TOPICS, TRUTH
from saccade.shared.config import PACKAGE, WEIGHTS, Config, load
from saccade.shared.errors import SaccadeError
from saccade.shared.log.reading import RunReader
from saccade.tests.fakes.weights import write_random_weights
from saccade.tests.front_door import call
from saccade.tests.samples import sample

NAMES = ("coffee_can", "soup_can")


def started(*arguments, **more) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-m", "saccade", *map(str, arguments)], text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE, **more)


def living(group: int) -> list[str]:
    """Processes of a group that have not ended."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, leader = path.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue
        if int(leader) == group and state != "Z":
            found.append(path.parent.name)
    return found


def silent() -> Console:
    return Console(file=io.StringIO(), width=200)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    folder = tmp_path_factory.mktemp("weights")
    write_random_weights(folder, "pantry", NAMES)
    return folder


def small(weights, **values) -> Config:
    return Config().with_values({"scene.names": list(NAMES), "perception.weights": str(weights), "seed": 3,
                                 "simulator.max_steps": 4, "planner.candidates": 200} | values)


# --- what the commands say

def test_help_lists_the_commands(monkeypatch, capsys):
    code, out, _ = call(monkeypatch, capsys, "--help")
    assert code == 0
    for command in ("run", "bench", "report", "picture", "train", "doctor", "topics", "echo", "hz", "log"):
        assert f" {command} " in out


def commands(group=None, path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Every command's words."""
    group = group or typer.main.get_command(cli.app)
    return [words for name, command in group.commands.items()
            for words in (commands(command, (*path, name)) if hasattr(command, "commands") else [(*path, name)])]


@pytest.mark.parametrize("words", commands(), ids=" ".join)
def test_every_command_explains_itself(monkeypatch, capsys, words):
    """Also where a text of ours could be taken for markup."""
    code, out, _ = call(monkeypatch, capsys, *words, "--help")
    assert code == 0
    assert f"saccade {' '.join(words)} " in out
    for types in ("<bool>", "<str>", "<path>", "<list", "<int"):  # Python's words
        assert types not in out


def test_help_loads_nothing_heavy():
    """So that it is there at once."""
    script = ("import sys, saccade.app.cli.main; "
              "print([m for m in ('torch', 'mujoco', 'zenoh', 'numpy') if m in sys.modules])")
    done = subprocess.run([sys.executable, "-c", script], cwd=PACKAGE, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_topics_lists_the_registry(monkeypatch, capsys):
    code, out, _ = call(monkeypatch, capsys, "topics", "--world", "kitchen")
    assert code == 0
    for topic in TOPICS.values():
        assert topic.key("kitchen", "<part>" if topic.parts else None) in out
        assert topic.type.__name__ in out


@pytest.mark.parametrize(("arguments", "words"), [
    (("run", "--set", "planner.stride=1"), "configuration key 'planner.stride' is unknown"),
    (("run", "--set", "planner.step_m"), "--set 'planner.step_m': write KEY=VALUE"),
    (("run", "--set", "planner.step_m=far"), "planner.step_m"),
    (("train", "--set", "batch_cnc=3"), "training setting 'batch_cnc'"),
    (("train", "--set", "batch_ccn=0"), "training setting 'batch_ccn'"),
    (("run", "--config", "none.toml"), "none.toml cannot be read"),
    (("run", "--names", "teapot"), "'teapot' is not in 'pantry': choose from coffee_can"),
    (("run", "--agent", "nobody"), "agent 'nobody' is unknown: choose from sceneccn, paper"),
    (("run", "--agent", "oracle"), "add `--bus local`"),
    (("run", "--weights", "none"), "none/manifest.json are missing: train them"),
    (("run", "--agent", "posecnn"), "`saccade train --objects pantry --architecture posecnn`"),
    (("run", "--agent", "oracle", "--bus", "local", "--scene", "s1"), "scene.scene needs scene.file"),
    (("run", "--agent", "oracle", "--bus", "local", "--goal", "none.png"), "goal image"),
    (("bench", "--agent", "oracle", "--scenes", PAPER_SCENES), "is not in use: choose the set that has it"),
    (("bench", "--agent", "oracle", "--scenes", PAPER_SCENES, "--yaw", "random"), "--yaw is for scenes that are drawn"),
    (("bench", "--agent", "oracle", "--suite", "dev", "--yaw", "random"), "--yaw is for scenes that are drawn"),
    (("bench", "--agent", "oracle", "--suite", "dev", "--scenes", "s.json"), "leave --scenes or --suite out"),
    (("bench", "--agent", "oracle", "--suite", "all"), "suite 'all' is unknown: choose from paper-500, yaw-500"),
    (("bench", "--agent", "oracle", "--suite", "paper-500"), "is of the objects 'ycb': add `--objects ycb`"),
    (("report", "none.json", "--out", "r"), "results none.json cannot be read"),
    (("picture", "none.mcap"), "none.mcap cannot be read"),
    (("train", "--names", "teapot"), "'teapot' is not in 'pantry'"),
])
def test_what_the_user_can_mend_is_one_line_and_code_2(monkeypatch, capsys, tmp_path, arguments, words):
    """And leaves nothing behind."""
    monkeypatch.chdir(tmp_path)
    code, _, err = call(monkeypatch, capsys, *arguments)
    assert code == 2
    assert err.startswith("saccade: ")
    assert words in err
    assert err.count("\n") == 1
    assert not (tmp_path / "runs").exists()


def test_options_go_before_the_file_and_set_before_all(tmp_path):
    """file < option < --set; a value that is not JSON is text."""
    (tmp_path / "c.toml").write_text('seed = 1\n[scene]\nobjects = "ycb"\nyaw = "fixed"\n[planner]\nstep_m = 0.01\n')
    given = {"seed": 2, "scene.objects": None}
    config, agent = texts.configured(tmp_path / "c.toml", given, ["planner.step_m=0.03"], None)
    assert agent == "sceneccn"
    assert (config.seed, config.scene.objects, config.scene.yaw, config.planner.step_m) == (2, "ycb", "fixed", 0.03)
    assert texts.parse_value('scene.names=["a"]') == ("scene.names", ["a"])
    assert texts.parse_value("bus.world=a=b") == ("bus.world", "a=b")
    assert texts.split_names("a, b,") == ["a", "b"]


def test_interrupt_is_one_line_and_code_130(monkeypatch, capsys):
    def interrupt(*_arguments, **_options):
        raise KeyboardInterrupt("half is done")

    before = signal.getsignal(signal.SIGINT)
    try:
        monkeypatch.setattr("saccade.app.doctor.examine", interrupt)
        assert call(monkeypatch, capsys, "doctor")[::2] == (130, "saccade: interrupted: half is done\n")
    finally:
        signal.signal(signal.SIGINT, before)


def test_ctrl_c_ends_a_benchmark_and_its_processes(tmp_path):
    """Both get the signal, as from a terminal; the results so far are kept, and nobody is left."""
    process = started("bench", "--agent", "oracle", "--jobs", "2", "--json", tmp_path / "o.json",
                      start_new_session=True)
    partial = tmp_path / "o.json.partial.jsonl"
    try:
        while process.poll() is None and (not partial.is_file() or partial.read_text().count("\n") < 3):
            pass
        os.killpg(process.pid, signal.SIGINT)
        _, err = process.communicate(timeout=120)
        assert process.returncode == 130
        assert err.startswith("saccade: interrupted: the same command goes on from the ")
        assert err.count("\n") == 1
        assert partial.read_text().count("\n") >= 3
        end = time.monotonic() + 60
        while living(process.pid) and time.monotonic() < end:
            time.sleep(0.1)
        assert living(process.pid) == []
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)


# --- the doctor

def test_doctor_says_what_is_missing_and_how_to_mend_it():
    """Code 1 only for what the default run needs; a check that raises is a finding too."""
    def broken() -> Finding:
        raise SaccadeError("no [OpenGL]: install it")

    good = Check("good", lambda: Finding(True, "here"))
    optional = Check("optional", lambda: Finding(False, "not here", "fetch it"), needed=False)
    console = silent()
    assert examine(console, (good, optional)) == 0
    assert examine(console, (good, Check("bad", broken))) == 1
    text = console.file.getvalue()
    for words in ("fetch it", "no [OpenGL]: install it", "missing (optional)", "lacks: bad"):
        assert words in text


def test_doctor_checks_this_machine(monkeypatch, capsys):
    """Everything that the tests themselves need is found."""
    code, out, _ = call(monkeypatch, capsys, "doctor")
    states = {cells[1].strip(): cells[2].strip() for cells in (row.split("│") for row in out.splitlines())
              if len(cells) > 3 and cells[1].strip()}
    assert {name: states[name] for name in ("Python", "OpenGL", "Zenoh", "objects pantry")} == dict.fromkeys(
        ("Python", "OpenGL", "Zenoh", "objects pantry"), "ok")
    assert code == (0 if states["weights pantry"] == "ok" else 1)


# --- runs

def test_oracle_run_leaves_a_whole_log_configuration_and_picture(monkeypatch, capsys, tmp_path):
    """As `saccade run --bus local` on a scene of the file; the log needs no other file to be understood."""
    out = tmp_path / "run"
    code, text, _ = call(monkeypatch, capsys, "run", "--agent", "oracle", "--bus", "local", "--seed", 4,
                         "--n-objects", 2, "--yaw", "fixed", "--count", 2, "--out", out)
    assert code == 0
    assert "reached 2 of 2 goals" in text
    assert "azimuth" in text
    assert {path.name for path in out.iterdir()} == {"run.mcap", "config.json", "picture.png"}
    again = tmp_path / "again.png"
    assert call(monkeypatch, capsys, "picture", out, "--out", again)[0] == 0
    assert again.read_bytes() == (out / "picture.png").read_bytes()
    report, config = missing(out / "run.mcap"), load(out / "config.json")
    assert report.complete, report
    assert (config.seed, config.scene.n_objects, config.scene.yaw, len(config.scene.names)) == (4, 2, "fixed", 5)
    reader = RunReader(out / "run.mcap")
    assert {message.run for _, _, message in reader} == {"run"}
    assert json.loads(reader.configuration) == json.loads((out / "config.json").read_text())


def test_bus_and_one_process_log_the_same_bytes(tmp_path):
    """The shipped agent as processes on Zenoh and within this process; but for the statuses, which time makes."""
    episode = small(WEIGHTS / "pantry", **{
        "simulator.max_steps": 12, "planner.candidates": 5000, "scene.n_objects": 2})
    logs = []
    for kind in ("zenoh", "local"):
        out = tmp_path / kind / "same"
        run(episode.with_values({"bus.kind": kind}), agent="sceneccn", out=out, plain=True, console=silent())
        logged = defaultdict(list)
        for entry in RunReader(out / "run.mcap").entries():
            if entry.topic != STATUS:
                logged[entry.topic.name, entry.part].append(entry.payload)
        logs.append(logged)
        assert missing(out / "run.mcap").complete
    assert logs[0] == logs[1]
    assert len(logs[0]["action", None]) >= 4
    assert len(logs[0]["percept", NAMES[0]]) == len(logs[0]["action", None])


def test_plain_display_shows_belief_and_truth(tmp_path, weights):
    """A line at the start, then every tenth step."""
    console = silent()
    values = {"bus.kind": "local", "simulator.max_steps": 10, "planner.goal_confidence": 0.0}  # networks at random
    run(small(weights, **values), agent="sceneccn", out=tmp_path / "r", plain=True, console=console)
    lines = console.file.getvalue().splitlines()
    assert lines[0].startswith("episode 0 step 0  goal 0.")
    assert any(row.startswith("episode 0 step 10") and "believed" in row and " G " in row for row in lines)
    assert any("in 10 steps; errors: azimuth" in row for row in lines)


def test_exploring_tells_what_was_found_and_judges_nothing(tmp_path, weights):
    console = silent()
    run(small(weights, **{"bus.kind": "local", "scene.explore": True}), agent="sceneccn", out=tmp_path / "r",
        plain=True, console=console)
    text = console.file.getvalue()
    assert "explored for 4 steps" in text
    assert "goal" not in text
    assert "error" not in text


def test_a_run_is_never_written_over(tmp_path, weights):
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "run.mcap").write_bytes(b"precious")
    with pytest.raises(SaccadeError, match="is there already: a run needs a new folder"):
        run(small(weights), agent="sceneccn", out=tmp_path / "r", plain=True, console=silent())
    assert (tmp_path / "r" / "run.mcap").read_bytes() == b"precious"


def test_live_display_shows_what_is_believed_and_what_is_true():
    """From messages alone: distances, spread in centimetres, the terms of G, milliseconds of each service."""
    progress = Progress()
    camera, goal, viewpoint = np.eye(4), np.eye(4), np.eye(4)
    goal[:3, 3] = 0.3, 0.4, 0.0
    viewpoint[:3, 3] = 0.1, 0.2, 0.3
    progress.take(TRUTH, None, sample(Truth, world_from_camera=camera, goal_world_from_camera=goal, episode=0, step=7))
    progress.take(PLAN, None, sample(Plan, viewpoint=viewpoint, believed_distance_m=0.25, g_position=1.0, g_scale=2.0,
                                     g_pose=3.0, g_information=-0.5, mode="approach", target="mug"))
    progress.take(BELIEF, "mug", sample(Belief, covariance_m2=np.diag([4e-4, 4e-4, 1e-4]), presence=0.8))
    progress.take(STATUS, "perception", sample(Status, service="perception", milliseconds=41.0))
    console = silent()
    console.print(panel(progress))
    text = console.file.getvalue()
    for words in ("step 7", "0.50 m in truth", "0.25 m as believed", "(0.10, 0.20, 0.30) m", "approach mug",
                  "5.50 nats", "information -0.50", "3.0", "perception 41 ms"):
        assert words in text
    assert line(progress) == "episode 0 step 7  goal 0.50 m away  believed 0.25 m  approach mug  G 5.5  mug ±3.0 cm"
