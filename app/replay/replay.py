"""`saccade replay` plays recorded inputs into the present services, logs what they say, and compares it with the
recording."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from saccade.app.log.cut import range_of
from saccade.app.replay.comparison import Comparison
from saccade.app.replay.holes import Holes, holes_of
from saccade.app.run.launch import PROCESSES, Graph, running
from saccade.app.run.registry import pairs_of, service_of
from saccade.services.recorder.core import describe
from saccade.services.replayer.core import Keys, Pace, Selection, play
from saccade.shared.bus.messages import Message, Status
from saccade.shared.bus.outbox import Outbox
from saccade.shared.bus.topics import TOPICS, Output, Topic
from saccade.shared.bus.transport import free_endpoint
from saccade.shared.bus.wire import MessageError, Stamp, decode, encode, stamp_of
from saccade.shared.config import Config, recorded
from saccade.shared.errors import SaccadeError
from saccade.shared.log.folder import CONFIG_NAME, LOG_NAME
from saccade.shared.log.migrations import OLDEST, SINCE
from saccade.shared.log.reading import Recorded, RunReader
from saccade.shared.log.recording import RunLog
from saccade.shared.loop.episodes import READY_STATES
from saccade.shared.loop.service import Service
from saccade.shared.loop.stepper import Stepper, settle

REPLAYABLE = ("perception", "belief", "planner", "evaluator")
WINDOW = 32  # the player may be so many steps ahead of the slowest service
HALTED_S = 30.0  # after so long without output, although there are inputs, a replay is given up

OnMoved = Callable[[Topic, str | None, Message, Message], None]


@dataclass(frozen=True)
class Replay:
    """What is played into which services. `config` is the recorded configuration with the user's changes. `live` says
    that the run was recorded live, so that not every service took every step."""

    log: Path
    into: tuple[str, ...]
    config: Config
    pace: Pace
    selection: Selection
    outputs: Selection
    one_by_one: bool = False
    live: bool = False
    holes: Holes = field(default_factory=Holes)

    @property
    def services(self) -> list[Service]:
        """The declarations of the services."""
        return [service_of(name, self.config) for name in self.into]


@dataclass
class Outcome:
    """The result of a replay. `played` counts the messages that were put in, by topic. `statuses` is what each process
    counted (on the bus only). `late_s` is how far the player was behind its pace."""

    log: Path
    comparison: Comparison = field(default_factory=Comparison)
    played: dict[str, int] = field(default_factory=dict)
    statuses: dict[str, Status] = field(default_factory=dict)
    late_s: float = 0.0


def prepare(log: Path, into: Sequence[str], values: dict, *, pace: Pace, topics: Sequence[Topic] | None = None,
            episode: int | None = None, start_step: int = 0, end_step: int | None = None,
            one_by_one: bool = False) -> Replay:
    """Reads the log's configuration and prepares a replay. Raises SaccadeError if one of the services cannot be
    replayed, or if the log has no messages or no configuration."""
    strange = [name for name in into if name not in REPLAYABLE]
    if strange:
        raise SaccadeError(f"--into {strange[0]}: choose from {', '.join(REPLAYABLE)}; the log stands for the rest")
    ordered = tuple(name for name in REPLAYABLE if name in into)
    config, run, cut = recorded_config(log)
    live = config.bus.live
    config = config.with_values({"run": run, "bus.wait_for": [], "bus.live": False, "bus.endpoint": "tcp/127.0.0.1:0",
                                 "bus.listen": None, "bus.first_step": max(start_step, cut)} | values)
    services = [service_of(name, config) for name in ordered]
    made = {topic.name for service in services for topic in service.outputs}
    wanted = {topic.name for service in services for topic in service.inputs} - made
    inputs = tuple(TOPICS[name] for name in sorted(wanted) if topics is None or TOPICS[name] in topics)

    def chosen(names: tuple[Topic, ...]) -> Selection:
        return Selection(names, episode=episode, start_step=start_step, end_step=end_step)

    reader = RunReader(log)
    next(reader.entries(), None)  # with it the log's format is known, and what it did not have cannot be compared
    outputs = tuple(TOPICS[name] for name in sorted(made) if reader.format >= SINCE.get(name, OLDEST))
    holes = holes_of(log, inputs, outputs, config.names, live=live)
    return Replay(log, ordered, config, pace, chosen(inputs), chosen(outputs), one_by_one, live, holes)


def recorded_config(log: Path) -> tuple[Config, str, int]:
    """Returns (configuration, name of the run, first step) of a log. Raises SaccadeError if it has none."""
    reader = RunReader(log)
    first = next((told for told in reader if told[0].in_step), None)
    if first is None or reader.configuration is None:
        raise SaccadeError(f"log {log} holds no {'messages' if first is None else 'configuration'}: nothing to replay")
    kept = range_of(reader)
    return recorded(reader.configuration, f"the log {log}"), first[2].run, kept.start if kept else 0


def replay_here(replay: Replay, out: Path, keys: Keys, say: Callable[[str], None],
                on_moved: OnMoved | None = None) -> Outcome:
    """Replays within this process, step by step; the bytes are the same as on the bus. If the log was recorded live,
    each service takes the steps that it took then."""
    config, outcome = replay.config, Outcome(out / LOG_NAME)
    steppers = [Stepper(service, core, config.names, live=replay.live, first_step=config.bus.first_step)
                for service, core in pairs_of(replay.into, config)]
    taken = steps_taken(replay) if replay.live else None
    log = new_log(out, config)
    twins = Twins(outcome.comparison, on_moved)

    def publish(output: Output) -> None:
        try:
            payload = encode(output.message)
        except MessageError as error:
            maker = next(s.name for s in replay.services if output.topic in s.outputs)
            raise SaccadeError(f"{maker} gives an invalid {output.topic.name}: {error}") from error
        log.write(output.topic, output.part, payload, sequence=output.message.seq)
        if output.topic in replay.outputs.topics:
            twins.replayed(output.topic, output.part, payload)

    try:
        for entry, stamp in played(replay, keys, say, outcome, twins):
            log.write(entry.topic, entry.part, entry.payload, sequence=stamp.seq)
            waiting = deque([Output(entry.topic, decode(entry.topic.type, entry.payload), entry.part)])
            while waiting:
                output = waiting.popleft()
                for stepper in (s for s in steppers if _is_input(output, s.service, taken)):
                    with suppress(MessageError):  # of a sender outside this run; the recorded run has counted it
                        stepper.offer(output.topic, output.part, settle(output.message))
                    while (made := stepper.advance()) is not None:
                        for each in made:
                            publish(each)
                        waiting.extend(made)
    finally:
        log.close()
    outcome.late_s = replay.pace.late_s
    outcome.comparison.set_aside(replay.holes.may_lack)
    return outcome


def steps_taken(replay: Replay) -> dict[str, set[tuple[int, int]]]:
    """Returns, for each service, the (episode, step) pairs that it answered in the recording."""
    taken: dict[str, set[tuple[int, int]]] = {name: set() for name in replay.into}
    makers = {topic.name: service.name for service in replay.services for topic in service.outputs}
    for entry in RunReader(replay.log).entries():
        if entry.topic.name in makers:
            with suppress(MessageError):
                stamp = stamp_of(entry.payload)
                taken[makers[entry.topic.name]].add((stamp.episode, stamp.step))
    return taken


def _is_input(output: Output, service: Service, taken: dict[str, set[tuple[int, int]]] | None) -> bool:
    if output.topic not in service.inputs:
        return False
    at = (output.message.episode, output.message.step)
    return output.topic.latched or taken is None or at in taken[service.name]


def new_log(out: Path, config: Config) -> RunLog:
    """Opens the log of a replay in a new folder, and saves the configuration beside it."""
    out.mkdir(parents=True, exist_ok=True)
    log = RunLog(out / LOG_NAME, world=config.bus.world, configuration=config.model_dump_json(indent=2),
                 metadata=describe(config, config.run or out.name))
    config.save(out / CONFIG_NAME)
    return log


def played(replay: Replay, keys: Keys, say: Callable[[str], None], outcome: Outcome, twins: Twins,
           may_go_on: Callable[[Stamp], bool] = lambda _stamp: True) -> Iterator[tuple[Recorded, Stamp]]:
    """Yields the inputs when they are due. What the services said in the recording goes to the comparison. What is no
    valid message is left out, and so are steps that cannot be replayed."""

    def inputs() -> Iterator[Recorded]:
        for entry in RunReader(replay.log, sums=False).entries():
            if entry.topic in replay.outputs.topics:
                twins.recorded(entry, replay.outputs, replay.holes)
            elif entry.topic in replay.selection.topics:
                with suppress(MessageError):
                    message = decode(entry.topic.type, entry.payload)
                    if not replay.holes.cannot_be_replayed(message.episode, message.step):
                        yield entry

    for entry, stamp in play(inputs(), replay.selection, replay.pace, keys, one_by_one=replay.one_by_one,
                               may_go_on=may_go_on, say=say):
        outcome.played[entry.topic.name] = outcome.played.get(entry.topic.name, 0) + 1
        yield entry, stamp


class Twins:
    """Feeds a comparison. Calls `on_moved(topic, part, recorded, replayed)` for every pair. Safe between threads."""

    def __init__(self, comparison: Comparison, on_moved: OnMoved | None = None) -> None:
        self._comparison, self._lock = comparison, threading.Lock()
        comparison.on_pair = on_moved

    def recorded(self, entry: Recorded, wanted: Selection, holes: Holes) -> None:
        """Takes an entry of the recording."""
        with suppress(MessageError), self._lock:
            stamp = stamp_of(entry.payload)
            if (entry.topic, stamp) not in wanted:
                return
            if holes.cannot_be_replayed(stamp.episode, stamp.step):
                self._comparison.not_compared.append((entry.topic.name, entry.part, stamp.episode, stamp.step))
            else:
                self._comparison.recorded(entry.topic, entry.part, entry.payload)

    def replayed(self, topic: Topic, part: str | None, payload: bytes) -> None:
        """Takes a message of the replay."""
        with self._lock:
            self._comparison.replayed(topic, part, payload)


def replay_on_bus(replay: Replay, out: Path, keys: Keys, say: Callable[[str], None],
                  on_moved: OnMoved | None = None) -> Outcome:
    """Replays on a new bus, with one process per service and the recorder. Raises SaccadeError if the log was recorded
    live, because the steps that a process takes then depend on time."""
    if replay.live:
        raise SaccadeError(f"log {replay.log} was recorded live: add --bus local, which takes the same steps")
    config = replay.config.with_values({"bus.endpoint": free_endpoint(replay.config.bus.endpoint)})
    names = ("router", *replay.into, "recorder")
    processes = [process for process in PROCESSES if process.name in names]
    with running(config, out, processes, None, say) as graph:
        playing = _Playing(replay, graph, Outcome(out / LOG_NAME), on_moved)
        outcome = playing.run(keys, say)
        graph.supervisor.stop()
        playing.drain()
    outcome.late_s = replay.pace.late_s
    outcome.comparison.set_aside(replay.holes.may_lack)
    return outcome


class _Playing:
    """Plays the log on one thread, takes the answers on another, and limits how far the first may be ahead."""

    def __init__(self, replay: Replay, graph: Graph, outcome: Outcome, on_moved: OnMoved | None) -> None:
        self._replay, self._graph, self.outcome = replay, graph, outcome
        self._twins, self._outbox = Twins(outcome.comparison, on_moved), Outbox()
        self._steps: dict[str, set[tuple[int, int]]] = {t.name: set() for t in replay.selection.topics}
        self._reached: dict[str, dict[tuple[str, str | None], int]] = {}  # by played topic: answers on each key
        self._error: BaseException | None = None
        for service in replay.services:
            for topic in (t for t in service.outputs if not t.latched and t in replay.outputs.topics):
                parts = replay.config.names if topic.parts else (None,)
                self._reached.setdefault(self._cause(service).name, {}).update({(topic.name, p): 0 for p in parts})

    def run(self, keys: Keys, say: Callable[[str], None]) -> Outcome:
        """Plays the log when the services are ready, until all is answered. Raises SaccadeError if no answer comes."""
        self._graph.bus.answer(self._replay.selection.topics, self._outbox.answer)
        thread = threading.Thread(target=self._play, args=(keys, say), name="player", daemon=True)
        waiting = {*self._replay.into, "recorder"}
        news_s = time.monotonic()
        for item in self._graph.messages:
            if item is not None and self._take(*item):
                news_s = time.monotonic()
            if waiting and item and item[1] and isinstance(item[2], Status) and item[2].state in READY_STATES:
                waiting.discard(item[1])
                if not waiting:
                    thread.start()
            if not waiting and not thread.is_alive() and self._behind() == 0:
                break
            if time.monotonic() - news_s > HALTED_S and self._behind():
                notes = [f"{n} {s.note}" for n, s in sorted(self.outcome.statuses.items()) if s.note]
                raise SaccadeError(f"the replay came to a halt: {'; '.join(notes) or 'nobody has anything to do'}")
        if self._error is not None:
            raise self._error
        return self.outcome

    def drain(self) -> None:
        """Takes the last messages of the processes."""
        while (item := next(self._graph.messages)) is not None:
            self._take(*item)

    def _take(self, topic: Topic, part: str | None, message: Message) -> bool:
        """Takes a message. Returns whether it was an answer."""
        if isinstance(message, Status) and part is not None:
            self.outcome.statuses[part] = message
            return False
        if topic not in self._replay.outputs.topics:
            return False
        self._twins.replayed(topic, part, encode(message))
        for answers in self._reached.values():
            if (topic.name, part) in answers:
                answers[topic.name, part] += 1
        return True

    def _cause(self, service: Service) -> Topic:
        """The played topic that makes a service step: its trigger, or the cause of the service that publishes the
        trigger."""
        makers = [other for other in self._replay.services if service.trigger in other.outputs]
        return self._cause(makers[0]) if makers else service.trigger

    def _behind(self) -> int:
        """How many steps were played and are not yet answered by all services."""
        return max((len(self._steps.get(cause, ())) - min(answers.values())
                    for cause, answers in self._reached.items()), default=0)

    def _play(self, keys: Keys, say: Callable[[str], None]) -> None:
        def may_go_on(stamp: Stamp) -> bool:
            return any((stamp.episode, stamp.step) in s for s in self._steps.values()) or self._behind() < WINDOW

        try:
            for entry, stamp in played(self._replay, keys, say, self.outcome, self._twins, may_go_on):
                self._steps[entry.topic.name].add((stamp.episode, stamp.step))
                self._outbox.keep(entry.topic, entry.part, stamp, entry.payload)
                self._graph.bus.publish(entry.topic, entry.part, entry.payload)
        except BaseException as error:
            self._error = error
