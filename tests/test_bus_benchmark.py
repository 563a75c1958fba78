"""The bus benchmark measures us and says who is missing; how long anything takes is not tested."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from saccade.benchmarks.bus.__main__ import NOT_INSTALLED, YARDSTICKS, measure, table
from saccade.benchmarks.bus.contenders import CONTENDERS, OURS
from saccade.benchmarks.bus.measure import KINDS, Plan
from saccade.benchmarks.bus.pyzmq import PyZmq
from saccade.shared.errors import SaccadeError

PLAN = Plan(rounds=1, messages=4, warmup=1, period_s=0.001)


class Absent(PyZmq):
    modules = ("no_module_of_this_name",)


class Broken(PyZmq):
    modules = ()

    def run(self, plan, folder):
        raise SaccadeError("does not run here")


@pytest.fixture(scope="module")
def results():
    return measure(PLAN, [CONTENDERS[OURS], Absent("absent", "ipc"), Broken("broken", "ipc")])


def test_every_kind_has_its_yardstick_and_ours(results):
    figures = [row for row in results["rows"] if "note" not in row]
    assert [(r["transport"], r["payload"]) for r in figures] == [(n, k) for k in KINDS for n in (YARDSTICKS[k], OURS)]
    for row in figures:
        assert row["messages"] == PLAN.rounds * PLAN.messages
        assert 0 < row["p50_ms"] <= row["p99_ms"]
        assert row["of_ours"] == pytest.approx(1) if row["transport"] == OURS else row["of_ours"] > 0


def test_who_is_missing_or_fails_is_in_the_table_with_the_reason(results):
    assert [r for r in results["rows"] if "note" in r] == [
        {"transport": "absent", "note": NOT_INSTALLED}, {"transport": "broken", "note": "does not run here"}]
    drawn = Console(file=io.StringIO(), width=200)
    drawn.print(table(results))
    text = drawn.file.getvalue()
    assert NOT_INSTALLED in text
    assert all(row["transport"] in text for row in results["rows"])
