"""Whether an agent knows how many of a kind there are, at the end of an episode."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from saccade.shared.bus.messages import Belief, Truth


class Counted(NamedTuple):
    """How many of the target's kind were there, how many the agent believes most likely, with which probability, and of
    how many of all kinds it has the number right."""

    instances: int
    counted: int
    count_probability: float
    kinds: int
    kinds_counted: int


def counted(truth: Truth, beliefs: Mapping[str, Belief]) -> Counted:
    """Compares the last beliefs about all kinds with the truth of the same image."""
    there = {name: truth.names.count(name) for name in beliefs}
    believed, probability = beliefs[truth.target].count()
    right = sum(belief.count()[0] == there[name] for name, belief in beliefs.items())
    return Counted(there[truth.target], believed, probability, len(beliefs), right)
