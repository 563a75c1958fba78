"""A run in one picture, from its log: the goal, the last view, and the table from above with what was believed."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from services.simulator.world import TABLE_SIDE_M
from shared.errors import SaccadeError
from shared.messages import Belief, Plan, Result, Truth
from shared.recording import RunReader
from shared.topics import BELIEF, FRAME, GOAL, PLAN, RESULT, TRUTH

COLOURS = ("#d1495b", "#00798c", "#edae49", "#7b2d8b", "#3a7d44", "#2e4057", "#f26419", "#66a182")
INCHES, DPI = (15.0, 5.2), 100
SHOWN_M = 0.62  # half the side of the view from above: the table and the camera's workspace
PRESENT_ABOVE = 0.5


@dataclass
class Story:
    """What a log says about one episode: images [H, W, 3], and the camera's positions [K, 3] in their order."""

    episode: int
    goal_rgb: NDArray[np.uint8] | None = None
    goal_is_known: bool = False  # that its view is the truth's, not that of an image from elsewhere
    last_rgb: NDArray[np.uint8] | None = None
    last_step: int = 0  # of `last_rgb`: the last move has no view of its own
    path_m: list[NDArray[np.float64]] = field(default_factory=list)
    beliefs: dict[str, Belief] = field(default_factory=dict)
    truth: Truth | None = None
    plan: Plan | None = None
    result: Result | None = None


def read_story(log: Path, episode: int | None = None) -> Story:
    """The last episode of a log, or the one that is asked for. Raises SaccadeError if the log has no frame of it."""
    story, ways = Story(-1 if episode is None else episode), {}
    reader = RunReader(log)
    for topic, part, message in reader:
        if topic not in (GOAL, FRAME, BELIEF, TRUTH, PLAN, RESULT):
            continue
        if episode is None and message.episode > story.episode:
            story, ways = Story(message.episode), {}
        if message.episode != story.episode:
            continue
        if topic == GOAL:
            story.goal_rgb = message.rgb
        elif topic == FRAME:
            story.last_rgb, story.last_step = message.rgb, message.step
        elif topic == BELIEF:
            story.beliefs[part] = message
        elif topic == TRUTH:
            story.truth = message
        elif topic == PLAN:
            story.plan = message
        else:
            story.result = message
        if topic in (FRAME, TRUTH):  # the last step has a truth and no frame; a real camera has frames and no truth
            ways[message.step] = message.world_from_camera[:3, 3]
    if story.last_rgb is None:
        which = "no episode" if episode is None else f"nothing of episode {episode}"
        raise SaccadeError(f"log {log} has {which} in it: draw a log that holds frames")
    story.path_m = [ways[step] for step in sorted(ways)]
    story.goal_is_known = story.truth is not None and story.goal_rgb is not None and not _goal_from_elsewhere(reader)
    return story


def _goal_from_elsewhere(reader: RunReader) -> bool:
    scene = json.loads(reader.configuration or "{}").get("scene", {})
    return scene.get("goal_image") is not None


def draw(log: Path, out: Path, episode: int | None = None) -> Story:
    """Writes the picture of an episode as PNG and returns what it shows."""
    story = read_story(log, episode)
    figure = Figure(figsize=INCHES, dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    goal, view, above = figure.subplots(1, 3)
    _image(goal, story.goal_rgb, "goal" if story.goal_rgb is not None else "no goal: exploring")
    _image(view, story.last_rgb, f"last view (step {story.last_step})")
    _from_above(above, story)
    figure.suptitle(_title(story))
    try:
        figure.savefig(out, metadata={"Software": None})
    except OSError as error:
        raise SaccadeError(f"picture {out} cannot be written: {error.strerror}") from error
    return story


def _image(axes: Axes, rgb: NDArray[np.uint8] | None, title: str) -> None:
    axes.set_title(title)
    axes.axis("off")
    if rgb is not None:
        axes.imshow(rgb)


def _from_above(axes: Axes, story: Story) -> None:
    half = TABLE_SIDE_M / 2
    axes.fill([-half, half, half, -half], [-half, -half, half, half], color="#efeae2", zorder=0)
    for colour, (name, belief) in zip(_colours(len(story.beliefs)), sorted(story.beliefs.items()), strict=True):
        if belief.presence <= PRESENT_ABOVE:
            continue
        axes.scatter(*belief.particles_m[:, :2].T, s=4, color=colour, alpha=0.35, linewidths=0, zorder=2)
        axes.plot(*belief.mean_m[:2], "o", color=colour, markersize=7, label=name, zorder=3)
    if story.truth is not None:
        axes.plot(*story.truth.centers_m[:, :2].T, "o", color="black", fillstyle="none", markersize=13,
                  label="true position", linestyle="none", zorder=4)
        if story.goal_is_known:
            axes.plot(*story.truth.goal_world_from_camera[:2, 3], "*", color="black", markersize=13,
                      label="goal's view", linestyle="none", zorder=4)
    path = np.array(story.path_m)
    axes.plot(*path[:, :2].T, "-", color="#555555", linewidth=1.5, label="camera's path", zorder=1)
    axes.plot(*path[-1, :2], "s", color="#555555", markersize=7, zorder=3)
    axes.set(xlim=(-SHOWN_M, SHOWN_M), ylim=(-SHOWN_M, SHOWN_M), aspect="equal", xlabel="x (m)", ylabel="y (m)",
             title="the table from above")
    axes.legend(loc="center left", bbox_to_anchor=(1.02, 0.5), fontsize=8, frameon=False)


def _colours(count: int) -> list[str]:
    return [COLOURS[i % len(COLOURS)] for i in range(count)]


def _title(story: Story) -> str:
    if story.result is None:
        return f"episode {story.episode}: cut short after {len(story.path_m)} views"
    result = story.result
    if story.goal_rgb is None:
        return f"{result.scene}: explored for {result.steps} steps"
    how = "reached" if result.success else "said to be reached" if result.declared else "not reached"
    return f"{result.scene}: goal {how} after {result.steps} steps"
