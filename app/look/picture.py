"""Draws a run as one picture, from its log: the goal, the last view, the table from above with the beliefs, and the
free energy."""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from saccade.app.palette import COLOURS
from saccade.shared.bus.messages import Belief, Frame, Goal, Message, Plan, Result, Truth
from saccade.shared.bus.topics import BELIEF, FRAME, GOAL, PLAN, RESULT, TRUTH
from saccade.shared.config import recorded
from saccade.shared.errors import SaccadeError
from saccade.shared.files import replace_whole, writing
from saccade.shared.log.folder import LOG_NAME, PICTURE_NAME
from saccade.shared.log.reading import RunReader
from saccade.shared.render.world import TABLE_SIDE_M

INCHES, DPI = (21.0, 5.2), 100
SHOWN_M = 0.62  # half the side of the view from above, which shows the table and the camera's workspace
PRESENT_ABOVE = 0.5
F_TERMS = {"f_identity": "#264653", "f_position": "#2a9d8f", "f_crop": "#8ab17d", "f_pose": "#bcb8b1",
           "f_likelihood": "#e0ddd6"}  # in other colours than the objects'
TOLD = (GOAL, FRAME, BELIEF, TRUTH, PLAN, RESULT)


@dataclass
class Story:
    """What the messages of one episode tell. Images are arrays [H, W, 3]. `ways` holds the camera's position [3] at
    each step, in metres. `energies` holds the terms of F at each step, summed over the objects [5], in nats."""

    episode: int
    goal_rgb: NDArray[np.uint8] | None = None
    goal_is_known: bool = False  # whether the truth has the goal's view: not if the user gave the image
    last_rgb: NDArray[np.uint8] | None = None
    last_step: int = 0  # the step of `last_rgb`; no frame follows the last move
    ways: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    beliefs: dict[str, Belief] = field(default_factory=dict)
    energies: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    truth: Truth | None = None
    plan: Plan | None = None
    result: Result | None = None

    @property
    def path_m(self) -> list[NDArray[np.float64]]:
        """The camera's positions [3] in the order of the steps, in metres."""
        return [self.ways[step] for step in sorted(self.ways)]

    def take(self, part: str | None, message: Message) -> None:
        """Stores what a message of this episode says."""
        if isinstance(message, Goal):
            self.goal_rgb = message.rgb
        elif isinstance(message, Frame):
            self.last_rgb, self.last_step = message.rgb, message.step
        elif isinstance(message, Belief) and part is not None:
            self.beliefs[part] = message
            terms = np.array([sum(getattr(each, name) for each in message.each()) for name in F_TERMS])
            self.energies[message.step] = self.energies.get(message.step, 0.0) + terms
        elif isinstance(message, Truth):
            self.truth = message
        elif isinstance(message, Plan):
            self.plan = message
        elif isinstance(message, Result):
            self.result = message
        if isinstance(message, Frame | Truth):  # the last step has no frame, and a real camera has no truth
            self.ways[message.step] = message.world_from_camera[:3, 3]


def read_story(log: Path, episode: int | None = None) -> Story:
    """Reads one episode of a log, by default the last one. Raises SaccadeError if the log has no frame of it."""
    story = Story(-1 if episode is None else episode)
    reader = RunReader(log)
    for topic, part, message in reader:
        if topic not in TOLD:
            continue
        if episode is None and message.episode > story.episode:
            story = Story(message.episode)
        if message.episode == story.episode:
            story.take(part, message)
    if story.last_rgb is None:
        which = "no episode" if episode is None else f"nothing of episode {episode}"
        raise SaccadeError(f"log {log} has {which} in it: draw a log that holds frames")
    story.goal_is_known = story.truth is not None and story.goal_rgb is not None and not _goal_from_elsewhere(reader)
    return story


def _goal_from_elsewhere(reader: RunReader) -> bool:
    """Whether the user gave the goal image."""
    return recorded(reader.configuration, f"the log {reader.path}").scene.goal_image is not None


def draw(log: Path, out: Path, episode: int | None = None) -> Story:
    """Draws an episode of a log as a PNG file, and returns what the picture shows. Raises SaccadeError if the log has
    no frame of the episode."""
    story = read_story(log, episode)
    draw_story(story, out)
    return story


def draw_run(folder: Path) -> Path:
    """Draws the last episode of a run and writes the picture beside its log. Returns the path of the picture."""
    draw(folder / LOG_NAME, folder / PICTURE_NAME)
    return folder / PICTURE_NAME


def draw_story(story: Story, out: Path, *, dpi: int = DPI) -> None:
    """Draws an episode as a PNG file: the goal, the last view, the table from above, and the free energy."""
    figure = new_figure(INCHES, dpi)
    goal, view, above, energy = figure.subplots(1, 4, width_ratios=(1, 1, 1.35, 1))
    image(goal, story.goal_rgb, "goal" if story.goal_rgb is not None else "no goal: exploring")
    image(view, story.last_rgb, f"last view (step {story.last_step})")
    _from_above(above, story)
    _free_energy(energy, story)
    figure.suptitle(_title(story))
    save(figure, out)


