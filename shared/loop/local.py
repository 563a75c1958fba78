"""Runs the same cores within one process. Benchmarks use it, and it shows what the bus costs."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence

from saccade.shared.bus.messages import Message
from saccade.shared.bus.topics import Output, Topic
from saccade.shared.bus.wire import MessageError, encode
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.main import WAITS
from saccade.shared.loop.service import Core, Service
from saccade.shared.loop.stepper import Stepper, settle

OnMessage = Callable[[Topic, str | None, Message, bytes | None], None]
OnStep = Callable[[str, float], None]


class Pump:
    """Brings messages from core to core within this process, in the order of publication. Raises SaccadeError, which
    names the sender, if a message is not valid.

    `on_message(topic, part, message, payload)` sees every message. With `encoded`, `payload` holds the encoded bytes;
    otherwise it is None, and messages are passed on as they are. `on_step(service, milliseconds)` is told how long each
    step of a core took.
    """

    def __init__(self, steppers: Sequence[Stepper], on_message: OnMessage | None = None, *, encoded: bool = False,
                 on_step: OnStep | None = None) -> None:
        self._steppers, self._on_message, self._encoded, self._on_step = steppers, on_message, encoded, on_step

    def run(self, outputs: Iterable[Output]) -> None:
        """Passes on these outputs and everything that follows from them, until no core has anything more to say."""
        waiting = deque(outputs)
        while waiting:
            output = waiting.popleft()
            try:
                waiting.extend(self._pass_on(output))
            except MessageError as error:
                makers = [s.service.name for s in self._steppers if output.topic in s.service.outputs]
                raise SaccadeError(f"{makers[0] if makers else 'the source'} gives an invalid {output.topic.name}: "
                                   f"{error}; the run cannot go on without it") from error

    def _pass_on(self, output: Output) -> list[Output]:
        """Gives a message to those who take it, and returns what they say to it."""
        message = settle(output.message)
        if self._on_message is not None:
            self._on_message(output.topic, output.part, message, encode(message) if self._encoded else None)
        answers: list[Output] = []
        for stepper in self._steppers:
            if output.topic in stepper.service.inputs:
                stepper.offer(output.topic, output.part, message)
                while (made := _advance(stepper, self._on_step)) is not None:
                    answers.extend(made)
        return answers


def run_local(pairs: Sequence[tuple[Service, Core]], parts: tuple[str, ...], run_id: str,
              episodes: Iterable[int] | None = None, on_message: OnMessage | None = None, *, encoded: bool = False,
              on_step: OnStep | None = None) -> None:
    """Runs the cores within this process, for these episodes of the source in ascending order, or for all its episodes.

    The source is the core with `episodes`. A source that goes by time is not hurried: its next frame comes when the one
    before it has been worked off. `Pump` describes `on_message`, `encoded` and `on_step`. Raises SaccadeError if there
    is not exactly one source, or if an episode cannot go on because a step lacks an input.
    """
    sources = [Stepper(s, c, parts, source=True) for s, c in pairs if hasattr(c, "episodes")]
    if len(sources) != 1:
        raise SaccadeError(f"a run needs one source, not {len(sources)}: {', '.join(s.name for s, _ in pairs)}")
    source = sources[0]
    steppers = [source if c is source.core else Stepper(s, c, parts) for s, c in pairs]
    pump = Pump(steppers, on_message, encoded=encoded, on_step=on_step)
    for episode in range(source.core.episodes) if episodes is None else episodes:
        pump.run(source.begin(run_id, episode))
        while source.timed and not source.episode_done:
            pump.run(source.tick())
        if not source.episode_done:
            lacks = [f"{s.service.name} {WAITS}{', '.join(s.waits_for())}" for s in steppers if s.waits_for()]
            raise SaccadeError(f"episode {episode} came to a halt: {'; '.join(lacks) or 'nobody has anything to do'}")


def _advance(stepper: Stepper, on_step: OnStep | None) -> list[Output] | None:
    start = time.perf_counter()
    outputs = stepper.advance()
    if outputs is not None and on_step is not None:
        on_step(stepper.service.name, (time.perf_counter() - start) * 1e3)
    return outputs
