"""The registry of all topics, with the key and the message type of each. Keys are defined nowhere else."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Generic, TypeVar

from saccade.shared.bus import messages as m
from saccade.shared.errors import SaccadeError

ROOT = "saccade"

Of = TypeVar("Of", bound=m.Message, covariant=True)


@dataclass(frozen=True)
class Topic(Generic[Of]):
    """One kind of publication.

    `parts`: the topic has one key for each object, or for each service in the case of `status`. `latched`: it has one
    message per episode, which holds for every later step. `in_step`: it is published once per step (and part), so that
    a gap can be noticed. `optional`: no service needs it, so a service of one's own may leave it out.
    """

    name: str
    type: type[Of]
    parts: bool = False
    latched: bool = False
    in_step: bool = True
    optional: bool = False

    def key(self, world: str, part: str | None = None) -> str:
        """Returns the key `saccade/<world>/<topic>`, with `/<part>` if the topic has parts. Without `part` it is the
        key expression of all parts."""
        return f"{ROOT}/{world}/{self.name}" + (f"/{part or '*'}" if self.parts else "")


@dataclass(frozen=True)
class Output:
    """A message that will be published. `part` names the object if the topic has parts."""

    topic: Topic
    message: m.Message
    part: str | None = None


FRAME = Topic("frame", m.Frame)
GOAL = Topic("goal", m.Goal, latched=True)
PERCEPT = Topic("percept", m.Percept, parts=True)
GOAL_PERCEPT = Topic("goal_percept", m.Percept, parts=True, latched=True)
BELIEF = Topic("belief", m.Belief, parts=True)
EVENTS = Topic("events", m.Events, optional=True)
PLAN = Topic("plan", m.Plan)
ACTION = Topic("action", m.Action)
TRUTH = Topic("truth", m.Truth)
RESULT = Topic("result", m.Result, latched=True)
STATUS = Topic("status", m.Status, parts=True, in_step=False)

TOPICS: dict[str, Topic] = {topic.name: topic for topic in (
    FRAME, GOAL, PERCEPT, GOAL_PERCEPT, BELIEF, EVENTS, PLAN, ACTION, TRUTH, RESULT, STATUS)}


def parse_key(key: str) -> tuple[str, Topic, str | None]:
    """Returns (world, topic, part) of a key. Raises SaccadeError if it is not a key of Saccade's."""
    match = re.fullmatch(rf"{ROOT}/([^/*]+)/([^/*]+)(?:/([^/*]+))?", key)
    topic = TOPICS.get(match[2]) if match else None
    if match is None or topic is None or topic.parts != (match[3] is not None):
        raise SaccadeError(f"key {key!r} is not one of Saccade's topics: {', '.join(TOPICS)}")
    return match[1], topic, match[3]
