"""`python -m saccade.benchmarks.constants [out.json]`: what the agent's own constants are worth. Each constant of
belief and planner, and each number of their configuration, at half and at twice its value, on the 100 development
scenes. 
A probability is doubled to 0.99 at most. What is done already in `out.json` is not done again.
"""

from __future__ import annotations

import ast
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from statistics import fmean, median, stdev
from typing import Any

from saccade.app.bench.bench import RUN, prepare, record_of
from saccade.app.run.registry import local_pairs
from saccade.shared.bus.topics import RESULT
from saccade.shared.config import PACKAGE, BeliefConfig, Config, PlannerConfig
from saccade.shared.log.provenance import commit
from saccade.shared.loop.local import run_local

MODULES = ("services.belief.core", "services.belief.pose", "services.belief.position", "services.planner.core",
           "services.planner.free_energy")
SECTIONS = {"belief": BeliefConfig, "planner": PlannerConfig}
KINDS = ("chosen", "derived", "measured", "from the")  # what a constant's comment begins with
SHOWN = ("planner.step_m", "belief.published_particles")  # the paper's, and one that only the viewer sees
PROBABILITIES = {"BORN_VAGUE", "SURE", "DETECTED", "USED_VIEW", "belief.present_above", "planner.goal_confidence",
                 "belief.resample_below", "belief.view_worth", "belief.missed_weight"}
SCENES = 100
DEPENDENT = {"USED_VIEW": "HALF_VIEW_TANGENT"}  # a constant that is computed from another


@dataclass(frozen=True)
class Constant:
    """A number of the agent's own making. `where`: a module of this package, or the section of the configuration."""

    where: str
    name: str
    value: float
    comment: str

    @property
    def label(self) -> str:
        """Its name in the results."""
        return f"{self.where}.{self.name}"

    def changed(self, factor: float) -> float:
        """Half or twice the value, whole where it is a whole number, a probability where it is one."""
        value = self.value * factor
        if self.name in PROBABILITIES or self.label in PROBABILITIES:
            value = min(value, 0.99)
        return max(1, round(value)) if isinstance(self.value, int) else value


def constants() -> Iterator[Constant]:
    """All of them, in the order of the source: those whose comment says where the number is from, and the numbers of
    the configuration."""
    for module in MODULES:
        source = (PACKAGE / Path(*module.split("."))).with_suffix(".py").read_text()
        lines = source.splitlines()
        for node in ast.parse(source).body:
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant):
                _, _, comment = lines[node.lineno - 1].partition("#")
                name, value = node.targets[0], node.value.value
                if isinstance(name, ast.Name) and comment.strip().startswith(KINDS):
                    yield Constant(module, name.id, value, comment.strip())
    for section, model in SECTIONS.items():
        for name, field in model.model_fields.items():
            if type(field.default) in (int, float) and f"{section}.{name}" not in SHOWN:
                yield Constant(section, name, field.default, field.description or "")


def measure(constant: Constant | None, factor: float) -> list[dict[str, Any]]:
    """The records of the development scenes with one constant changed."""
    values = {} if constant is None or constant.where not in SECTIONS else {constant.label: constant.changed(factor)}
    config = Config().with_values({"scene.objects": "ycb", **values})
    plan = prepare("sceneccn", config, Path("bench") / "constants.json", suite="dev", limit=SCENES)
    records: list[dict[str, Any]] = []
    with _changed(constant, factor):
        pairs = local_pairs("sceneccn", plan.config)
        run_local(pairs, plan.config.names, RUN, plan.chosen,
                  lambda topic, part, message, payload: records.append(record_of(message)) if topic == RESULT else None)
    return records


class _changed:
    """Within it a module's constant has another value."""

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
    """What a change comes to, against the default's records of the same scenes."""
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
