"""`python -m saccade.benchmarks.constants [out.json]` measures what the agent's own constants are worth.

Each constant of belief and planner, and each number of their configuration, is set to half and to twice its value, on
the 100 development scenes. A probability is set to at most 0.99. What `out.json` holds already is not measured again.
"""

from __future__ import annotations

import json
import math
import sys
from importlib import import_module
from pathlib import Path
from statistics import fmean, median, stdev
from typing import Any

from saccade.app.bench.bench import RUN, prepare, record_of
from saccade.app.constants import SECTIONS, Constant, constants
from saccade.app.run.registry import local_pairs
from saccade.shared.bus.messages import Message, Result
from saccade.shared.bus.topics import Topic
from saccade.shared.config import Config
from saccade.shared.log.provenance import commit
from saccade.shared.loop.local import run_local

SCENES = 100
DEPENDENT = {"USED_VIEW": "HALF_VIEW_TANGENT"}  # a constant, and one that is computed from it


def measure(constant: Constant | None, factor: float) -> list[dict[str, Any]]:
    """Returns the records of the development scenes with one constant multiplied by `factor`."""
    values = {} if constant is None or constant.where not in SECTIONS else {constant.label: constant.changed(factor)}
    config = Config().with_values({"scene.objects": "ycb", **values})
    plan = prepare("sceneccn", config, Path("bench") / "constants.json", suite="dev", limit=SCENES)
    records: list[dict[str, Any]] = []

    def hear(_topic: Topic, _part: str | None, message: Message, _payload: bytes | None) -> None:
        if isinstance(message, Result):
            records.append(record_of(message))

    with _changed(constant, factor):
        pairs = local_pairs("sceneccn", plan.config)
        run_local(pairs, plan.config.names, RUN, plan.chosen, hear)
    return records


class _changed:
    """Within this context a module's constant has another value."""

    def __init__(self, constant: Constant | None, factor: float) -> None:
        self._values: dict[str, float] = {}
        if constant is None or constant.where in SECTIONS:
            return
        self._module = import_module(f"saccade.{constant.where}")
        self._values[constant.name] = constant.changed(factor)
        if dependent := DEPENDENT.get(constant.name):
            share = self._values[constant.name] / constant.value
            self._values[dependent] = getattr(self._module, dependent) * share

    def __enter__(self) -> None:
        self._before = {name: getattr(self._module, name) for name in self._values}
        for name, value in self._values.items():
            setattr(self._module, name, value)

    def __exit__(self, *_: object) -> None:
        for name, value in self._before.items():
            setattr(self._module, name, value)


def told(records: list[dict[str, Any]], default: list[dict[str, Any]]) -> dict[str, Any]:
    """Summarises what a change does, compared with the default's records of the same scenes."""
    more = [a["steps"] - b["steps"] for a, b in zip(records, default, strict=True)]
    return {"reached": sum(r["success"] for r in records), "median_steps": median(r["steps"] for r in records),
            "mean_steps": round(fmean(r["steps"] for r in records), 2), "more_steps": round(fmean(more), 2),
            "more_steps_error": round(stdev(more) / math.sqrt(len(more)), 2)}


def main(out: Path) -> None:
    """Measures what `out` does not hold yet."""
    state: dict[str, Any] = json.loads(out.read_text()) if out.is_file() else {"commit": commit(), "scenes": SCENES}
    if "default" not in state:
        state["default"] = measure(None, 1.0)
    state.setdefault("constants", {})
    for constant in constants():
        entry = state["constants"].setdefault(constant.label, {"value": constant.value})
        for name, factor in (("half", 0.5), ("twice", 2.0)):
            if name not in entry and constant.changed(factor) != constant.value:
                records = measure(constant, factor)
                entry[name] = {"value": constant.changed(factor), **told(records, state["default"])}
                print(constant.label, name, entry[name], flush=True)
                out.parent.mkdir(parents=True, exist_ok=True)
                out.write_text(json.dumps(state, indent=1) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "results/benchmarks/constants.json"))
