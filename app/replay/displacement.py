"""Measures how far percepts, beliefs, plans and actions moved when a service was swapped: the inputs are the same, the
answers differ."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from saccade.app.palette import COLOURS
from saccade.shared.bus.messages import Belief, Message, Percept
from saccade.shared.bus.topics import Topic
from saccade.shared.world.geometry import viewing_grid

PRESENT_ABOVE = 0.5


def _pixel(old: Percept, new: Percept) -> float | None:
    if min(old.presence, new.presence) < PRESENT_ABOVE:
        return None
    return float(np.linalg.norm(new.pixel - old.pixel))


def _log_scale(old: Percept, new: Percept) -> float | None:
    if min(old.presence, new.presence) < PRESENT_ABOVE or min(old.scale, new.scale) <= 0:
        return None
    return abs(float(np.log(new.scale / old.scale)))


def _place(old: Belief, new: Belief) -> float | None:
    if min(old.presence, new.presence) < PRESENT_ABOVE:
        return None
    return 100 * float(np.linalg.norm(new.mean_m - old.mean_m))


def _goal_view(old: Belief, new: Belief) -> float | None:
    if old.goal_log_posterior is None or new.goal_log_posterior is None:
        return None
    cosine = _peak(old.goal_log_posterior) @ _peak(new.goal_log_posterior)
    return float(np.arccos(np.clip(cosine, -1, 1)))


def _peak(log_posterior: NDArray[np.float32]) -> NDArray[np.float64]:
    """The most likely viewing direction, as a unit vector [3]."""
    (elevations, azimuths), (e, a) = viewing_grid(), np.unravel_index(np.argmax(log_posterior), log_posterior.shape)
    elevation, azimuth = elevations[e], azimuths[a]
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


# What is measured, by topic, with its unit. A value is None if one of the two messages has nothing to measure.
MEASURES: dict[str, dict[str, Callable[[Any, Any], float | None]]] = {
    "percept": {"presence": lambda old, new: abs(new.presence - old.presence), "pixel (px)": _pixel,
                "log scale": _log_scale},
    "belief": {"presence": lambda old, new: abs(new.presence - old.presence), "position (cm)": _place,
               "goal view (rad)": _goal_view, "F (nats)": lambda old, new: abs(new.free_energy - old.free_energy)},
    "plan": {"viewpoint (cm)": lambda old, new: 100 * float(np.linalg.norm((new.viewpoint - old.viewpoint)[:3, 3])),
             "other target": lambda old, new: float(new.target != old.target)},
    "action": {"move (cm)": lambda old, new: 100 * float(np.linalg.norm(new.translation_m - old.translation_m)),
               "turn (rad)": lambda old, new: float(np.linalg.norm(new.rotation_rad - old.rotation_rad))},
}


class Moved:
    """Collects the measures over pairs of a recorded and a replayed message."""

    def __init__(self) -> None:
        self._found: dict[tuple[str, str], dict[str | None, list[tuple[int, int, float]]]] = defaultdict(
            lambda: defaultdict(list))

    def take(self, topic: Topic, part: str | None, recorded: Message, replayed: Message) -> None:
        """Measures one pair."""
        for name, measure in MEASURES.get(topic.name, {}).items():
            value = measure(recorded, replayed)
            if value is not None:
                self._found[topic.name, name][part].append((recorded.episode, recorded.step, value))

    def table(self) -> Table:
        """Returns a table with the median, the 90th percentile and the maximum of every measure, for each object."""
        table = Table("topic", "what", "of", "pairs", "median", "90 %", "largest")
        for (topic, name), parts in self._found.items():
            for part, values in sorted(parts.items(), key=str):
                numbers = np.array([value for _, _, value in values])
                table.add_row(topic, name, part or "", str(len(numbers)),
                              *(f"{x:.3g}" for x in (np.median(numbers), np.quantile(numbers, 0.9), numbers.max())))
            table.add_section()
        return table

    def draw(self, path: Path) -> None:
        """Plots every measure over the steps, with a line for each object. Episodes follow one another."""
        figure = Figure(figsize=(11, 1.7 * max(1, len(self._found)) + 0.6), layout="constrained")
        axes = np.atleast_1d(figure.subplots(max(1, len(self._found)), 1, sharex=True))
        steps = sorted({(e, s) for parts in self._found.values() for v in parts.values() for e, s, _ in v})
        places = {at: place for place, at in enumerate(steps)}
        for axis, ((topic, name), parts) in zip(axes, self._found.items(), strict=False):
            for (part, values), colour in zip(sorted(parts.items(), key=str), cycle(COLOURS), strict=False):
                axis.plot([places[e, s] for e, s, _ in values], [v for _, _, v in values], ".-", color=colour,
                          linewidth=1, markersize=3, label=part)
            axis.set_ylabel(f"{topic}\n{name}", fontsize=8)
            if None not in parts:
                axis.legend(fontsize=7, loc="upper right", ncols=5)
            for place in (places[at] for at in steps if at[1] == 0 and at[0]):
                axis.axvline(place - 0.5, color="0.8", linewidth=1)
        axes[0].set_title("replayed against recorded: how far each message moved", fontsize=10)
        axes[-1].set_xlabel("step")
        FigureCanvasAgg(figure).print_png(path)
