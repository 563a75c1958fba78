"""The recorder: a deep queue before a log. It takes everything and says what it did not get."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import platform
import sys
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from shared.bus import Bus, ZenohBus
from shared.config import Config
from shared.errors import SaccadeError
from shared.messages import MessageError, decode
from shared.outbox import KEPT_BYTES
from shared.process import Health, Heartbeat, Inbox, run_process
from shared.provenance import commit
from shared.reading import RunReader
from shared.recording import FLUSH_S, RecordingStopped, RunLog
from shared.stepper import GapCounter
from shared.topics import TOPICS, Topic

NAME = "recorder"
LOG_NAME = "run.mcap"
QUEUE_BYTES = 512 * 1024 * 1024
FILLED_AT = (1, 4)  # ticks without a message after which the publishers are asked: at the start, and after a pause
PACKAGES = ("saccade", "eclipse-zenoh", "mcap", "msgpack", "numpy", "mujoco", "torch")


def main(argv: Sequence[str] | None = None) -> None:
    """The recorder's process; the log stands beside the configuration file. Exit code 2 if the log is not complete."""
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
    """Writes what arrives into the run's log. What it missed, started again, late or cut off, it asks the publishers
    for; what they said twice is written once. A log of this run that is there already is gone on with."""

    def __init__(self, bus: Bus, folder: Path, config: Config) -> None:
        self.health, self._bus, self._run = Health(NAME), bus, folder.name
        self._gaps = GapCounter(from_start=True)
        self._newest = (0, 0)  # episode and step
        self.log = self._open(folder / LOG_NAME, config)

    def record(self, inbox: Inbox) -> Health:
        """Until the inbox is stopped. A log that can take no more does not stop the agent: it is said on the bus at
        once, and raised as RecordingStopped at the end."""
        health, stopped, idle = self.health, None, 0
        with Heartbeat(self._bus, health, inbox.stop):
            health.say("ready")
            for item in itertools.chain([None], inbox.items(tick_s=FLUSH_S)):
                try:
                    idle = 0 if item else idle + 1
                    if item is not None:
                        self._take(*item)
                    else:
                        self.log.flush_if_due()
                    if idle in FILLED_AT:
                        self._fill()
                except RecordingStopped as error:
                    stopped = error
                    health.say("not recording", str(error))
            try:
                self.log.close()
            except RecordingStopped as error:
                stopped = error
                health.say("not recording", str(error))
        if stopped is not None:
            raise stopped
        return health

    def _open(self, path: Path, config: Config) -> RunLog:
        before = path.with_suffix(".before.mcap")  # is there while a log is copied that a killed recorder left
        if path.exists() and not before.exists():
            path.rename(before)
        path.unlink(missing_ok=True)
        log = RunLog(path, world=config.bus.world, configuration=config.model_dump_json(indent=2),
                     metadata=describe(config, self._run))
        if before.exists():
            with contextlib.suppress(SaccadeError):  # killed before it wrote anything
                for topic, part, payload, time_ns in RunReader(before).entries():
                    self._write(log, topic, part, payload, time_ns)
            log.flush()
            before.unlink()
        return log

    def _take(self, topic: Topic, part: str | None, payload: bytes) -> None:
        self.health.received += 1
        try:
            message = decode(topic.type, payload)
            if self._gaps.lost(topic, part, message, note=False):
                self._fill()
        except MessageError as error:  # recorded all the same: the log is what was on the wire
            self.health.refuse(topic, part, error)
        self._write(self.log, topic, part, payload)
        self.health.published = self.log.messages

    def _fill(self) -> None:
        """Writes what the publishers know and the log does not have."""
        topics = [topic for topic in TOPICS.values() if topic.in_step]
        episode, step = self._newest
        kept = self._bus.recall(topics, (self._run, episode, max(0, step - 1)), KEPT_BYTES)
        for topic, part, payload, _, published_ns in sorted(kept, key=lambda k: k.published_ns):
            self._write(self.log, topic, part, payload, published_ns)

    def _write(self, log: RunLog, topic: Topic, part: str | None, payload: bytes, time_ns: int | None = None) -> None:
        sequence = 0
        with contextlib.suppress(MessageError):
            message = decode(topic.type, payload)
            lost = self._gaps.lost(topic, part, message)
            if lost is None:
                return
            if lost:
                self.health.gaps += lost
                self.health.say(note=f"{lost} lost before {topic.name}{f'/{part}' if part else ''} {message.seq}")
            sequence = message.seq
            if topic.in_step and message.run == self._run:
                self._newest = max(self._newest, (message.episode, message.step))
        log.write(topic, part, payload, sequence=sequence, log_time_ns=time_ns)


def describe(config: Config, run: str) -> dict[str, dict[str, str]]:
    """What the log says about its origin: configuration hash, seed, versions, weights' hashes."""
    text = config.model_dump_json()
    return {"run": {"run": run, "seed": str(config.seed), "commit": commit(),
                    "configuration_sha256": hashlib.sha256(text.encode()).hexdigest()},
            "versions": {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}},
            "weights_sha256": {str(p.relative_to(config.weights)): hashlib.sha256(p.read_bytes()).hexdigest()
                               for p in sorted(config.weights.glob("**/*.safetensors"))}}


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "absent"
