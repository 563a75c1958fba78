"""The agent's own constants. They are the numbers of belief and planner whose comment says where they come from, and
the numbers in the configuration of belief and planner."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from saccade.shared.config import PACKAGE, BeliefConfig, PlannerConfig, Section

MODULES = ("services.belief.core", "services.belief.instance", "services.belief.association",
           "services.belief.motion", "services.belief.pose", "services.belief.position", "services.belief.attitude",
           "services.planner.core", "services.planner.arrival", "services.planner.candidates", "services.planner.place",
           "services.planner.free_energy", "services.planner.moving", "services.planner.instances")
SECTIONS: dict[str, type[Section]] = {"belief": BeliefConfig, "planner": PlannerConfig}
KINDS = ("chosen", "derived", "measured", "from the")  # a constant's comment begins with one of these
# These are not listed: one is a number of the paper, the other is for the viewer only
SHOWN = ("planner.step_m", "belief.published_particles")
PROBABILITIES = {"PRESENT", "BORN_VAGUE", "SURE", "DETECTED", "USED_VIEW", "UPRIGHT", "SEEN", "RATE",
                 "LEAST_OUTLIER", "OVERLOOKED", "TOLD", "ELSEWHERE", "belief.present_above",
                 "planner.goal_confidence", "belief.resample_below", "belief.view_worth", "belief.missed_weight"}


@dataclass(frozen=True)
class Constant:
    """One constant. `where` is a module of this package, or a section of the configuration. `comment` says where the
    number comes from or what it means."""

    where: str
    name: str
    value: float
    comment: str

    @property
    def label(self) -> str:
        """The name of the constant in the results."""
        return f"{self.where}.{self.name}"

    def changed(self, factor: float) -> float:
        """Returns the value times `factor`. An integer stays an integer of at least 1. A probability stays at most
        0.99."""
        value = self.value * factor
        if self.name in PROBABILITIES or self.label in PROBABILITIES:
            value = min(value, 0.99)
        return max(1, round(value)) if isinstance(self.value, int) else value


def constants() -> Iterator[Constant]:
    """Yields all constants in the order of the source: first those of the modules, then those of the configuration."""
    for module in MODULES:
        source = (PACKAGE / Path(*module.split("."))).with_suffix(".py").read_text()
        lines = source.splitlines()
        for node in ast.parse(source).body:
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant):
                _, _, comment = lines[node.lineno - 1].partition("#")
                name, value = node.targets[0], node.value.value
                told = comment.strip().startswith(KINDS)
                if told and isinstance(name, ast.Name) and isinstance(value, int | float):
                    yield Constant(module, name.id, value, comment.strip())
    for section, model in SECTIONS.items():
        for key, field in model.model_fields.items():
            if type(field.default) in (int, float) and f"{section}.{key}" not in SHOWN:
                yield Constant(section, key, field.default, field.description or "")
