"""Files that are broken, huge or no files at all: one line says so, soon and in little memory."""

from __future__ import annotations

import io
import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from saccade.app import api
from saccade.app.bench.failures import _file_name
from saccade.app.bench.repeat import read_results
from saccade.app.bench.table import render
from saccade.app.cli.texts import parse_value
from saccade.app.look.echo import block
from saccade.app.look.hz import _table
from saccade.app.look.listen import Heard
from saccade.app.look.topics import registry
from saccade.app.run.display import Progress, line, panel, say
from saccade.shared import files
from saccade.shared.bus.messages import Belief, Plan, Status, Truth
from saccade.shared.bus.topics import BELIEF, PERCEPT, PLAN, STATUS, TRUTH
from saccade.shared.config import MAX_FILE_BYTES, Config, load, recorded
from saccade.shared.errors import LINE_LIMIT, SaccadeError, printable, told
from saccade.shared.files import opened, parse_json, parse_toml, read_text
from saccade.tests.front_door import call
from saccade.tests.hostile import MANY, complaint, full_disk, not_files, sparse, within_limits
from saccade.tests.samples import sample
from saccade.tests.test_bench import record
from saccade.tests.test_picture import write_log

# Texts from outside, as they are printed.

@pytest.mark.parametrize(("text", "shown"), [
    ("\x1b[31mred\n\x07", "\\x1b[31mred\\n\\x07"), ("\ud800", "\\ud800"), ("a\u202eb", "a\\u202eb"),
    ("\x9b1m", "\\x9b1m"), ("Käse ± 1 cm", "Käse ± 1 cm")])
def test_a_text_does_nothing_to_a_terminal(text, shown):
    assert printable(text) == shown
    assert str(SaccadeError(text)) == shown


def test_a_long_text_loses_its_middle():
    """What to do stands at the end of an error, and is still there."""
    text = str(SaccadeError("scene " + "x" * MANY + ": shorten it"))
    assert text.startswith("scene x")
    assert text.endswith("x: shorten it")
    assert len(text) <= LINE_LIMIT + 5
    assert len(printable("\x00" * MANY, 100)) <= 105


def test_a_value_is_told_in_short_however_deep_it_is():
    deep: list = []
    for _ in range(MANY):
        deep = [deep]
    assert len(told(deep)) < 100
    assert len(told("x" * MANY)) < 300
    while deep:  # its own end would go as deep
        deep = deep.pop()


HOSTILE = "\x1b[31m[/x]\r\x07\u202e" + "y" * 9999


def shown(*things) -> str:
    """What a terminal of no colours is given."""
    console = Console(file=io.StringIO(), width=200, color_system=None)
    for thing in things:
        console.print(thing)
    return console.file.getvalue()


def test_the_display_shows_names_and_notes_that_do_nothing():
    """Nor is anything in them markup, which would end the display."""
    progress = Progress()
    waiting = replace(sample(Status), service=HOSTILE, note=HOSTILE, state="failed", milliseconds=1.0)
    progress.take(STATUS, HOSTILE, waiting)
    before = shown(panel(progress))
    progress.take(TRUTH, None, replace(sample(Truth), scene=HOSTILE))
    progress.take(PLAN, None, replace(sample(Plan), target=HOSTILE, mode=HOSTILE))
    progress.take(BELIEF, HOSTILE, replace(sample(Belief), presence=0.9))
    text = before + shown(panel(progress))
    console = Console(file=io.StringIO(), width=200, color_system=None)
    say(console, line(progress))
    say(console, HOSTILE)
    text += console.file.getvalue()
    assert text.replace("\n", "").isprintable()
    assert text.count("\\x1b[31m[/x]") >= 6
    assert len(text) < 50_000


def test_a_table_of_results_shows_names_that_do_nothing():
    text = shown(render([record(target=HOSTILE[:100])], title=HOSTILE))
    assert text.replace("\n", "").isprintable()
    assert "[/x]" in text


def test_pictures_of_failures_stay_in_their_folder():
    """A scene's id need not be the name of a file."""
    assert _file_name("coffee_can-1-2100", 7) == "coffee_can-1-2100"
    for scene in ("../../a", "a/b", "/etc/passwd", ".", "..", "x" * 250, HOSTILE):
        assert _file_name(scene, 7) == "failed-7"


@pytest.mark.parametrize("text", [
    "[" * MANY, '{"results": 3}', "\0" * 99, '{"results": [{"scene": "a"}], "agent": 1}', "results of records"])
