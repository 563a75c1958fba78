"""Decides which inputs belong together, when a core may run, and which numbers its messages get, without a bus or a
clock.

The loop on the bus and the runner within one process both drive the cores through `Stepper`. So their outputs are equal
to the byte.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from saccade.shared.bus.messages import Message, Truth
from saccade.shared.bus.sequences import Stamper
from saccade.shared.bus.topics import Output, Topic
from saccade.shared.bus.wire import MessageError
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.service import Core, Service

MAX_PENDING = 256  # incomplete steps that are kept; a flood of stray messages cannot fill the memory

Episode = tuple[str, int]  # run and number
Slot = dict[str, dict[str | None, Message]]  # topic name -> part -> message


class Stepper:
    """Connects one core with its inputs and outputs.

    `offer` takes an input, and `advance` runs the core if a step is complete. `parts` are the names of the run's
    objects. A latched message of step s holds from step s of its episode on. With `run`, messages of other runs are
    refused.

    In lockstep every step of an episode is taken, from `first_step` on (a log that was cut begins later than at 0).
    This is because the state of a core depends on all steps. Inputs that are missing can be asked for (`wants`). With
    `live`, the newest complete step is taken, and the steps before it are skipped.

    For a source, `begin` starts an episode, and the inputs must answer the last step that it published. Raises
    SaccadeError if the trigger of the service is not among its inputs.
    """

    def __init__(self, service: Service, core: Core, parts: tuple[str, ...], *, source: bool = False,
                 live: bool = False, first_step: int = 0, run: str | None = None) -> None:
        if service.trigger not in service.inputs:
            raise SaccadeError(f"service {service.name}: its trigger {service.trigger.name} is not among its inputs")
        self.service, self.parts = service, parts
        self.core: Any = core  # it may have more than a Core's methods, depending on its kind
        self.skipped = 0  # steps that never became complete
        self.episode_done = source  # a source is between episodes
        self.at: tuple[str, int, int] = ("", 0, 0)  # run, episode and step that were begun or taken last
        self._source, self._live, self._first_step, self._run = source, live, first_step, run
        self._begun: Episode | None = None
        self._past_runs: set[str] = set()
        self._last_step = -1  # of the current episode
        self._slots: dict[tuple[str, int, int], Slot] = {}
        self._latched: dict[Episode, dict[str, dict[str | None, list[Message]]]] = {}
        self._stamper = self._new_stamper()
        self._inputs_taken: dict[str, Any] | None = None  # of the last step, of a divisible service
        self.is_due: Callable[[tuple[str, int, int]], bool] = lambda at: True  # whether a step is still to be answered
        self._topics = {topic.name: topic for topic in service.inputs}

    def offer(self, topic: Topic, part: str | None, message: Message) -> None:
        """Takes an input. An input that comes too late is ignored. Raises MessageError if the input fits nowhere."""
        if topic.name not in self._topics:
            raise MessageError("topic: not an input")
        if topic.parts and part not in self.parts:
            raise MessageError(f"part: {part!r} is not an object of this run")
        if topic.parts and (named := getattr(message, "object", part)) != part:
            raise MessageError(f"object: {named!r} under the key of {part!r}")
        self._require_of_this_run(message)
        if self._late(message, topic):
            return
        message = settle(message)
        if topic.latched:
            self._latch(topic, part, message)
            return
        if self._source and message.step != self._last_step:
            raise MessageError(f"step: {message.step}, not {self._last_step}")
        slot = self._slots.setdefault((message.run, message.episode, message.step), {})
        known = slot.setdefault(topic.name, {}).setdefault(part, message)
        if known is not message and not _same(known, message):
            raise MessageError(f"step: a second, other message for step {message.step}")
        self._limit()

    def begin(self, run: str, episode: int) -> list[Output]:
        """Starts an episode of a source and returns its first outputs."""
        return self._emit(self._start((run, episode)))

    def tick(self) -> list[Output]:
        """Returns the next frame of a source that goes by time. If there is none, the episode is done."""
        outputs = self._emit(self.core.next_frame())
        self.episode_done |= not outputs
        return outputs

    @property
    def timed(self) -> bool:
        """Whether this is a source that goes by time."""
        return self._source and hasattr(self.core, "next_frame")

    def advance(self) -> list[Output] | None:
        """Runs the core on the next complete step. Returns the outputs with their sequence numbers, or None if no step
        is complete."""
        while True:
            at = self._next_complete()
            if at is None:
                return None
            run, episode, step = at
            inputs = self._inputs(at)
            first = [] if self._begun == (run, episode) else self._emit(self._start((run, episode)))
            self._last_step, self.at = step, at
            self._forget(at)
            self._inputs_taken = inputs if self.service.divisible else None
            return first + (self._emit(self.core.step(inputs)) if self.is_due(at) else [])

    def again(self) -> list[Output]:
        """Returns the outputs of the last step once more. It is used when the core answers for other objects than
        before."""
        return [] if self._inputs_taken is None else self._emit(self.core.step(self._inputs_taken))

    @property
    def wants(self) -> tuple[str, int, int] | None:
        """The run, the episode and the first step for which inputs are needed. None before the first episode."""
        if self._begun is None:
            return None
        return (*self._begun, max(0, self._last_step if self._source else self._last_step + 1))

    def waits_for(self) -> list[str]:
        """What the next step lacks, as texts such as 'percept/mug of step 3 of episode 0'. Empty if no step is
        waiting."""
        if self._slots:
            at = min(self._slots, key=lambda a: a[1:])
        elif self._begun is not None and self._source and not (self.timed or self.episode_done):
            at = (*self._begun, self._last_step)
        else:
            return []
        if not self._live and not self._source:
            due = self._last_step + 1 if self._begun == at[:2] else self._first_step
            at = (*at[:2], min(at[2], due))
        return [f"{name if part is None else f'{name}/{part}'} of step {at[2]} of episode {at[1]}"
                for name, part in self._lacks(at)]

    def _require_of_this_run(self, message: Message) -> None:
        """Raises MessageError if the message belongs to another run, or to an episode after the next one. Episodes
        follow one another, so such an episode cannot have begun."""
        if self._run is None:
            return
        if message.run != self._run:
            raise MessageError(f"run: {message.run!r}, not this run {self._run!r}")
        if self._begun is not None and message.episode > self._begun[1] + 1:
            raise MessageError(f"episode: {message.episode}, while episode {self._begun[1]} goes on")

    def _late(self, message: Message, topic: Topic) -> bool:
        if message.run in self._past_runs:
            return True
        if self._begun is None or message.run != self._begun[0]:
            return self._source
        if message.episode != self._begun[1]:
            return message.episode < self._begun[1]
        if self._source:
            return self.episode_done or message.step < self._last_step
        return not topic.latched and message.step <= self._last_step

    def _latch(self, topic: Topic, part: str | None, message: Message) -> None:
        known = self._latched.setdefault((message.run, message.episode), {}).setdefault(topic.name, {})
        held = [m for m in known.get(part, []) if m.step != message.step]
        known[part] = sorted([*held, message], key=lambda m: m.step)[-MAX_PENDING:]
        while len(self._latched) > MAX_PENDING:
            self._latched.pop(next(iter(self._latched)))

    def _limit(self) -> None:
        while len(self._slots) > MAX_PENDING:
            self._skip(next(iter(self._slots)))

    def _lacks(self, at: tuple[str, int, int]) -> list[tuple[str, str | None]]:
        slot, latched = self._slots.get(at, {}), self._latched.get(at[:2], {})
        lacking = []
        for topic in self.service.inputs:
            for part in self.parts if topic.parts else (None,):
                if topic.latched:
                    present = any(m.step <= at[2] for m in latched.get(topic.name, {}).get(part, []))
                else:
                    present = part in slot.get(topic.name, {})
                if not present:
                    lacking.append((topic.name, part))
        return lacking

    def _next_complete(self) -> tuple[str, int, int] | None:
        complete = [at for at in self._slots if self._is_due(at) and not self._lacks(at)]
        if not complete:
            return None
        run = complete[0][0]  # runs are taken in the order of their arrival, the steps of a run by number
        return (max if self._live else min)(at for at in complete if at[0] == run)

    def _is_due(self, at: tuple[str, int, int]) -> bool:
        """Whether this step may be the next one."""
        if self._live or self._source:
            return True
        return at[2] == (self._last_step + 1 if self._begun == at[:2] else self._first_step)

    def _inputs(self, at: tuple[str, int, int]) -> dict[str, Any]:
        slot, latched = self._slots[at], self._latched.get(at[:2], {})

        def value(topic: Topic, part: str | None) -> Message:
            if topic.latched:
                return [m for m in latched[topic.name][part] if m.step <= at[2]][-1]
            return slot[topic.name][part]

        return {t.name: {p: value(t, p) for p in self.parts} if t.parts else value(t, None)
                for t in self.service.inputs}

    def _start(self, episode: Episode) -> Iterable[Output]:
        if self._begun is not None and self._begun[0] != episode[0]:
            self._past_runs.add(self._begun[0])
        self._begun, self._last_step, self.at = episode, -1, (*episode, 0)
        self.episode_done, self._stamper, self._inputs_taken = False, self._new_stamper(), None
        self._latched = {e: v for e, v in self._latched.items() if e[0] != episode[0] or e[1] >= episode[1]}
        return self.core.begin(*episode)

    def _new_stamper(self) -> Stamper:
        return Stamper(self._first_step if self.service.divisible and not self._live else None)

    def _forget(self, at: tuple[str, int, int]) -> None:
        """Drops the step and those before it. The messages of one key arrive in order, so what the earlier steps lack
        is lost."""
        del self._slots[at]
        for old in [a for a in self._slots if a[0] in self._past_runs or (a[0] == at[0] and a[1:] < at[1:])]:
            self._skip(old)

    def _skip(self, at: tuple[str, int, int]) -> None:
        del self._slots[at]
        self.skipped += not self._source  # a source skips images, and it counts them itself

    def _emit(self, outputs: Iterable[Output] | None) -> list[Output]:
        stamped = []
        for output in outputs or ():
            if output.topic not in self.service.outputs:
                raise SaccadeError(f"service {self.service.name} does not declare its output {output.topic.name}")
            stamped.append(self._stamper.stamp(output))
            if self._source:
                self._last_step = max(self._last_step, output.message.step)
                self.at = (output.message.run, output.message.episode, self._last_step)
                self.episode_done |= isinstance(output.message, Truth) and output.message.done
        return stamped


def _same(one: Message, other: Message) -> bool:
    return all(_equal(getattr(one, field.name), getattr(other, field.name)) for field in dataclasses.fields(one))


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, list) and one and isinstance(one[0], Message):
        return len(one) == len(other) and all(map(_same, one, other))
    return np.array_equal(one, other)


def settle(message: Message) -> Message:
    """Returns the message with arrays that are aligned in memory, contiguous and read-only.

    Bytes from the bus are seldom aligned, and NumPy may sum unaligned numbers in another order. Without this, the same
    message would give other bytes in another process. The arrays are read-only so that no core can change what another
    one holds.
    """
    changed: dict[str, Any] = {}
    for field in dataclasses.fields(message):
        value = getattr(message, field.name)
        if isinstance(value, np.ndarray) and not (
                value.flags.aligned and value.flags.c_contiguous and not value.flags.writeable):
            changed[field.name] = np.array(value, order="C")
            changed[field.name].flags.writeable = False
        elif isinstance(value, list) and value and isinstance(value[0], Message):
            changed[field.name] = [settle(item) for item in value]
    return dataclasses.replace(message, **changed) if changed else message
