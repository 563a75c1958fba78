"""A wrong option, a wrong command or a wrong value of the configuration: one line in plain words."""

from __future__ import annotations

import pytest

from saccade.tests.front_door import call


@pytest.mark.parametrize(("arguments", "words"), [
    (("run", "--seed", "-1"), "--seed -1: give 0 or more"),
    (("run", "--seed", "x"), "--seed x: give a whole number"),
    (("run", "--objects", "apples"), "object set 'apples' is not there, or has no objects"),
    (("run", "--count", "0"), "--count 0: give 1 or more"),
    (("run", "--fast"), "No such option: --fast"),
    (("run", "--seed"), "Option '--seed' requires an argument: see `saccade"),
    (("walk",), "No such command 'walk': see `saccade --help`"),
    (("--slow",), "No such option: --slow: see `saccade --help`"),
    (("replay",), "RUN... is missing: see `saccade replay --help`"),
    (("replay", "r"), "--into is missing: see `saccade replay --help`"),
    (("run", "--set", "planner.step_m=far"), "give a number, not 'far'"),
    (("run", "--set", "scene.yaw=left"), "choose from 'random' or 'fixed', not 'left'"),
    (("run", "--set", "services.planner=1x"), "the name of a Python module, such as my_package.my_module, not '1x'"),
    (("run", "--set", "scene.names=3"), "give a list such as [1, 2], not 3"),
    (("run", "--set", "planner=3"), "give a section with keys, not 3"),
    (("run", "--set", "seed=-1"), "give 0 or more, not -1"),
    (("run", "--intrinsics", "1,2"), "configuration key 'camera.intrinsics_px.2' in the given values: it is missing"),
    (("run", "--config", "c.toml"), "'planner.stepm' in c.toml: there is no such key; the guide's page"),
])
def test_a_wrong_option_or_value_is_one_line_in_plain_words(monkeypatch, capsys, tmp_path, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "c.toml").write_text("[planner]\nstepm = 1\n")
    code, out, err = call(monkeypatch, capsys, *arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("saccade: ")
    assert words in err