def test_results_that_are_none_are_refused(tmp_path, text):
    facts = {"agent": "a", "objects": "ycb", "config": {}, "weights": {}, "scenes": {}, "commit": "c", "machine": {}}
    if text == "results of records":
        text = json.dumps({**facts, "results": [record(scene=HOSTILE)]})
    (tmp_path / "r.json").write_text(text)
    assert f"results {tmp_path / 'r.json'} are not of `saccade bench`" in complaint(read_results, tmp_path / "r.json")


def test_tables_of_keys_show_names_that_do_nothing():
    """The last part of a key is anybody's."""
    text = shown(_table([(f"saccade/table/percept/{HOSTILE}", *"12345")]), registry(HOSTILE))
    assert text.replace("\n", "").isprintable()
    assert "[/x]" in text
    heard = Heard(PERCEPT, HOSTILE[:50], b"", 0)
    assert all(told.replace("\n", "").isprintable() for told in block(heard, HOSTILE[:50]))


# Files of any kind.

def test_only_regular_files_are_opened(tmp_path):
    for kind, path in not_files(tmp_path).items():
        assert f"it is {kind}, not a file" in complaint(read_text, path, "text", "give a file", 10)
    assert "cannot be read (embedded null byte)" in complaint(read_text, Path("a\0"), "text", "give a file", 10)
    assert "File name too long" in complaint(read_text, Path("a" * 300), "text", "give a file", 10)


def test_a_fifo_that_takes_the_place_of_a_file_is_refused(tmp_path, monkeypatch):
    """Between the look at it and its opening: it is opened without waiting, and looked at again."""
    file, fifo = tmp_path / "file", tmp_path / "fifo"
    file.touch()
    os.mkfifo(fifo)
    before = os.stat(file)
    monkeypatch.setattr(files.os, "stat", lambda path, **_: before)
    assert "it is a FIFO" in complaint(read_text, fifo, "text", "give a file", 10)


def test_a_large_file_is_refused_by_its_size(tmp_path):
    assert "is larger than 1 MiB: cut it" in complaint(read_text, sparse(tmp_path / "t", 2 ** 40), "text", "cut it",
                                                       2 ** 20)
    assert "is larger than 10 bytes" in complaint(read_text, Path("/proc/self/stat"), "text", "cut it", 10)


def test_reading_that_fails_is_told(tmp_path):
    (tmp_path / "t").write_text("x")
    with pytest.raises(SaccadeError, match=r"text .*t cannot be read \(Input/output error\): give another"), \
            opened(tmp_path / "t", "text", "give another", 10):
        raise OSError(5, os.strerror(5))


@pytest.mark.parametrize(("text", "words"), [
    ("[" * MANY, "nested deeper"), ('{"a":' * 200 + "1" + "}" * 200, "nested deeper"), ("\0" * 100, "Expecting value"),
    ('{"a": 1, "a": 2}', "key 'a' is there twice"), ("[" + "1," * 100 + "1]", "more than 50 values")])
def test_json_that_is_no_good_is_a_value_error(text, words):
    with pytest.raises(ValueError, match=words):
        parse_json(text, max_values=50 if "values" in words else MANY * 2)


@pytest.mark.parametrize("text", [
    "a = " + "[" * MANY, "a = " + "{a=" * 500, ".".join("a" * MANY) + " = 1", "[" + " . ".join(['"a"'] * MANY) + "]",
    "a = {" + ".".join(["'b'"] * MANY) + " = 1}"])
def test_toml_that_is_deep_is_a_value_error(text):
    with pytest.raises(ValueError, match=r"deeper than 64|more than 32 parts"):
        parse_toml(text)


def test_toml_with_dots_and_quotes_is_read():
    text = f"a.b.'c d' = [{'1.5, ' * 200}]\nt = '{'../' * 60}'\n"
    assert parse_toml(text)["a"]["b"]["c d"] == [1.5] * 200


# Configurations.

