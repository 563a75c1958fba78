"""The pictures of a report: plots of the results files, and pictures of episodes that are run again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from saccade.app.bench.repeat import Again, Results, replay
from saccade.app.bench.table import MEASURES, Estimate, Record, wilson
from saccade.app.look.picture import Story, image, new_figure, particles, save, table_from_above, way
from saccade.app.palette import COLOURS
from saccade.shared.bus.messages import Belief, Message
from saccade.shared.bus.topics import Topic
from saccade.shared.world.task import MAX_STEPS, SUCCESS_ROTATION_RAD, SUCCESS_TRANSLATION_M

VIEWS = (1, 5, 10, 20, 40)  # the belief is drawn after so many views
CASES = 3  # number of worst cases, and of cases from the middle


def draw_errors(files: Sequence[Results], out: Path) -> None:
    """Draws box plots of the three errors. The whiskers reach to 1.5 interquartile ranges."""
    figure = new_figure((12.0, 1.6 + 0.5 * len(files)))
    for k, (axes, (key, title)) in enumerate(zip(figure.subplots(1, 3), MEASURES.items(), strict=True)):
        values = [[r[key] for r in file.records] for file in files]
        boxes = axes.boxplot(values, orientation="horizontal", patch_artist=True, showmeans=True, widths=0.6,
                             flierprops={"markersize": 2}, medianprops={"color": "black"})
        for box, colour in zip(boxes["boxes"], _colours(files), strict=True):
            box.set_facecolor(colour)
        axes.set_yticks(range(1, len(files) + 1), [file.label for file in files] if k == 0 else [""] * len(files))
        axes.set(xlabel=f"error in {title}", xlim=(0, None))
        axes.invert_yaxis()
    save(figure, out)


def draw_objects(files: Sequence[Results], out: Path) -> None:
    """Plots the share of successes against the number of objects on the table, with Wilson's 95 % intervals."""
    figure = new_figure((7.0, 4.5))
    axes = figure.subplots()
    for k, (file, colour) in enumerate(zip(files, _colours(files), strict=True)):
        counts = sorted({r["objects"] for r in file.records})
        groups = [[r["success"] for r in file.records if r["objects"] == count] for count in counts]
        shares = [wilson(sum(group), len(group)) for group in groups]
        places = np.array(counts) + 0.06 * (k - (len(files) - 1) / 2)
        _draw_shares(axes, places, shares, colour, file.label)
    axes.set(xlabel="objects on the table", ylabel="success (%)", ylim=(0, 104))
    locator = axes.xaxis.get_major_locator()
    assert isinstance(locator, MaxNLocator)  # every linear axis has one
    locator.set_params(integer=True)
    _legend(figure)
    save(figure, out)


def _draw_shares(axes: Axes, places: ArrayLike, shares: Sequence[Estimate], colour: str, label: str) -> None:
    """Draws shares (%) with their intervals at places along x."""
    bars = [[100 * (s.value - s.low) for s in shares], [100 * (s.high - s.value) for s in shares]]
    axes.errorbar(places, [100 * s.value for s in shares], yerr=np.maximum(bars, 0.0), fmt="o-", capsize=3,
                  color=colour, label=label)


def draw_steps(files: Sequence[Results], out: Path) -> None:
    """Plots, against the number of steps, the share of all scenes in which the goal was reached within so many
    steps."""
    figure = new_figure((7.0, 4.5))
    axes = figure.subplots()
    for file, colour in zip(files, _colours(files), strict=True):
        last = file.facts["config"].get("simulator", {}).get("max_steps", MAX_STEPS)
        steps = sorted(r["steps"] for r in file.records if r["success"])
        shares = 100 * np.arange(len(steps) + 1) / len(file.records)
        axes.step([0, *steps, last], [*shares, shares[-1]], where="post", color=colour, label=file.label)
    axes.set(xlabel="steps", ylabel="goal reached (%)", xlim=(0, None), ylim=(0, 104))
    _legend(figure)
    save(figure, out)


def pick(records: Sequence[Record], count: int = CASES) -> tuple[list[Record], list[Record]]:
    """Returns the worst cases, worst first, and the cases in the middle. A failed case is worse than a successful one;
    among equals the larger errors are worse."""
    order = sorted(records, key=lambda r: (r["success"], -severity(r)))
    worst, start = order[:count], (len(order) - count) // 2
    return worst, [r for r in order[max(start, 0):][:count] if r not in worst]


def severity(record: Record) -> float:
    """Combines the three errors into one number. Each error is counted in units of the success tolerance."""
    angles = (record["azimuth_error_rad"] + record["elevation_error_rad"]) / SUCCESS_ROTATION_RAD
    return angles + record["range_error_m"] / SUCCESS_TRANSLATION_M


