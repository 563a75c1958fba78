"""Measures several ways of doing the same in turn, round after round, because the load of a machine changes by the
minute."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.table import Table

Found = dict[str, list[float]]


def in_turn(ways: Mapping[str, Callable[[], float]], rounds: int) -> Found:
    """Returns what each way measured, by rounds. The order changes, so that no way is always the first or always
    follows the same other. If the command line names a file, the numbers so far are written there."""
    names = list(ways)
    found: Found = {name: [] for name in names}
    for number in range(rounds):
        first = number // 2 % len(names)
        order = names[first:] + names[:first]
        for name in order[::-1] if number % 2 else order:
            found[name].append(ways[name]())
        if len(sys.argv) > 1:
            Path(sys.argv[1]).write_text(json.dumps(found, indent=1) + "\n")
    return found


def ratio(values: Sequence[float], to: Sequence[float]) -> str:
    """The mean of the rounds' ratios, with its 95 % interval."""
    ratios = np.divide(values, to)
    return f"{ratios.mean():.3f} ± {1.96 * ratios.std(ddof=1) / np.sqrt(len(ratios)):.3f}"


def compared(found: Found, what: str, against: Sequence[str]) -> Table:
    """Returns a table with the median steps per second of each way, and the ratios to the ways in `against`."""
    table = Table(what, "steps per s", *(f"of {name}" for name in against))
    for name, values in found.items():
        table.add_row(name, f"{np.median(values):.2f}",
                      *("1" if name == other else ratio(values, found[other]) for other in against))
    return table
