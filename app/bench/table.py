"""The benchmark's table: what the paper reports (section 4.2), and our figures beside it. All functions are pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, quantiles, stdev
from typing import Any

from rich.table import Table
from rich.text import Text

from saccade.app.bench.noticing import WITHIN
from saccade.shared.errors import printable

Record = Mapping[str, Any]

Z_95 = 1.959963984540054  # quantile 0.975 of the standard normal distribution
MEASURES = {"azimuth_error_rad": "azimuth (rad)", "elevation_error_rad": "elevation (rad)",
            "range_error_m": "range (m)"}
TOTAL = "Total"


@dataclass(frozen=True)
class Figures:
    """One row of the paper's table: success in percent, and the mean errors in the order of MEASURES."""

    success_percent: float
    means: tuple[float, float, float]
    errors: tuple[float, float, float] | None = None  # standard errors, if the paper gives them


PAPER = {
    "002_master_chef_can": Figures(84.0, (0.491, 0.138, 0.042)),
    "003_cracker_box": Figures(66.0, (0.532, 0.290, 0.058)),
    "004_sugar_box": Figures(69.0, (0.508, 0.232, 0.058)),
    "005_tomato_soup_can": Figures(46.0, (0.896, 0.220, 0.120)),
    "006_mustard_bottle": Figures(80.0, (0.420, 0.275, 0.057)),
    TOTAL: Figures(69.0, (0.569, 0.231, 0.067), (0.034, 0.014, 0.004)),
}

PAPER_AGENTS = {  # all agents of the paper on its 500 scenes
    "PoseCNN (uses depth)": Figures(16.2, (1.277, 0.431, 0.186), (0.042, 0.015, 0.007)),
    "PoseCNN + Infogain": Figures(28.4, (1.119, 0.367, 0.150), (0.045, 0.015, 0.007)),
    "SceneCCN + AIF": PAPER[TOTAL],
}
PAPER_ROOM = {"PoseCNN": 17, "PoseCNN + Infogain": 30, "SceneCCN": 62, "LEXA (about 7 M steps)": 11}  # of 100 goals


@dataclass(frozen=True)
class Estimate:
    """A value with its 95 % interval. A mean also has a standard error, which is None for fewer than two samples."""

    value: float
    low: float
    high: float
    standard_error: float | None = None


@dataclass(frozen=True)
class Row:
    """The results of one target, or of all of them. Shares are fractions of all scenes; only `declared_true` is a
    fraction of the scenes in which the agent said that it had arrived. A false alarm is a scene in which it had not
    arrived when it first said so."""

    name: str
    scenes: int
    success: Estimate
    means: tuple[Estimate, ...]  # in the order of MEASURES
    median_steps: float
    middle_steps: tuple[float, float]  # the interquartile range
    declared: float
    declared_true: float | None
    false_alarms: float


def wilson(successes: int, trials: int) -> Estimate:
    """Share of successes with Wilson's score interval. Raises ValueError if there are no trials, or more successes than
    trials."""
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"{successes} successes of {trials} trials")
    share, square = successes / trials, Z_95 ** 2
    centre = (share + square / (2 * trials)) / (1 + square / trials)
    half = Z_95 / (1 + square / trials) * math.sqrt(share * (1 - share) / trials + square / (4 * trials ** 2))
    return Estimate(share, max(0.0, centre - half), min(1.0, centre + half))


def mean(values: Sequence[float]) -> Estimate:
    """Mean with its standard error and the normal 95 % interval. For a single value, error and interval are unknown."""
    value = fmean(values)
    if len(values) < 2:
        return Estimate(value, math.nan, math.nan)
    error = stdev(values) / math.sqrt(len(values))
    return Estimate(value, value - Z_95 * error, value + Z_95 * error, error)


def summarise(name: str, records: Sequence[Record]) -> Row:
    """Returns the row of some results (at least one)."""
    low, middle, high = quartiles([r["steps"] for r in records])
    declared = [r for r in records if r["declared"]]
    rightly = sum(r["declared_true"] for r in declared)
    return Row(name, len(records), wilson(sum(r["success"] for r in records), len(records)),
               tuple(mean([r[key] for r in records]) for key in MEASURES), middle, (low, high),
               len(declared) / len(records), rightly / len(declared) if declared else None,
               (len(declared) - rightly) / len(records))


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """First quartile, median and third quartile. A quartile that falls between two values is interpolated."""
    low, middle, high = quantiles([*values, *values] if len(values) == 1 else values, n=4, method="inclusive")
    return low, middle, high


