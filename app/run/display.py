"""Shows a run while it goes on: as a live display on a terminal, or as a line from time to time."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from saccade.shared.bus.messages import Belief, Message, Plan, Result, Status, Truth
from saccade.shared.bus.topics import BELIEF, FRAME, PLAN, RESULT, STATUS, TRUTH, Topic
from saccade.shared.errors import LINE_LIMIT, printable
from saccade.shared.loop.main import WAITS
from saccade.shared.loop.process import REFUSED

LINE_EVERY = 10  # in plain mode, a line is printed every so many steps
PER_SECOND = 8
SHORT = 120  # characters of a name in a table


def say(console: Console, text: str) -> None:
    """Prints a line as it is, without wrapping and without colours."""
    console.print(printable(text, LINE_LIMIT), markup=False, highlight=False, soft_wrap=True)


def cell(text: str) -> Text:
    """A name from outside in a table: in a text nothing is markup."""
    return Text(printable(text, SHORT))


class Progress:
    """What the messages of a run have told so far. `judged` says that the truth knows the goal's view, so that true
    distances can be shown. `at` is the episode and step of the newest view. `declared` is the first plan that says that
    the agent has arrived."""

    def __init__(self, *, judged: bool = True) -> None:
        self.judged = judged
        self.at: tuple[int, int] | None = None
        self.truth: Truth | None = None
        self.plan: Plan | None = None
        self.declared: Plan | None = None
        self.beliefs: dict[str, Belief] = {}
        self.statuses: dict[str, Status] = {}
        self.results: list[Result] = []

    def take(self, topic: Topic, part: str | None, message: Message) -> None:
        """Takes any message. Plans and beliefs of an earlier episode are forgotten."""
        if topic in (FRAME, TRUTH):
            if self.at is not None and message.episode != self.at[0]:
                self.plan, self.declared, self.beliefs = None, None, {}
            self.at = message.episode, message.step
        if isinstance(message, Truth):
            self.truth = message
        elif isinstance(message, Plan):
            self.plan = message
            self.declared = self.declared or (message if message.arrived else None)
        elif isinstance(message, Belief) and part is not None:
            self.beliefs[part] = message
        elif isinstance(message, Status) and part is not None:
            self.statuses[part] = message
        elif isinstance(message, Result):
            self.results.append(message)

    @property
    def distance_m(self) -> float | None:
        """The true distance from the camera to the goal's camera. It is None if nobody knows it."""
        if self.truth is None or not self.judged:
            return None
        return float(np.linalg.norm((self.truth.world_from_camera - self.truth.goal_world_from_camera)[:3, 3]))

    @property
    def believed_distance_m(self) -> float | None:
        """The same distance as the agent believes it. It is None while the agent has no such belief."""
        if self.plan is None or self.plan.believed_distance_m < 0:
            return None
        return self.plan.believed_distance_m


def each_of(beliefs: Mapping[str, Belief]) -> list[Belief]:
    """All instances, by the names of the objects and by their numbers."""
    return [each for _, belief in sorted(beliefs.items()) for each in belief.each()]


def spread_cm(belief: Belief) -> float:
    """Standard deviation of a believed position over all axes, in centimetres."""
    return 100 * float(np.sqrt(max(np.trace(belief.covariance_m2), 0.0)))


def line(progress: Progress) -> str:
    """Returns the state of a run as one line."""
    plan = progress.plan
    if progress.at is None:
        return "starting"
    parts = ["episode {} step {}".format(*progress.at)]
    if progress.judged:
        parts.append(f"goal {_metres(progress.distance_m)} away")
    if plan is not None:
        if plan.target:
            parts.append(f"believed {_metres(progress.believed_distance_m)}")
        parts.append(f"{plan.mode} {plan.target}".strip())
        parts.append(f"G {plan.g:.1f}")
    parts += [f"{belief.label()} ±{spread_cm(belief):.1f} cm" for belief in each_of(progress.beliefs)
              if belief.presence > 0.5]
    return "  ".join(parts)


