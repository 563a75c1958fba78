"""The agent's own constants: the numbers of belief and planner that say in a comment where they are from, and those of
their configuration."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from saccade.shared.config import PACKAGE, BeliefConfig, PlannerConfig, Section

MODULES = ("services.belief.core", "services.belief.pose", "services.belief.position", "services.planner.core",
           "services.planner.free_energy")
SECTIONS: dict[str, type[Section]] = {"belief": BeliefConfig, "planner": PlannerConfig}
KINDS = ("chosen", "derived", "measured", "from the")  # what a constant's comment begins with
SHOWN = ("planner.step_m", "belief.published_particles")  # the paper's, and one that only the viewer sees
PROBABILITIES = {"BORN_VAGUE", "SURE", "DETECTED", "USED_VIEW", "belief.present_above", "planner.goal_confidence",
                 "belief.resample_below", "belief.view_worth", "belief.missed_weight"}


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
                told = comment.strip().startswith(KINDS)
                if told and isinstance(name, ast.Name) and isinstance(value, int | float):
                    yield Constant(module, name.id, value, comment.strip())
    for section, model in SECTIONS.items():
        for key, field in model.model_fields.items():
            if type(field.default) in (int, float) and f"{section}.{key}" not in SHOWN:
                yield Constant(section, key, field.default, field.description or "")
