"""Folders that are full or read-only: one line, exit code 2, and nothing that was recorded is lost."""

from __future__ import annotations

import errno
import io
import json
import os
import subprocess
from pathlib import Path

import pytest
from rich.console import Console

from saccade.app.bench import bench as bench_module
from saccade.app.bench.bench import bench, prepare
from saccade.app.cli import main as cli
from saccade.app.run.run import run
from saccade.services.simulator.scenes import PAPER_SCENES
from saccade.shared.config import PACKAGE, Config, load
from saccade.shared.files import append_line, replace_all
from saccade.shared.log.reading import RunReader
from saccade.tests.front_door import call
from saccade.tests.hostile import complaint, full_disk
from saccade.tests.test_bench import record

GOLDEN = PACKAGE / "tests" / "fixtures" / "golden.mcap"
RESULTS = PACKAGE / "results" / "ycb-paper-500.json"
LOCAL = ("run", "--bus", "local", "--agent", "oracle", "--plain", "--set", "simulator.max_steps=20", "--out")
COMMANDS = {  # what each writes, below a folder
    "run": lambda out: (*LOCAL, out / "run"),
    "film": lambda out: ("film", GOLDEN, out / "a.gif"),
    "picture": lambda out: ("picture", GOLDEN, "--out", out / "a.png"),
    "view": lambda out: ("view", GOLDEN, "--save", out / "a.rrd"),
    "export": lambda out: ("log", "export", GOLDEN, "--out", out / "a.mcap"),
    "tables": lambda out: ("log", "export", GOLDEN, "--out", out / "tables"),
    "recover": lambda out: ("log", "recover", GOLDEN, "--out", out / "b.mcap"),
    "cut": lambda out: ("log", "cut", GOLDEN, "--episode", 0, "--out", out / "c.mcap"),
    "train": lambda out: ("train", "--out", out / "t", "--views", 20, "--steps-ccn", 1, "--steps-extraction", 1),
    "report": lambda out: ("report", RESULTS, "--no-reruns", "--out", out / "report"),
    "bench": lambda out: ("bench", "--agent", "oracle", "--limit", 1, "--json", out / "b.json")}


@pytest.fixture
def disk(tmp_path):
    """A file system of 64 kB; needs root."""
    folder = tmp_path / "disk"
    folder.mkdir()
    try:
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", folder], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no right to mount a small file system")
    yield folder
    subprocess.run(["umount", folder], check=True)


def fill(folder: Path, but: int = 0) -> None:
    """Leaves so many bytes of a small file system."""
    free = os.statvfs(folder)
    (folder / "ballast").write_bytes(bytes(free.f_bavail * free.f_bsize - but))


def said(err: str) -> str:
    """The one line that an error is, beside what says how far something is."""
    *_, last = err.strip().splitlines()
    assert err.count("saccade: ") == 1
    assert "Traceback" not in err
    return last


@pytest.mark.parametrize("command", COMMANDS)
def test_a_full_disk_is_told_in_one_line(monkeypatch, capsys, disk, command):
    """Of what was half written nothing stays but empty folders and empty files."""
    fill(disk, but=8192 if command in ("film", "picture", "view", "export", "tables", "recover", "cut") else 0)
    code, _, err = call(monkeypatch, capsys, *COMMANDS[command](disk))
    assert code == 2
    assert said(err).startswith("saccade: ")
    assert "No space left on device" in err or "perhaps the disk is full" in err
    assert [path for path in disk.rglob("*") if path.is_file() and path.stat().st_size and path.name != "ballast"] == []


@pytest.mark.parametrize("command", COMMANDS)
def test_a_read_only_folder_is_told_in_one_line(monkeypatch, capsys, disk, command):
    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    code, _, err = call(monkeypatch, capsys, *COMMANDS[command](disk))
    assert code == 2
    assert "Read-only file system" in said(err)


def test_a_run_whose_log_meets_a_full_disk_ends_and_keeps_what_was_recorded(monkeypatch, capsys, disk):
    fill(disk, but=49_152)
    code, out, err = call(monkeypatch, capsys, *LOCAL, disk / "run", "--set", "simulator.publish_depth=true")
    assert code == 2
    assert "in 20 steps" in out or "reached the goal" in out
    assert err.startswith("saccade: recording stopped (No space left on device)")
    assert err.count("recording stopped") == 1
    assert load(disk / "run" / "config.json").simulator.publish_depth
    assert RunReader(disk / "run" / "run.mcap").path.stat().st_size > 0


@pytest.mark.parametrize(("name", "words"), [
    ("x" * 300, "File name too long"), ("a\0b", "must be Unicode"), ("\udcff", "must be Unicode"),
    ("\x1b[31m", "control codes")])