def new_figure(inches: tuple[float, float], dpi: int = DPI) -> Figure:
    """Makes a figure that needs no screen."""
    figure = Figure(figsize=inches, dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, out: Path) -> None:
    """Writes a figure. The same figure gives the same bytes. Raises SaccadeError if the file cannot be written."""
    drawn = io.BytesIO()
    try:
        figure.savefig(drawn, format=out.suffix[1:].lower() or "png", metadata={"Software": None})
    except ValueError as error:
        raise SaccadeError(f"picture {out} cannot be written ({error}): let its name end in .png") from error
    with writing(out, "picture"):
        replace_whole(out, drawn.getvalue())


def image(axes: Axes, rgb: NDArray[np.uint8] | None, title: str) -> None:
    """Shows an image without axes. Without an image its place stays empty."""
    axes.set_title(title)
    axes.axis("off")
    if rgb is not None:
        axes.imshow(rgb)


def _from_above(axes: Axes, story: Story) -> None:
    table_from_above(axes, "the table from above")
    particles(axes, {name: b for name, b in story.beliefs.items() if b.presence > PRESENT_ABOVE}, story.beliefs)
    if story.truth is not None:
        axes.plot(*story.truth.centers_m[:, :2].T, "o", color="black", fillstyle="none", markersize=13,
                  label="true position", linestyle="none", zorder=4)
        if story.goal_is_known:
            axes.plot(*story.truth.goal_world_from_camera[:2, 3], "*", color="black", markersize=13,
                      label="goal's view", linestyle="none", zorder=4)
    way(axes, np.array(story.path_m))
    if (reach := 1.05 * float(np.abs(np.array(story.path_m)[:, :2]).max())) > SHOWN_M:  # a real camera may move further
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
    axes.legend(loc="center left", bbox_to_anchor=(1.02, 0.5), fontsize=8, frameon=False)


def _free_energy(axes: Axes, story: Story) -> None:
    """Plots F of all objects at each step, by term."""
    axes.set(title="free energy of all objects", xlabel="step", ylabel="F (nats)")
    if story.energies:
        steps = sorted(story.energies)
        terms = np.array([story.energies[step] for step in steps]).T
        labels = [name.removeprefix("f_") for name in F_TERMS]
        axes.stackplot(steps, terms, labels=labels, colors=list(F_TERMS.values()))
        axes.legend(fontsize=8, frameon=False)


def table_from_above(axes: Axes, title: str) -> None:
    """Draws the empty table, with x to the right and y up."""
    half = TABLE_SIDE_M / 2
    axes.fill([-half, half, half, -half], [-half, -half, half, half], color="#efeae2", zorder=0)
    axes.set(xlim=(-SHOWN_M, SHOWN_M), ylim=(-SHOWN_M, SHOWN_M), aspect="equal", xlabel="x (m)", ylabel="y (m)",
             title=title)


def particles(axes: Axes, beliefs: dict[str, Belief], names: Iterable[str]) -> None:
    """Draws where objects are believed to be, and the numbers of several of a kind. Each of `names` has its own colour,
    whichever of them are drawn."""
    for name, colour in colours(names).items():
        for belief in beliefs[name].each() if name in beliefs else []:
            if belief is not beliefs[name] and belief.presence < 0.5:
                continue
            x_m, y_m = belief.particles_m[:, :2].T
            axes.scatter(x_m, y_m, s=4, color=colour, alpha=0.35, linewidths=0, zorder=2)
            axes.plot(*belief.mean_m[:2], "o", color=colour, markersize=7, zorder=3,
                      label=name if belief is beliefs[name] else None)
            if beliefs[name].further:
                x, y, _ = map(float, belief.mean_m)
                axes.annotate(str(belief.instance), (x, y), fontsize=8, zorder=4)


def colours(names: Iterable[str]) -> dict[str, str]:
    """Gives each object a colour."""
    return dict(zip(sorted(names), cycle(COLOURS), strict=False))


def way(axes: Axes, path_m: NDArray[np.float64]) -> None:
    """Draws the camera's path [K, 3] (metres) and its present position."""
    axes.plot(*path_m[:, :2].T, "-", color="#555555", linewidth=1.5, label="camera's path", zorder=1)
    axes.plot(*path_m[-1, :2], "s", color="#555555", markersize=7, zorder=3)


def _title(story: Story) -> str:
    if story.truth is None:
        return f"a real camera: {len(story.path_m)} views"
    if story.result is None:
        return f"episode {story.episode}: cut short after {len(story.path_m)} views"
    result = story.result
    if story.goal_rgb is None:
        return f"{result.scene}: explored for {result.steps} steps"
    how = "reached" if result.success else "said to be reached" if result.declared else "not reached"
    return f"{result.scene}: goal {how} after {result.steps} steps"