CONFIGURATIONS = {
    "deep.toml": b"a = " + b"[" * 10_000, "deep.json": b"[" * MANY, "dots.toml": b".".join([b"a"] * MANY) + b" = 1",
    "zeros.json": bytes(1000), "zeros.toml": bytes(1000), "latin.toml": b"run = '\xff'",
    "latin.json": b'{"run": "\xff"}', "list.json": b"[]", "huge.json": b'{"seed": 1e999}',
    "twice.json": b'{"seed": 1, "seed": 2}',
    "digits.json": b'{"seed": ' + b"9" * 5000 + b"}", "hex.toml": b"seed = 0x" + b"f" * MANY,
    "inf.toml": b"[belief]\njitter_m = inf", "weight.toml": b"planner.information_weight = 1e308",
    "particles.toml": b"belief.published_particles = 8193", "jitter.toml": b"belief.jitter_m = 1e308",
    "red.json": b'{"run": "\\u001b[31m"}', "half.json": b'{"run": "\\ud800"}',
    "key.json": b'{"\\ud800\\u001b": 1}', "zero.json": b'{"scene": {"file": "a\\u0000"}}',
    "long.json": b'{"scene": {"file": "' + b"a" * MANY + b'"}}', "scenes.toml": b"scene.count = 1000000000000",
    "unknown.toml": b"x" * MANY + b" = 1"}


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_a_bad_configuration_is_refused(tmp_path, name):
    (tmp_path / name).write_bytes(CONFIGURATIONS[name])
    assert str(tmp_path / name) in complaint(load, tmp_path / name)


def test_a_configuration_is_no_other_kind_of_file(tmp_path):
    assert "is larger than 1 MiB" in complaint(load, sparse(tmp_path / "c.toml", MAX_FILE_BYTES + 1))
    for path in (*not_files(tmp_path).values(), Path("a" * 5000), Path("a\0")):
        assert "cannot be read" in complaint(load, path)


def test_the_front_door_refuses_a_deep_configuration(monkeypatch, capsys, tmp_path):
    (tmp_path / "c.toml").write_bytes(CONFIGURATIONS["deep.toml"])
    code, _, err = call(monkeypatch, capsys, "run", "--config", tmp_path / "c.toml")
    assert (code, err.count("\n")) == (2, 1)
    assert "nested deeper" in err


def test_a_configuration_is_refused_in_little_memory_and_time(tmp_path):
    """A dotted key of 200 kB took 8 GB and a minute."""
    (tmp_path / "c.toml").write_bytes(CONFIGURATIONS["dots.toml"])
    code = ("import sys, pathlib\nfrom saccade.shared.config import SaccadeError, load\n"
            "try: load(pathlib.Path(sys.argv[1]))\nexcept SaccadeError as error: print(error)")
    assert "more than 32 parts" in within_limits(code, tmp_path / "c.toml")


def test_a_deep_value_of_an_option_is_a_text():
    assert parse_value("run=" + "[" * MANY)[1] == "[" * MANY


def test_a_configuration_that_is_not_written_leaves_the_old_one(tmp_path, monkeypatch):
    Config(seed=1).save(tmp_path / "config.json")
    monkeypatch.setattr(Path, "write_bytes", full_disk)
    assert "No space left on device" in complaint(Config(seed=2).save, tmp_path / "config.json")
    assert load(tmp_path / "config.json").seed == 1
    assert os.listdir(tmp_path) == ["config.json"]


BROKEN = {"zeros": "\0" * 1000, "no JSON": "seed = 1", "deep": "[" * MANY, "a list": "[]", "unknown": '{"a": 1}',
          "large": " " * (MAX_FILE_BYTES + 1)}


@pytest.mark.parametrize("text", BROKEN.values(), ids=BROKEN)
def test_a_broken_configuration_in_a_log_is_refused(tmp_path, text):
    assert "the log run.mcap" in complaint(recorded, text, "the log run.mcap")


@pytest.mark.parametrize("command", [("film", "out.gif"), ("picture",), ("view", "--save", "out.rrd"),
                                     ("replay", "--into", "belief", "--out", "out")])
def test_a_log_with_a_broken_configuration_is_refused(monkeypatch, capsys, tmp_path, command):
    monkeypatch.chdir(tmp_path)
    write_log(tmp_path / "run.mcap", configuration=BROKEN["zeros"])
    name, *others = command
    code, _, err = call(monkeypatch, capsys, name, "run.mcap", *others)
    assert code == 2
    assert err.splitlines()[-1].startswith("saccade: the configuration in the log run.mcap is damaged")
    assert os.listdir(tmp_path) == ["run.mcap"]


@pytest.mark.parametrize("text", [BROKEN["deep"], BROKEN["a list"]], ids=["deep", "a list"])
def test_a_log_with_a_broken_configuration_is_opened_and_exported(monkeypatch, capsys, tmp_path, text):
    """Its messages are good; who asks for the configuration is told."""
    write_log(tmp_path / "run.mcap", configuration=text)
    assert f"the log {tmp_path / 'run.mcap'}" in complaint(lambda: api.open(tmp_path / "run.mcap").config)
    code, out, _ = call(monkeypatch, capsys, "log", "export", tmp_path / "run.mcap", "--out", tmp_path / "out.mcap")
    assert code == 0
    assert "messages written" in out