def draw_gallery(cases: Sequence[tuple[str, Story]], out: Path) -> None:
    """Draws a column for each (title, episode): the goal above the view that was reached."""
    figure = new_figure((2.9 * len(cases), 6.6))
    for axes, (title, story) in zip(figure.subplots(2, len(cases), squeeze=False).T, cases, strict=True):
        image(axes[0], story.goal_rgb, f"{title}\ngoal")
        reached = story.result is not None and story.result.success
        image(axes[1], story.last_rgb, f"{'reached' if reached else 'not reached'}\n"
                                       f"last view, step {story.last_step}")
        for each in axes:
            each.title.set_fontsize(9)
    save(figure, out)


def draw_final_views(stories: Mapping[str, Sequence[Story]], out: Path) -> None:
    """Draws a row of goals, and below it, for each agent, a row of the last views that it reached."""
    goals = next(iter(stories.values()))
    figure = new_figure((0.6 + 1.3 * len(goals), 1.5 * (1 + len(stories))))
    grid = figure.subplots(1 + len(stories), len(goals), squeeze=False)
    for axes, story in zip(grid[0], goals, strict=True):
        image(axes, story.goal_rgb, "")
    for row, reached in zip(grid[1:], stories.values(), strict=True):
        for axes, story in zip(row, reached, strict=True):
            success = story.result is not None and story.result.success
            image(axes, story.last_rgb, "reached" if success else "")
            axes.title.set_fontsize(7)
    for name, row in zip(("goal", *stories), grid, strict=True):
        row[0].text(-0.08, 0.5, name, transform=row[0].transAxes, rotation=90, fontsize=8, ha="right", va="center")
    save(figure, out)


def draw_learning(measured: Sequence[Mapping[str, float]], paper: tuple[float, float], out: Path) -> None:
    """Draws how LEXA learns, against the environment steps that it has lived through: the share of goals it reaches
    (%), with Wilson's 95 % intervals, and the median of how near it comes. `paper` is the paper's (steps, %)."""
    figure = new_figure((9.0, 3.6))
    share, nearest = figure.subplots(1, 2)
    steps = [row["environment_steps"] for row in measured]
    reached = [wilson(round(row["reached"] * row["goals"]), round(row["goals"])) for row in measured]
    _draw_shares(share, steps, reached, COLOURS[0], "ours, goals that it never learns from")
    share.plot(*paper, "*", color=COLOURS[1], markersize=10, label="the paper's")
    share.set(xlabel="environment steps", ylabel="goals reached (%)", xscale="log", ylim=(0, None))
    share.legend(fontsize=8)
    nearest.plot(steps, [row["nearest"] for row in measured], "o-", color=COLOURS[0])
    nearest.axhline(1.0, color="grey", linestyle=":")
    nearest.set(xlabel="environment steps", ylabel="nearest to the goal, median (tolerances)", ylim=(0, None))
    save(figure, out)


@dataclass
class Exploration:
    """An episode without a goal. `beliefs` holds what was believed about each object, by the number of views."""

    story: Story
    beliefs: dict[int, dict[str, Belief]] = field(default_factory=dict)


def explore(again: Again, views: Sequence[int] = VIEWS) -> Exploration | None:
    """Explores the first of the scenes with the most objects. Returns None if the agent keeps no belief."""
    config = again.config.with_values({"scene.explore": True, "simulator.max_steps": max(views)})
    number = max(range(len(again.scenes)), key=lambda k: (len(again.scenes[k].on_table), -k))
    kept: dict[int, dict[str, Belief]] = {}

    def take(_topic: Topic, part: str | None, message: Message) -> None:
        if isinstance(message, Belief) and part is not None and message.step + 1 in views:
            kept.setdefault(message.step + 1, {})[part] = message

    story = replay(again.results.agent, config.model_dump_json(), number, take)
    return Exploration(story, kept) if kept else None


def draw_exploration(found: Exploration, out: Path) -> None:
    """Draws the table from above after each number of views: particles in colour, true positions in black, and the
    camera's path."""
    figure = new_figure((3.3 * len(found.beliefs), 4.2))
    path, truth = np.array(found.story.path_m), found.story.truth
    assert truth is not None  # every episode that ran to its end has one
    for axes, (views, beliefs) in zip(np.atleast_1d(figure.subplots(1, len(found.beliefs))), found.beliefs.items(),
                                      strict=True):
        table_from_above(axes, f"after {views} view{'s' if views > 1 else ''}")
        particles(axes, beliefs, beliefs)
        axes.plot(*truth.centers_m[:, :2].T, "o", color="black", fillstyle="none", markersize=10, linestyle="none",
                  label="true position", zorder=4)
        way(axes, path[:views])
    _legend(figure, columns=4)
    save(figure, out)


def _colours(files: Sequence[Results]) -> list[str]:
    return [COLOURS[k % len(COLOURS)] for k in range(len(files))]


def _legend(figure: Figure, columns: int = 2) -> None:
    """Puts the legend below the axes, each entry once."""
    entries: Mapping = {label: handle for axes in figure.axes
                        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns, fontsize=8,
                  frameon=False)
