"""The recorder: it writes every message of the world into a log, and says which messages it did not get.

A long queue in front of the log takes the messages that arrive while it writes.
"""

from __future__ import annotations

import contextlib
import itertools
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path

from saccade.services.recorder.whole import Patience, Whole
from saccade.shared.bus.messages import Message, Status
from saccade.shared.bus.outbox import KEPT_BYTES
from saccade.shared.bus.sequences import Sequences
from saccade.shared.bus.topics import RESULT, TOPICS, Topic
from saccade.shared.bus.transport import Bus, LocalBus, ZenohBus
from saccade.shared.bus.wire import MessageError, decode
from saccade.shared.config import Config
from saccade.shared.errors import NAME_LIMIT, SaccadeError, printable, told
from saccade.shared.log.folder import LOG_NAME
from saccade.shared.log.provenance import describe
from saccade.shared.log.reading import RunReader
from saccade.shared.log.recording import AWAITED, FINISHED, FLUSH_S, RecordingStopped, RunLog
from saccade.shared.loop.episodes import NOT_RECORDING, RECORDER, stranger
from saccade.shared.loop.process import Health, Heartbeat, Inbox, Item, run_process

NAME = RECORDER
QUEUE_BYTES = 512 * 1024 * 1024
ASKED_AGAIN_S = 0.5  # time until missing messages are asked for again; it doubles with every attempt
MOST_INVALID_BYTES = 64 * 1024 * 1024  # of payloads that are not valid messages and are recorded all the same
PATIENCE_S = 5.0  # time until the next episode may begin although one lacks messages; a run that stands ends after 8
QUIET_S = 1.5  # after this time without a new message the publishers are asked for their latest ones


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the recorder's process. The log is in the folder of the configuration file.

    The exit code is 2 if the log is not complete.
    """
    run_process(NAME, _work, inbox=Inbox(QUEUE_BYTES), argv=argv)


def _work(config: Config, folder: Path, inbox: Inbox) -> None:
    bus = ZenohBus(config.bus.endpoint, world=config.bus.world)
    try:
        bus.subscribe(None, inbox.put)
        recorder = Recorder(bus, folder, config)
        try:
            health = recorder.record(inbox)
        finally:
            recorder.log.close()
    finally:
        bus.close()
    if health.gaps:
        print(f"saccade: the log lacks {health.gaps} messages: {health.note}", file=sys.stderr)


class Recorder:
    """Writes the messages that arrive into the run's log, each of them once.

    It may miss messages because it was started late or again, or because it was cut off from the bus. It asks the
    publishers for them. If there is already a log of this run, it is continued. Raises SaccadeError if the log cannot
    be written, or if it belongs to another run.
    """

    def __init__(self, bus: Bus, folder: Path, config: Config) -> None:
        self.health, self._bus, self._run = Health(NAME), bus, config.run or folder.name
        self._sequences = Sequences(from_start=True, cut=config.bus.first_step > 0)
        self._names = config.scene.names or ()
        self._left_out: set[str] = set()  # reasons for which the log did not take messages, each told once
        self._finished, self._invalid_bytes = False, 0
        self._sources = ("simulator", "camera") if config.bus.live else ("simulator",)
        self._follows_source = bool(config.bus.wait_for)  # what a replay plays may begin and go on anywhere
        self._episode = 0  # the episode that the source is in
        self._asked_s, self._ask_again_s, self._news_s = 0.0, ASKED_AGAIN_S, time.monotonic()
        others = {name for name in config.bus.wait_for if name != NAME}
        self._whole = Whole(self._run, others if self._awaited(config) else None)
        self._patience, self._came_s = Patience(others, PATIENCE_S), time.monotonic()
        self.log = self._open(folder / LOG_NAME, config)

    def record(self, inbox: Inbox) -> Health:
        """Records until the inbox is stopped. Returns its health, with the counters.

        If the log cannot be written any more, the agent continues. The recorder says so on the bus at once, and raises
        RecordingStopped at the end.
        """
        health, stopped = self.health, None
        works: Iterable[Callable[[], object]] = itertools.chain(
            [self._ask_for_news, lambda: health.say("ready")],
            (partial(self._work_off, item) for item in inbox.items(tick_s=FLUSH_S)), [self.log.close])
        with Heartbeat(self._bus, health, inbox.stop):
            for work in works:
                try:
                    work()
                except RecordingStopped as error:
                    stopped = error
                    health.say(NOT_RECORDING, str(error))
        if stopped is not None:
            raise stopped
        return health

    def _work_off(self, item: Item | None) -> None:
        """Takes a message, or does regular work if none has come for a while (None)."""
        if item is not None:
            self._take(*item)
        else:
            self.log.flush_if_due()
        self._tell_whole()
        if item is not None and item[0].in_step:
            self._news_s = self._came_s = time.monotonic()
        elif time.monotonic() - self._news_s >= QUIET_S:
            self._ask_for_news()
            self._ask_for_missing()
            self._news_s = time.monotonic()  # now: whoever never answers takes as long as may be waited for

    def _open(self, path: Path, config: Config) -> RunLog:
        """Opens the log, with the messages of a log that a killed recorder has left."""
        before = path.with_suffix(".before.mcap")  # the log that was left; it exists until it has been copied
        if path.exists() and not before.exists():
            path.rename(before)
        path.unlink(missing_ok=True)
        try:
            log = RunLog(path, world=config.bus.world, configuration=config.model_dump_json(indent=2),
                         metadata=describe(config, self._run) | (to_be_finished() if self._awaited(config) else {}))
            if before.exists():
                self._copy(before, log)
                before.unlink()
            return log
        except SaccadeError:
            if before.exists():  # so that nothing that was recorded is lost
                before.replace(path)
            raise

    @staticmethod
    def _awaited(config: Config) -> bool:
        """Whether a source waits for this recorder. The run of a live camera ends at any time."""
        return NAME in config.bus.wait_for and not config.bus.live

    def _copy(self, before: Path, log: RunLog) -> None:
        """Copies what the recorder had written before it was killed. Raises SaccadeError if it is of another run."""
        reader = None
        with contextlib.suppress(SaccadeError):  # the recorder was killed before it wrote anything
            reader = RunReader(before)
        if reader is not None:
            for topic, part, payload, time_ns in reader.entries():
                run = reader.metadata.get("run", {}).get("run")
                if run != self._run:
                    raise SaccadeError(f"log {log.path} is there already, of the run {run}: move it away")
                self._write(log, topic, part, payload, self._checked(topic, part, payload), time_ns)
            if FINISHED in reader.metadata:
                self._finish(log, reader.metadata[FINISHED].get("episodes", ""))
        log.flush()

    def _take(self, topic: Topic, part: str | None, payload: bytes) -> None:
        self.health.received += 1
        message = self._checked(topic, part, payload)
        is_own = message is not None and message.run == self._run and self._ahead(topic, message) is None
        if is_own and message is not None and self._sequences.begins(topic, part, message):
            # A new episode begins. The last messages of the episode before may be lost, so they are asked for.
            self._write_kept([topic], self._whole.last.get((topic.name, part), (message.episode, 0)))
        self._write(self.log, topic, part, payload, message)
        self.health.published = self.log.messages
        self._ask_for_missing()
        if topic == RESULT and is_own and message is not None:
            self._ask_for_held(message.episode)

    def _tell_whole(self) -> None:
        """Says in its status which episode comes next, once everything of the one before is in the log. The source
        waits for this, so that no service forgets an episode that the log lacks a part of."""
        due = None
        while self._whole.is_over:
            if not self._whole.is_whole or self._sequences.lacks(self._run, self._whole.episode):
                if not self._patience.is_over(time.monotonic(), self._came_s):
                    break
                self._whole.give_up()
            due = self._whole.next()
        if due is not None:
            self.log.flush()
            self.health.at = (self._run, due, 0)
            self.health.changed.set()

    def _ask_for_news(self) -> None:
        """Asks for the newest messages. If the newest is lost, there is no later one whose number would show this."""
        episode, step = max(self._whole.last.values(), default=(0, 0))
        self._write_kept([t for t in TOPICS.values() if t.in_step and not t.latched], (episode, max(0, step - 1)))
        self._ask_for_held(episode)

    def _ask_for_held(self, episode: int) -> None:
        """Asks for the latched messages of an episode. Each comes once per episode, so no number shows its loss."""
        for topic in (topic for topic in TOPICS.values() if topic.latched):
            keys = [(topic.name, name) for name in self._names] if topic.parts else [(topic.name, None)]
            if not all(self._sequences.has_begun(key, self._run, episode) for key in keys):
                self._write_kept([topic], (episode, 0))

    def _ask_for_missing(self) -> None:
        """Asks for missing messages from time to time, less often with every attempt.

        It keeps asking, because a publisher may first have to connect to the bus again.
        """
        missing = self._sequences.missing
        self.health.gaps = sum(missing.values())
        if not missing:
            self._ask_again_s, self._asked_s = ASKED_AGAIN_S, 0.0
        elif time.monotonic() - self._asked_s >= self._ask_again_s:
            self._asked_s, self._ask_again_s = time.monotonic(), 2 * self._ask_again_s
            self.health.say(note=f"{self.health.gaps} lost: " + ", ".join(sorted(
                f"{name}{f'/{part}' if part else ''}" for name, part in missing)))
            self._write_kept([TOPICS[name] for name in sorted({name for name, _ in missing})],
                             (self._sequences.first_missing, 0))

    def _write_kept(self, topics: Sequence[Topic], since: tuple[int, int]) -> None:
        """Asks the publishers for the messages that they have kept since (episode, step), and writes them."""
        kept = self._bus.recall(topics, (self._run, *since), KEPT_BYTES)
        for topic, part, payload, _, published_ns in sorted(kept, key=lambda k: k.published_ns):
            self._write(self.log, topic, part, payload, self._checked(topic, part, payload), published_ns)

    def _checked(self, topic: Topic, part: str | None, payload: bytes) -> Message | None:
        """Decodes a message. Returns None if it is not valid, so that it does not take the number of a valid one.

        A message that is not valid is recorded all the same, because the log holds what was on the bus.
        """
        try:
            return decode(topic.type, payload)
        except MessageError as error:
            self.health.refuse(topic, part, error)
            return None

    def _write(self, log: RunLog, topic: Topic, part: str | None, payload: bytes, message: Message | None,
               time_ns: int | None = None) -> None:
        """Writes a message once. One that cannot be of this run is refused, and so is one that the log does not
        take."""
        if (reason := log.refusal(topic, part, payload)) is not None:
            self._leave_out(topic, part, reason)
            return
        if message is None:
            self._invalid_bytes += len(payload)
            if self._invalid_bytes > MOST_INVALID_BYTES:
                self._leave_out(topic, part, f"a log takes {MOST_INVALID_BYTES} bytes of messages that are not valid")
                return
        else:
            if (reason := self._strange(topic, part, message)) is not None:
                self.health.refuse(topic, part and printable(part, NAME_LIMIT), f"{reason}, and is not recorded")
                return
            self._follow(log, topic, part, message)
            self._whole.take(topic, part, message)
            if (lost := self._sequences.take(topic, part, message)) is None:
                return
            if lost and time_ns is None:  # the missing ones come first, so that the log is in order
                self._ask_for_missing()
        log.write(topic, part, payload, sequence=message.seq if message else 0, log_time_ns=time_ns)

    def _strange(self, topic: Topic, part: str | None, message: Message) -> str | None:
        """Says why a message cannot be of this run. Returns None if it may be."""
        if isinstance(message, Status):
            return stranger(message, part, self._run)
        if message.run != self._run:
            return f"it is of the run {told(message.run)}, not of {told(self._run)}"
        if topic.parts and self._names and part not in self._names:
            return f"{told(part)} is not an object of this run"
        return self._ahead(topic, message)

    def _ahead(self, topic: Topic, message: Message) -> str | None:
        """Says why a message cannot be there yet: the next episode has not begun when its result comes, or the one
        after it. Returns None if the message may be there."""
        last = self._episode + (topic != RESULT)
        if not self._follows_source or not topic.in_step or message.episode <= last:
            return None
        return f"it is of episode {message.episode}, while episode {self._episode} goes on"

    def _follow(self, log: RunLog, topic: Topic, part: str | None, message: Message) -> None:
        """Notes which episode the source is in, and that it has finished. While the recorder was away, several episodes
        may have gone by: the source says which one it is in."""
        if isinstance(message, Status):
            self._patience.heard(part, time.monotonic())
            if part in self._sources and message.run:
                self._episode = max(self._episode, message.episode)
                if message.state == "finished" and message.episode == self._episode:
                    self._finish(log, message.episode + 1)
        elif topic != RESULT and message.episode == self._episode + 1:
            self._episode += 1

    def _leave_out(self, topic: Topic, part: str | None, reason: str) -> None:
        """Counts a message that the log does not take, and names the first for each reason."""
        if reason in self._left_out:
            self.health.refused += 1
            return
        self._left_out.add(reason)
        self.health.refuse(topic, part and printable(part, NAME_LIMIT), f"{reason}: more is not recorded")
        print(f"saccade: {NAME}: {self.health.note}", file=sys.stderr, flush=True)

    def _finish(self, log: RunLog, episodes: int | str) -> None:
        """Notes in the log that the source has finished."""
        if not self._finished:
            self._finished = True
            log.note(FINISHED, {"episodes": episodes})


def complete(folder: Path, config: Config) -> None:
    """Gives the log in a run's folder its end, if a recorder was killed before it could: every whole message once, and
    an index. What the log lacks is not asked for, so no bus is needed. Raises SaccadeError if it cannot be written."""
    Recorder(LocalBus(), folder, config).log.close()


def to_be_finished() -> dict[str, dict[str, str]]:
    """Metadata of the log of a run whose source says when it is over. `saccade log check` then asks whether it did."""
    return {AWAITED: {FINISHED: "when the source has finished its last episode"}}
