"""`saccade film` turns one episode of a log into a short film. Step by step it shows what the camera sees, where the
objects are believed to be, and which view is planned."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from rich.console import Console
from rich.progress import track

from saccade.app.log.source import log_of, whole
from saccade.app.look.picture import PRESENT_ABOVE, Story, colours, image, new_figure, particles, table_from_above, way
from saccade.services.viewer.curves import entropy_nats
from saccade.services.viewer.images import outline
from saccade.services.viewer.imagination import Imagination
from saccade.services.viewer.words import decision, ending, happened, plain
from saccade.shared.bus.messages import Belief, Events, Message, Percept, Plan, Result, Truth
from saccade.shared.bus.topics import FRAME, PERCEPT, Topic
from saccade.shared.config import Config, recorded
from saccade.shared.errors import SaccadeError
from saccade.shared.log.reading import RunReader
from saccade.shared.model.weights import Weights

INCHES, DPI = (12.8, 7.2), 100  # both sides must be an even number of pixels for H.264
GIF_DPI, GIF_COLOURS = 60, 96
EVENT_STEPS = 10  # for so many steps a film tells in words what was noticed
LAST_S = 2.0  # the last picture stays for so long
SUFFIXES = (".mp4", ".gif")

Picture = NDArray[np.uint8]
Write = Callable[[Picture, int], None]  # writes a picture for a number of frames


@dataclass
class Scene:
    """What the messages of an episode have told up to the present step."""

    story: Story
    percepts: dict[str, Percept] = field(default_factory=dict)  # of the present step
    seen: dict[str, Percept] = field(default_factory=dict)  # the last percept of each object that saw it
    believed_m: dict[int, float] = field(default_factory=dict)  # by step: the believed distance to the goal
    true_m: dict[int, float] = field(default_factory=dict)  # by step: the true distance
    # By object and step: entropy of the position, nats
    entropies: dict[str, dict[int, float]] = field(default_factory=dict)
    words: str = ""
    events: Events | None = None  # the last message in which something was noticed

    def take(self, topic: Topic, part: str | None, message: Message) -> None:
        """Stores what a message of this episode says."""
        if topic == FRAME:
            self.percepts = {}
        self.story.take(part, message)
        if isinstance(message, Percept) and topic == PERCEPT and part is not None:
            self.percepts[part] = message
            if message.presence > PRESENT_ABOVE:
                self.seen[part] = message
        elif isinstance(message, Belief) and part is not None:
            self.entropies.setdefault(part, {})[message.step] = entropy_nats(message)
        elif isinstance(message, Events) and message.objects:
            self.events = message
        elif isinstance(message, Plan):
            self.words = decision(message, self.story.beliefs.values())
            if message.believed_distance_m >= 0:
                self.believed_m[message.step] = message.believed_distance_m
        elif isinstance(message, Truth):
            apart = message.world_from_camera - message.goal_world_from_camera
            self.true_m[message.step] = float(np.linalg.norm(apart[:3, 3]))
        elif isinstance(message, Result):
            self.words = ending(message)


def film(log: Path, out: Path, *, episode: int | None, rate_hz: float, console: Console) -> None:
    """Writes one episode of a log as a film to `out`, `rate_hz` steps per second. Without `episode` it is the last one.
    Raises SaccadeError if `log` is not a log, if the episode is not in it, or if `out` is neither an .mp4 nor a .gif
    file."""
    if out.suffix.lower() not in SUFFIXES:
        raise SaccadeError(f"{out} cannot be a film: its name must end with {' or '.join(SUFFIXES)}")
    log = log_of(log)
    steps = steps_of(log)
    episode = max(steps, default=0) if episode is None else episode
    if episode not in steps:
        raise SaccadeError(f"log {log} has nothing of episode {episode} in it: film a log that holds frames")
    gif = out.suffix.lower() == ".gif"
    with whole(out) as partial, (_gif if gif else _mp4)(partial, rate_hz) as write:
        shots = track(scenes(log, episode), total=steps[episode], console=console, description="filming",
                      transient=True)
        shown: Picture | None = None
        for scene, imagination in shots:
            shown = picture_of(scene, imagination, GIF_DPI if gif else DPI)
            write(shown, 1)
        if shown is not None:
            write(shown, round(LAST_S * rate_hz))


def steps_of(log: Path) -> dict[int, int]:
    """Counts the frames of each episode of a log."""
    steps: dict[int, int] = {}
    for topic, _, message in RunReader(log):
        if topic == FRAME:
            steps[message.episode] = steps.get(message.episode, 0) + 1
    return steps


def scenes(log: Path, episode: int) -> Iterator[tuple[Scene, Imagination | None]]:
    """Yields the scene at the end of each step, and once more at the end of the episode. With it comes the object that
    draws the planned view, or None if the weights are missing."""
    reader, scene, imagination, begun = RunReader(log), Scene(Story(episode)), None, False
    for topic, part, message in reader:
        if not begun:
            config = recorded(reader.configuration, f"the log {log}")
            imagination, begun = imagination_of(config), True
            scene.story.goal_is_known = config.scene.goal_view_is_known
        if not topic.in_step or message.episode != episode:
            continue
        if topic == FRAME and scene.story.last_rgb is not None:
            yield scene, imagination
        scene.take(topic, part, message)
    yield scene, imagination


def imagination_of(config: Config) -> Imagination | None:
    """Returns the object that draws the planned view, or None if the weights are missing."""
    try:
        return Imagination(Weights(config.weights), config.names)
    except SaccadeError:
        return None


def picture_of(scene: Scene, imagination: Imagination | None, dpi: int) -> Picture:
    """Draws one frame of the film: an array [H, W, 3] of uint8."""
    figure, story = new_figure(INCHES, dpi), scene.story
    grid = figure.add_gridspec(3, 3, height_ratios=(1, 1, 0.9), width_ratios=(1.25, 1.25, 0.62))
    of_object = colours(story.beliefs)
    _camera(figure.add_subplot(grid[:2, 0]), scene, imagination, of_object)
    _table(figure.add_subplot(grid[:2, 1]), scene)
    image(figure.add_subplot(grid[0, 2]), story.goal_rgb, "goal" if story.goal_rgb is not None else "no goal")
    planned = None
    if imagination and story.plan:
        known = [each for belief in story.beliefs.values() for each in belief.each() if each.presence > PRESENT_ABOVE]
        planned = imagination.planned_view(story.plan.viewpoint, known, scene.seen)
    image(figure.add_subplot(grid[1, 2]), planned, "planned view, imagined")
    _curves(figure, grid, scene, of_object)
    figure.suptitle(f"step {story.last_step}    {scene.words}{_noticed(scene)}", x=0.02, ha="left", fontsize=13)
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)  # new_figure makes one
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])


def _noticed(scene: Scene) -> str:
    """What was noticed within the last steps, in words."""
    events = scene.events
    is_new = events is not None and scene.story.last_step < events.step + EVENT_STEPS
    return f"    noticed at step {events.step}: {', '.join(happened(events))}" if events and is_new else ""


def _camera(axes: Axes, scene: Scene, imagination: Imagination | None, of_object: dict[str, str]) -> None:
    """Draws what the camera sees. Each object in it gets its mask, its name, and the crop that its network looks at."""
    rgb = scene.story.last_rgb
    image(axes, rgb, "camera")
    if rgb is None:
        return
    for name, percept in ((name, one) for name, kind in scene.percepts.items() for one in kind.each()):
        if percept.presence <= PRESENT_ABOVE:
            continue
        colour, mask = of_object.get(name, "black"), percept.mask()
        if mask is not None:
            edges = outline(mask) * (rgb.shape[1] / len(mask))
            axes.add_collection(LineCollection(edges, colors=colour, linewidths=1.5))
        if imagination:
            ring = imagination.frame_of(percept)
            axes.plot(*ring.T, color=colour, linewidth=1, linestyle=":")
        u, v = percept.pixel
        axes.text(u, v, f"{plain(name)} {percept.presence:.2f}", color="white", fontsize=9, ha="center",
                  clip_on=True, bbox={"facecolor": colour, "edgecolor": "none", "pad": 2})
    axes.set(xlim=(0, rgb.shape[1]), ylim=(rgb.shape[0], 0))


def _table(axes: Axes, scene: Scene) -> None:
    """Draws the table from above: the particles, the path, the candidates and the chosen viewpoint."""
    story = scene.story
    table_from_above(axes, "belief, from above")
    particles(axes, {n: b for n, b in story.beliefs.items() if b.presence > PRESENT_ABOVE}, story.beliefs)
    if story.plan is not None:
        if story.plan.best_eyes_m is not None:
            x_m, y_m = story.plan.best_eyes_m[:, :2].T
            axes.scatter(x_m, y_m, c=story.plan.best_g, cmap="RdYlGn_r", s=8, alpha=0.7)
        axes.plot(*story.plan.viewpoint[:2, 3], "D", color="#e0a800", markersize=9, markeredgecolor="black",
                  label="chosen viewpoint")
    if story.truth is not None and story.goal_is_known:
        axes.plot(*story.truth.goal_world_from_camera[:2, 3], "*", color="black", markersize=13, label="goal's view",
                  linestyle="none")
    if scene.events is not None:
        axes.plot(*scene.events.positions_m[:, :2].T, "X", color="#d02020", markersize=10, markeredgecolor="white",
                  label=f"event at step {scene.events.step}", linestyle="none")
    way(axes, np.array(story.path_m))
    axes.set(xlabel="", ylabel="")
    axes.legend(loc="upper left", fontsize=7, framealpha=0.8)


def _curves(figure: Figure, grid, scene: Scene, of_object: dict[str, str]) -> None:
    distance, entropy = figure.add_subplot(grid[2, 0]), figure.add_subplot(grid[2, 1:])
    distance.set(title="distance to the goal (m)")
    for numbers, label, colour in ((scene.believed_m, "believed", "#e0a800"), (scene.true_m, "true", "black")):
        if numbers and (label == "believed" or scene.story.goal_is_known):
            distance.plot(list(numbers), list(numbers.values()), "-", color=colour, label=label)
            distance.legend(loc="upper right", fontsize=8, frameon=False)
    distance.set_ylim(bottom=0)
    entropy.set(title="entropy of each position (nats)")
    for name, numbers in sorted(scene.entropies.items()):
        entropy.plot(list(numbers), list(numbers.values()), color=of_object[name], label=plain(name))
    if scene.entropies:
        entropy.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)


@contextmanager
def _gif(path: Path, rate_hz: float) -> Iterator[Write]:
    frames: list[Image.Image] = []
    lasts_ms: list[int] = []

    def write(picture: Picture, count: int) -> None:
        frames.append(Image.fromarray(picture).quantize(GIF_COLOURS, dither=Image.Dither.NONE))
        lasts_ms.append(round(1000 * count / rate_hz))

    yield write
    first, *others = frames
    first.save(path, format="GIF", save_all=True, append_images=others, duration=lasts_ms, loop=0, optimize=True)


@contextmanager
def _mp4(path: Path, rate_hz: float) -> Iterator[Write]:
    try:
        import av
    except ImportError as error:
        raise SaccadeError("films as MP4 need the package av: pip install 'saccade[film]', or name a .gif") from error
    from fractions import Fraction

    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=Fraction(rate_hz).limit_denominator(1000))
        stream.width, stream.height = (round(DPI * side) for side in INCHES)
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "20"}

        def write(picture: Picture, count: int) -> None:
            for _ in range(count):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))

        yield write
        container.mux(stream.encode())