def panel(progress: Progress) -> RenderableType:
    """Returns the state of a run for the live display."""
    if progress.at is None:
        waiting = sorted(f"{name} {status.state}" for name, status in progress.statuses.items())
        return Text("starting: " + printable(", ".join(waiting or ["services"])))
    scene = f"  scene {printable(progress.truth.scene, SHORT)}" if progress.truth else ""
    head = Text("episode {}  step {}".format(*progress.at) + scene, style="bold")
    return Group(head, _plan_table(progress), _belief_table(progress), _status_line(progress))


def _plan_table(progress: Progress) -> Table:
    table = Table(show_header=False, box=None, padding=(0, 2))
    if progress.truth is not None or progress.believed_distance_m is not None:
        table.add_row("distance to the goal", f"{_metres(progress.distance_m)} in truth",
                      f"{_metres(progress.believed_distance_m)} as believed")
    if (plan := progress.plan) is not None:
        x, y, z = plan.viewpoint[:3, 3]
        aim = f"{plan.mode} {plan.target}".strip()
        table.add_row("viewpoint", f"({x:.2f}, {y:.2f}, {z:.2f}) m", cell(aim))
        table.add_row("G", f"{plan.g:.2f} nats", f"position {plan.g_position:.2f}  scale {plan.g_scale:.2f}  "
                      f"pose {plan.g_pose:.2f}  information {plan.g_information:.2f}")
    return table


def _belief_table(progress: Progress) -> RenderableType:
    if not progress.beliefs:
        return Text("")
    table = Table(box=None, padding=(0, 2))
    for header in ("object", "present", "where (m)", "± cm", "views"):
        table.add_column(header, justify="left" if header == "object" else "right")
    for belief in each_of(progress.beliefs):
        x, y, z = belief.mean_m
        table.add_row(cell(belief.label()), f"{belief.presence:.2f}", f"{x:.2f}, {y:.2f}, {z:.2f}",
                      f"{spread_cm(belief):.1f}", str(belief.views), style="" if belief.presence > 0.5 else "dim")
    return table


def _status_line(progress: Progress) -> Text:
    busy = [f"{name} {status.milliseconds:.0f} ms" + (f" ({status.skipped} skipped)" if status.skipped else "")
            for name, status in sorted(progress.statuses.items()) if status.milliseconds > 0]
    notes = [printable(f"{name}: {status.note}") for name, status in sorted(progress.statuses.items())
             if status.refused or status.state in ("failed", "not recording")]
    return Text(printable("  ".join(busy), LINE_LIMIT) + "".join(f"\n{note}" for note in notes), style="dim")


def _metres(distance_m: float | None) -> str:
    return "unknown" if distance_m is None else f"{distance_m:.2f} m"


class Display:
    """Shows the messages of a run on a console; it is a context manager. Its output is plain if that is asked for, or
    if the console is not a terminal. `source` is the name of the service that gives the images and may have notes for
    the user. A source that is `live` is a real camera, which knows no truth."""

    def __init__(self, console: Console, *, plain: bool, judged: bool = True, source: str,
                 live: bool = False) -> None:
        self.progress, self.console = Progress(judged=judged), console
        self._source, self._is_live = source, live
        self._told: set[str] = set()
        self.plain = plain or not console.is_terminal
        self._live = Live(get_renderable=lambda: panel(self.progress), console=console, transient=True,
                          refresh_per_second=PER_SECOND)

    def __enter__(self) -> Display:
        if not self.plain:
            self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        if not self.plain:
            self._live.stop()

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The topics that the display needs."""
        return (self._view, PLAN, BELIEF, STATUS, RESULT)

    @property
    def _view(self) -> Topic:
        return FRAME if self._is_live else TRUTH

    def say(self, text: str) -> None:
        """Prints a line that stays, such as what happened to a service, or what the source assumes."""
        say(self.console, text)

    def take(self, topic: Topic, part: str | None, message: Message) -> None:
        """Takes a message. It must be called with every message of `topics`."""
        self.progress.take(topic, part, message)
        if isinstance(message, Status) and part == self._source:
            self.note(message.note)
        if self.plain and topic == self._view and message.step % LINE_EVERY == 0:
            say(self.console, line(self.progress))

    def note(self, text: str) -> None:
        """Prints those lines of the source's notes that are new."""
        for line in text.splitlines():
            if line not in self._told and not line.startswith((WAITS, REFUSED)):
                self._told.add(line)
                self.say(f"{self._source}: {line}")
