"""The soak says by its exit code whether anything was lost."""

from __future__ import annotations

import json
import random
import sys
from collections import Counter
from itertools import islice

import pytest

from saccade.benchmarks import soak

WHOLE = {"episodes": 6, "messages": 900, "killed: belief": 2} | dict.fromkeys(soak.FAULTS, 0)


@pytest.fixture
def one_run(tmp_path, monkeypatch):
    """A soak of one run in which so much is counted; what it writes."""
    def run(counted):
        out = tmp_path / "out.json"
        monkeypatch.setattr(sys, "argv", ["soak", "2", str(out)])
        monkeypatch.setattr(soak, "soak", lambda seed, folder, counts, rng, turn: counts.update(counted))
        try:
            soak.main()
        finally:
            assert json.loads(out.read_text())["counts"] == counted | {"runs": 1}
    return run


def test_where_nothing_was_lost_all_is_well(one_run):
    one_run(WHOLE)


@pytest.mark.parametrize("fault", ["lost episodes", "lost messages", "messages said twice", "runs with other actions"])
def test_what_was_lost_is_an_exit_code(one_run, fault):
    with pytest.raises(SystemExit, match=f"^saccade: .*{fault}: 3"):
        one_run(WHOLE | {fault: 3})


def test_every_process_has_its_turn_before_one_has_its_next():
    names = {process.name for process in soak.PROCESSES}
    rounds = list(islice(soak.victims(random.Random(3)), 5 * len(names)))
    assert all(set(rounds[n:n + len(names)]) == names for n in range(0, len(rounds), len(names)))


def test_what_was_counted_before_counts_on(tmp_path, monkeypatch):
    out, runs = tmp_path / "out.json", []
    out.write_text(json.dumps({"commit": "", "counts": Counter(WHOLE) | Counter({"killed: router": 5, "runs": 4})}))
    monkeypatch.setattr(sys, "argv", ["soak", "9", str(out)])

    def soaked(seed, folder, counts, rng, turn):
        runs.append(seed)
        counts["killed: router"] += 1

    monkeypatch.setattr(soak, "soak", soaked)
    soak.main()
    assert runs == [4, 5]
    assert json.loads(out.read_text())["counts"]["killed: router"] == 7


def test_a_short_soak_kills_and_loses_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(soak, "EPISODES", 3)
    counts, rng = Counter(), random.Random(1)
    soak.soak(1, tmp_path, counts, rng, soak.victims(rng))
    assert soak.killed(counts) >= 2
    assert {fault: counts[fault] for fault in soak.FAULTS} == dict.fromkeys(soak.FAULTS, 0)
    assert counts["messages"] > 100
