"""The soak says by its exit code whether anything was lost."""

from __future__ import annotations

import json
import sys
from types import SimpleNamespace

import pytest

from saccade.benchmarks import soak

WHOLE = {"episodes": 6, "messages": 900, "killed: belief": 2} | dict.fromkeys(soak.FAULTS, 0)


@pytest.fixture
def one_run(tmp_path, monkeypatch):
    """A soak of one run in which so much is counted; what it writes."""
    def run(counted):
        out = tmp_path / "out.json"
        monkeypatch.setattr(sys, "argv", ["soak", "1", str(out)])
        monkeypatch.setattr(soak, "time", SimpleNamespace(monotonic=iter([0.0, 0.0, 100.0]).__next__))
        monkeypatch.setattr(soak, "soak", lambda seed, folder, counts, rng: counts.update(counted))
        try:
            soak.main()
        finally:
            assert json.loads(out.read_text()) == counted
    return run


def test_where_nothing_was_lost_all_is_well(one_run):
    one_run(WHOLE)


@pytest.mark.parametrize("fault", ["lost episodes", "lost messages", "messages said twice", "runs with other actions"])
def test_what_was_lost_is_an_exit_code(one_run, fault):
    with pytest.raises(SystemExit, match=f"^saccade: .*{fault}: 3"):
        one_run(WHOLE | {fault: 3})
