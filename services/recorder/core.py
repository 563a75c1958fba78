"""The recorder: a deep queue before a log. It takes everything and says what it did not get."""

from __future__ import annotations

import hashlib
import platform
import sys
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from shared.bus import Bus, ZenohBus
from shared.config import Config
from shared.messages import MessageError, decode
from shared.process import Health, Heartbeat, Inbox, Item, run_process
from shared.provenance import commit
from shared.recording import FLUSH_S, RecordingStopped, RunLog
from shared.stepper import GapCounter

NAME = "recorder"
LOG_NAME = "run.mcap"
QUEUE_BYTES = 512 * 1024 * 1024
PACKAGES = ("saccade", "eclipse-zenoh", "mcap", "msgpack", "numpy", "mujoco", "torch")


def main(argv: Sequence[str] | None = None) -> None:
    """The recorder's process; the log stands beside the configuration file. Exit code 2 if the log is not complete."""
    run_process(NAME, _work, inbox=Inbox(QUEUE_BYTES), argv=argv)


def _work(config: Config, folder: Path, inbox: Inbox) -> None:
    log = RunLog(folder / LOG_NAME, world=config.bus.world, configuration=config.model_dump_json(indent=2),
                 metadata=describe(config, folder.name))
    try:
        bus = ZenohBus(config.bus.endpoint, world=config.bus.world)
        try:
            bus.subscribe(None, inbox.put)
            health = record(log, bus, inbox)
        finally:
            bus.close()
    finally:
        log.close()
    if health.gaps:
        print(f"saccade: the log lacks {health.gaps} messages: {health.note}", file=sys.stderr)


def record(log: RunLog, bus: Bus, inbox: Inbox) -> Health:
    """Writes what arrives until the inbox is stopped. A log that can take no more does not stop the agent: it is said
    on the bus at once, and raised as RecordingStopped at the end."""
    health, gaps, stopped = Health(NAME), GapCounter(from_start=True), None
    with Heartbeat(bus, health, inbox.stop):
        health.say("ready")
        for item in inbox.items(tick_s=FLUSH_S):
            try:
                if item is None:
                    log.flush_if_due()
                else:
                    _take(item, log, health, gaps)
            except RecordingStopped as error:
                stopped = error
                health.say("not recording", str(error))
        try:
            log.close()
        except RecordingStopped as error:
            stopped = error
            health.say("not recording", str(error))
    if stopped is not None:
        raise stopped
    return health


def _take(item: Item, log: RunLog, health: Health, gaps: GapCounter) -> None:
    topic, part, payload = item
    health.received += 1
    sequence = 0
    try:
        message = decode(topic.type, payload)
        sequence = message.seq
        if lost := gaps.lost(topic, part, message):
            health.gaps += lost
            health.say(note=f"{lost} lost before {topic.name}{f'/{part}' if part else ''} {sequence}")
    except MessageError as error:  # recorded all the same: the log is what was on the wire
        health.refuse(topic, part, error)
    log.write(topic, part, payload, sequence=sequence)
    health.published = log.messages


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