def test_a_folder_that_cannot_have_such_a_name_is_told(monkeypatch, tmp_path, name, words):
    """Its name is in every message of the run."""
    config = Config().with_values({"bus.kind": "local", "simulator.max_steps": 1})
    assert words in complaint(run, config, agent="oracle", out=tmp_path / name, plain=True)
    assert os.listdir(tmp_path) == []


# The benchmark.

def planned(folder: Path):
    config = Config().with_values({"scene.objects": "ycb", "scene.file": str(PAPER_SCENES)})
    return prepare("oracle", config, folder / "o.json", limit=3)


def test_a_benchmark_keeps_what_it_has_reached(tmp_path, monkeypatch):
    """The disk is full at the third record: two are kept, whole, and the same command goes on from them."""
    plan, appended = planned(tmp_path), []
    records = [record(scene=plan.scenes[number].id) for number in plan.chosen]
    monkeypatch.setattr(bench_module, "_records", lambda _plan, numbers, *_: iter(records[-len(numbers):]))

    def append(path, text):
        appended.append(text)
        return full_disk() if len(appended) == 4 else append_line(path, text)  # the first is the header

    def go() -> list:
        return bench(plan, jobs=1, command="saccade bench", console=Console(file=io.StringIO()))

    monkeypatch.setattr(bench_module, "append_line", append)
    text = complaint(go)
    assert "No space left on device" in text
    assert f"the results of 2 of 3 scenes are kept in {plan.partial}" in text
    assert [json.loads(line).get("scene") for line in plan.partial.read_text().splitlines()] == \
        [None, records[0]["scene"], records[1]["scene"]]
    monkeypatch.setattr(bench_module, "replace_whole", full_disk)
    assert "the results of 3 of 3 scenes are kept" in complaint(go)
    assert not plan.out.exists()
    monkeypatch.undo()
    monkeypatch.setattr(bench_module, "_records", lambda *_: iter(()))
    assert [r["scene"] for r in go()] == [r["scene"] for r in records]
    assert not plan.partial.exists()


@pytest.mark.parametrize("rubbish", ["[" * 10 ** 5, "3", '{"scene": 3}', '{"facts": 3}', '{"scene": "a"}', "\0" * 99])
def test_rubbish_among_the_results_that_are_kept_is_left_out(tmp_path, monkeypatch, rubbish):
    plan = planned(tmp_path)
    records = [record(scene=plan.scenes[number].id) for number in plan.chosen]
    monkeypatch.setattr(bench_module, "_records", lambda *_: iter(records))
    plan.partial.write_text(f"{rubbish}\n")
    done = bench(plan, jobs=1, command="saccade bench", console=Console(file=io.StringIO()))
    assert [r["scene"] for r in done] == [r["scene"] for r in records]


# Writing whole files and lines.

def test_a_line_is_appended_whole_or_not_at_all(disk):
    append_line(disk / "lines", "first")
    fill(disk, but=0)
    with pytest.raises(OSError, match="No space left"):
        append_line(disk / "lines", "x" * 10_000)
    assert (disk / "lines").read_text() == "first\n"


def test_files_are_replaced_all_or_none(tmp_path, monkeypatch):
    replace_all(tmp_path, {"a": b"1", "b": b"2"})
    write, written = Path.write_bytes, []

    def fills_up(path, data):
        written.append(path)
        return write(path, data) if len(written) == 1 else full_disk()

    monkeypatch.setattr(Path, "write_bytes", fills_up)
    with pytest.raises(OSError, match="No space left"):
        replace_all(tmp_path, {"a": b"3", "b": b"4"})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"a": b"1", "b": b"2"}


@pytest.mark.parametrize(("number", "words"), [
    (errno.ENOSPC, "free some space, or name another place"), (errno.EROFS, "name a place that is not read-only"),
    (errno.EACCES, "give yourself the permission to write there, or name a place where you may write")])
def test_the_front_door_tells_what_no_command_has_told(monkeypatch, capsys, number, words):
    def fail(**_more):
        raise OSError(number, os.strerror(number), "/tmp/\x1b[31m")

    monkeypatch.setattr(cli, "command_of", lambda app: fail)
    code, _, err = call(monkeypatch, capsys)
    assert code == 2
    assert err == f"saccade: /tmp/\\x1b[31m: {os.strerror(number)}: {words}\n"


def test_a_fault_of_ours_stays_a_fault(monkeypatch):
    def fail(**_more):
        raise OSError(errno.EBADF, os.strerror(errno.EBADF))

    monkeypatch.setattr(cli, "command_of", lambda app: fail)
    with pytest.raises(OSError, match="Bad file descriptor"):
        cli.main()
