"""What a service is: a declaration of topics, and a core without side effects. The bus loop, the replay and the graph
of processes all follow from the declaration."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

from saccade.shared.bus.topics import Output, Topic


@dataclass(frozen=True)
class Service:
    """A declaration of a service.

    The core runs once for each step of `trigger`, when all `inputs` of that step and the latched inputs of the episode
    are there. A source (the simulator, a camera) begins episodes by itself. When one of its episodes is done, it waits
    for a message of `closed_by` about this episode before it begins the next one. The core of a `divisible` service
    computes its answer for each object separately, from the inputs of the step alone, so that replicas can share the
    objects (`DivisibleCore`).
    """

    name: str
    inputs: tuple[Topic, ...]
    trigger: Topic
    outputs: tuple[Topic, ...]
    closed_by: Topic | None = None
    divisible: bool = False


Inputs = dict[str, Any]  # topic name -> message, or {part: message} for a topic with parts


class Core(Protocol):
    """Messages go in, messages come out. A core uses no bus, no clock and no files. Its state depends only on its
    inputs since `begin`."""

    def begin(self, run: str, episode: int) -> Iterable[Output]:
        """Begins a new episode and forgets everything before it. A source yields its first messages."""

    def step(self, inputs: Inputs) -> Iterable[Output]:
        """Takes all inputs of one step and yields the outputs."""


class Source(Core, Protocol):
    """A core that begins episodes by itself."""

    @property
    def episodes(self) -> int:
        """Number of episodes."""


class DivisibleCore(Core, Protocol):
    """A core that answers for some of the objects, which can change during a run."""

    names: tuple[str, ...]  # the objects that it answers for now

    def share(self, names: tuple[str, ...]) -> None:
        """Answers for these objects from now on. There may be none."""


class TimedSource(Source, Protocol):
    """A source that goes by time, not by actions. Its episode ends when there is no next frame."""

    period_s: float  # time from one frame to the next
    notes: tuple[str, ...]  # lines for the user
    skipped: int  # number of images that it could not publish

    def next_frame(self) -> Iterable[Output]:
        """Yields what it sees next. It yields nothing when there are no more frames."""
