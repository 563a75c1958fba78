"""What a service is: a declaration of topics and a pure core. Wiring, replay and the process graph derive from it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

from saccade.shared.bus.topics import Output, Topic


@dataclass(frozen=True)
class Service:
    """A declaration. The core runs once per step of `trigger`, when all `inputs` of that step (and the latched ones of
    the episode) are there. A source (the simulator, a camera) begins episodes by itself; `closed_by` is the topic that
    must have answered an episode that is done before the next one begins. The core of a `divisible` one answers for
    each object by itself, from the step's inputs alone: replicas may share the objects (`DivisibleCore`)."""

    name: str
    inputs: tuple[Topic, ...]
    trigger: Topic
    outputs: tuple[Topic, ...]
    closed_by: Topic | None = None
    divisible: bool = False


Inputs = dict[str, Any]  # topic name -> message, or {part: message} for a topic with parts


class Core(Protocol):
    """Messages in, messages out: no bus, no clock, no files. Its state is a fold over its inputs since `begin`."""

    def begin(self, run: str, episode: int) -> Iterable[Output]:
        """A new episode: forget everything; sources publish their first messages."""

    def step(self, inputs: Inputs) -> Iterable[Output]:
        """All inputs of one step."""


class Source(Core, Protocol):
    """A core that begins episodes by itself."""

    @property
    def episodes(self) -> int:
        """How many."""


class DivisibleCore(Core, Protocol):
    """A core that answers for some of the objects."""

    names: tuple[str, ...]  # for these, now

    def share(self, names: tuple[str, ...]) -> None:
        """From now on for these, maybe none."""


class TimedSource(Source, Protocol):
    """A source that goes by time, not by actions: its episode ends when there is no next frame."""

    period_s: float  # from one frame to the next
    notes: tuple[str, ...]  # for the user, a line each
    skipped: int  # images that it could not publish

    def next_frame(self) -> Iterable[Output]:
        """What it sees next; nothing when that was all."""
