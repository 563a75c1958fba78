"""Writes the messages of a run into a Rerun recording: what the agent sees, believes and plans, step by step.

The same code serves live runs and logs. On the timeline `step` the episodes of a run follow one another.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import rerun as rr

from saccade.services.viewer.curves import Curves
from saccade.services.viewer.guiding import Guiding
from saccade.services.viewer.images import Images
from saccade.services.viewer.imagination import Imagination
from saccade.services.viewer.layout import STEP, Colour, colour_of, layout
from saccade.services.viewer.words import decision, ending, happened
from saccade.services.viewer.world import World
from saccade.shared.bus.messages import Belief, Events, Frame, Message, Percept, Plan, Result, Status, Truth
from saccade.shared.bus.topics import BELIEF, EVENTS, FRAME, GOAL, PERCEPT, PLAN, RESULT, STATUS, TRUTH, Topic
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.stepper import settle
from saccade.shared.model.weights import Weights
from saccade.shared.world.geometry import IMAGE_SIZE_PX

LIVE_PAUSE_S = 0.5  # shortest time between two drawings of the crops in a live run; browsers do not get more either
WAITING = 64  # how many images may wait for their percepts
WITHOUT: dict[Topic, str] = {  # what cannot be shown if a topic has no messages
    FRAME: "the camera and what it sees", GOAL: "the goal", PERCEPT: "boxes, masks and crops",
    BELIEF: "particles, beliefs, entropy and F", PLAN: "candidates, viewpoints, G and decisions",
    TRUTH: "the true distance to the goal", STATUS: "milliseconds and messages dropped"}


Shown = TypeVar("Shown", Percept, Belief)


@dataclass
class Gathered(Generic[Shown]):
    """The percepts or beliefs of one step that have arrived so far.

    In lockstep one step is complete before the next begins. With a live camera perception may be some steps behind the
    camera, and the belief some steps behind perception.
    """

    step: int = -1
    frame: Frame | None = None
    by_object: dict[str, Shown] = field(default_factory=dict)


class Viewer:
    """Writes messages into a Rerun recording.

    With `truth` it also shows what only the simulator knows. `live` says that the run is still going on. `lacks` holds
    texts that say what cannot be shown because the weights are missing or do not fit.
    """

    def __init__(self, recording: rr.RecordingStream, config: Config, *, truth: bool, live: bool) -> None:
        self._to, self._truth, self._names = recording, truth, list(config.scene.names or ())
        self._goal_view_is_known = config.scene.goal_view_is_known
        self.lacks: list[str] = []
        recording.send_blueprint(layout(live=live, objects=len(self._names)))
        recording.set_time(STEP, sequence=0)
        weights, imagination = self._networks(config)
        sizes_m = {card.name: card.size_m for card in weights.cards} if weights else {}
        self._world = World(recording, self._colour_of, sizes_m)
        self._images = Images(recording, tuple(self._names), self._colour_of, imagination)
        self._guiding = Guiding(recording) if config.planner.moved_by == "hand" else None
        self._curves = Curves(recording, tuple(self._names), self._colour_of)
        self._show: dict[Topic, Callable[[Any], None]] = {
            FRAME: self._frame, GOAL: self._images.goal, PERCEPT: self._percept, BELIEF: self._belief,
            EVENTS: self._events, PLAN: self._plan, TRUTH: self._true, RESULT: self._result, STATUS: self._status}
        self._episode, self._first, self._newest = -1, 0, 0  # its number, its start on the timeline, its last step
        self._frames: dict[int, Frame] = {}  # by step: the frames whose percepts have not arrived yet
        self._seen: Gathered[Percept] = Gathered()  # the percepts of the newest step that has any
        self._held: Gathered[Belief] = Gathered()  # the beliefs of the newest step that has any
        self._believed: dict[str, Belief] = {}
        self._said = ""
        self._came: set[str] = set()
        self._pause_s, self._drawn_s = LIVE_PAUSE_S if live else 0.0, -math.inf

    def take(self, topic: Topic, part: str | None, message: Message) -> None:
        """Takes any message, in the order of arrival. Topics that are not shown are ignored."""
        if topic not in self._show:
            return
        self._came.add(topic.name)
        if topic.in_step:
            if message.episode < self._episode and topic != RESULT:
                return
            self._move_to(message.episode, message.step)
        self._show[topic](settle(message))

    def dropped(self, count: int) -> None:
        """Shows how many messages so far came faster than the viewer could take them."""
        self._curves.dropped("viewer", count)

    def close(self) -> list[str]:
        """Shows the rest of the last step. Returns texts that say what could not be shown."""
        self._finish()
        lacks = [*self.lacks, *(f"no {topic.name}: without {what}" for topic, what in WITHOUT.items()
                                if topic.name not in self._came)]
        for text in lacks:
            self._to.log("decisions", rr.TextLog(text, level=rr.TextLogLevel.WARN))
        self._to.flush()
        return lacks

    def _networks(self, config: Config) -> tuple[Weights | None, Imagination | None]:
        try:
            weights = Weights(config.weights)
            return weights, Imagination(weights, tuple(self._names)) if self._names else None
        except SaccadeError as error:
            self.lacks.append(f"without crops, reconstructions and imagined views: {error}")
            return None, None

    def _colour_of(self, name: str) -> Colour:
        if name not in self._names:
            self._names.append(name)
        return colour_of(self._names.index(name))

    def _move_to(self, episode: int, step: int) -> None:
        if episode > self._episode:
            self._finish()
            self._first += self._newest + 1 if self._episode >= 0 else 0
            self._episode, self._newest, self._believed, self._said = episode, 0, {}, ""
            self._seen, self._held = Gathered(), Gathered()
            self._at(0)
            self._world.begin()
            self._images.begin()
            if self._guiding is not None:
                self._guiding.begin()
        if episode == self._episode:
            self._newest = max(self._newest, step)
            self._at(step)

    def _at(self, step: int) -> None:
        self._to.set_time(STEP, sequence=self._first + step)

    def _finish(self) -> None:
        """Shows what still waits for other messages of its step."""
        for frame in self._frames.values():
            self._at(frame.step)
            self._images.frame(frame)
        self._frames.clear()
        self._draw_crops()
        self._draw_beliefs()
        self._at(self._newest)

    def _frame(self, frame: Frame) -> None:
        self._world.frame(frame)
        if self._guiding is not None:
            self._guiding.frame(frame)
        if frame.step <= self._seen.step:  # when old messages are read, percepts may come before their frames
            self._images.frame(frame)
            return
        self._frames[frame.step] = frame
        if len(self._frames) > WAITING:
            oldest = self._frames.pop(min(self._frames))
            self._at(oldest.step)
            self._images.frame(oldest)
            self._at(frame.step)  # messages that belong to no step are shown at the present one

    def _percept(self, percept: Percept) -> None:
        """Shows a percept on the image in which it was perceived. Images that perception skipped are not shown."""
        if percept.step > self._seen.step:
            self._draw_crops()
            self._seen = Gathered(percept.step, self._frames.pop(percept.step, None))
            self._frames = {step: frame for step, frame in self._frames.items() if step > percept.step}
            self._at(percept.step)
            if self._seen.frame is not None:
                self._images.frame(self._seen.frame)
        if percept.step == self._seen.step:
            self._seen.by_object[percept.object] = percept
        width = self._seen.frame.rgb.shape[1] if self._seen.frame else IMAGE_SIZE_PX
        self._images.percept(percept, width)

    def _belief(self, belief: Belief) -> None:
        if belief.step > self._held.step:
            self._draw_beliefs()
            self._held = Gathered(belief.step)
            self._at(belief.step)
        if belief.step == self._held.step:
            self._held.by_object[belief.object] = belief
        self._believed[belief.object] = belief
        self._world.belief(belief)

    def _draw_crops(self) -> None:
        """Draws the crops of the last step that has percepts."""
        seen, self._seen = self._seen, Gathered(self._seen.step)
        if seen.frame is not None and time.monotonic() - self._drawn_s >= self._pause_s:
            self._drawn_s = time.monotonic()
            self._at(seen.step)
            self._images.step(seen.frame, seen.by_object)

    def _draw_beliefs(self) -> None:
        held, self._held = self._held, Gathered(self._held.step)
        if held.by_object:
            self._at(held.step)
            self._curves.beliefs(held.by_object)

    def _events(self, events: Events) -> None:
        self._world.events(events)
        for text in happened(events):
            self._to.log("decisions", rr.TextLog(text, level=rr.TextLogLevel.WARN))

    def _plan(self, plan: Plan) -> None:
        self._world.plan(plan)
        if self._guiding is not None:
            self._guiding.plan(plan)
        self._images.plan(plan, self._believed)
        self._curves.plan(plan)
        self._say(decision(plan, self._believed.values()))

    def _true(self, truth: Truth) -> None:
        if self._goal_view_is_known:
            self._curves.truth(truth)
        if self._truth:
            self._world.truth(truth)

    def _result(self, result: Result) -> None:
        self._finish()
        self._say(ending(result))

    def _status(self, status: Status) -> None:
        self._curves.status(status)

    def _say(self, text: str) -> None:
        if text != self._said:
            self._said = text
            self._to.log("decisions", rr.TextLog(text, level=rr.TextLogLevel.INFO))