def milliseconds(records: Sequence[Record]) -> dict[str, float]:
    """Mean milliseconds per step of each service, over all steps of these results. It is empty if none were
    measured."""
    measured = [r for r in records if r.get("milliseconds")]
    services = dict.fromkeys(service for r in measured for service in r["milliseconds"])
    sums = {s: [(r["milliseconds"][s] * r["steps"], r["steps"]) for r in measured if s in r["milliseconds"]]
            for s in services}
    return {s: sum(ms for ms, _ in parts) / max(1, sum(n for _, n in parts)) for s, parts in sums.items()}


def noticed_words(records: Sequence[Record]) -> str:
    """What the agent noticed of the events in these scenes, in one line. It is empty if it tells no events."""
    told = [r for r in records if "false_events" in r]
    if not told:
        return ""
    quiet = wilson(sum(not r["false_events"] for r in told), len(told))
    text = f"no event reported where there was none: in {_percent(quiet)} of {len(told)} scenes"
    if changes := sum(r["changes"] for r in told):
        share = wilson(sum(r["noticed"] for r in told), changes)
        text = f"noticed within {WITHIN} images: {_percent(share)} of {changes} changes; {text}"
    return text


def counted_words(records: Sequence[Record]) -> str:
    """How often the agent knew how many there are, in one line. It is empty where nothing is there twice."""
    told = [r for r in records if r.get("instances", 0) > 1]
    if not told:
        return ""
    right = wilson(sum(r["counted"] == r["instances"] for r in told), len(told))
    kinds = wilson(sum(r["kinds_counted"] for r in told), sum(r["kinds"] for r in told))
    return (f"number of the target's kind right at the end: {_percent(right)} of {len(told)} scenes; of any kind: "
            f"{_percent(kinds)} of {sum(r['kinds'] for r in told)}")


def _percent(share: Estimate) -> str:
    return f"{100 * share.value:.1f} % ({100 * share.low:.1f} to {100 * share.high:.1f})"


def rows(records: Sequence[Record]) -> list[Row]:
    """One row for each target, in the order of their first scenes, and the total."""
    targets = dict.fromkeys(r["target"] for r in records)
    parts = [summarise(name, [r for r in records if r["target"] == name]) for name in targets]
    return [*parts, summarise(TOTAL, records)]


def render(records: Sequence[Record], *, title: str) -> Table:
    """Makes the table for the terminal. A target has three lines: our figures, their 95 % intervals, and the paper's
    figures if it has any."""
    theirs = "paper" if any(r["target"] in PAPER for r in records) else "paper (YCB)"
    caption = "± is the standard error of the mean; 95 % intervals: Wilson for success, normal for means"
    caption += "; of the steps: interquartile range\ndeclared: the agent said that it was there; rightly: of those, "
    caption += "false: of all scenes"
    if spent := milliseconds(records):
        caption += "\nmilliseconds per step: " + ", ".join(f"{name} {ms:.1f}" for name, ms in spent.items())
    if events := noticed_words(records):
        caption += f"\nevents {events}"
    if counts := counted_words(records):
        caption += f"\n{counts}"
    table = Table(title=Text(printable(title), style="table.title"), caption=caption, show_lines=True)
    for header in ("target", "", "n"):
        table.add_column(header)
    for header in ("success (%)", *MEASURES.values(), "median steps", "declared"):
        table.add_column(header, justify="right")
    for row in rows(records):
        paper = PAPER.get(row.name)
        labels = "\n".join(["ours", "95 %", *([theirs] if paper else [])])
        rightly = "-" if row.declared_true is None else f"{100 * row.declared_true:.0f} %"
        declared = f"{100 * row.declared:.0f} %\nrightly {rightly}\nfalse {100 * row.false_alarms:.0f} %"
        steps = f"{row.median_steps:g}\n{row.middle_steps[0]:g} to {row.middle_steps[1]:g}"
        table.add_row(Text(printable(row.name)), labels, str(row.scenes), *_cells(row, paper), steps, declared,
                      style="bold" if row.name == TOTAL else "")
    return table


def _cells(row: Row, paper: Figures | None) -> list[str]:
    share = row.success
    cells = [[f"{100 * share.value:.1f}", f"{100 * share.low:.1f} to {100 * share.high:.1f}"]]
    for estimate in row.means:
        known = estimate.standard_error is not None
        cells.append([f"{estimate.value:.3f}" + (f" ± {estimate.standard_error:.3f}" if known else ""),
                      f"{estimate.low:.3f} to {estimate.high:.3f}" if known else "-"])
    if paper is not None:
        cells[0].append(f"{paper.success_percent:.1f}")
        for i, value in enumerate(paper.means):
            cells[i + 1].append(f"{value:.3f}" + (f" ± {paper.errors[i]:.3f}" if paper.errors else ""))
    return ["\n".join(cell) for cell in cells]
