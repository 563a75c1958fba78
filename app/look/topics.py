"""`saccade topics` lists the topics that exist, those on the bus of a running run, or those in a log."""

from __future__ import annotations

import threading
import time
from contextlib import closing
from pathlib import Path

from rich.console import Console
from rich.table import Table

from saccade.app.log.info import gather
from saccade.app.log.source import log_of
from saccade.app.log.traffic import Keys
from saccade.app.look.listen import Live, Wanted, live, until_interrupted
from saccade.app.run.display import cell, say
from saccade.shared.bus.topics import ROOT, TOPICS, Topic
from saccade.shared.bus.wire import MessageError, stamp_of
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError

LISTEN_S = 2


def topics(*, world: str | None, log: Path | None, on_bus: bool, seconds: int | None, endpoint: str | None,
           run: Path | None, console: Console) -> None:
    """Prints the topics that exist, the keys in a log, or the keys on which a message comes within some seconds. Raises
    SaccadeError if options contradict each other, or if no message can come."""
    on_bus = on_bus or any(given is not None for given in (seconds, endpoint, run))
    if log is not None and (on_bus or world is not None):
        raise SaccadeError("--log is for a log, which names its world: leave it or the other options out")
    if log is not None:
        _show_log(log_of(log), console)
    elif on_bus:
        _show_bus(Wanted.parse(f"{ROOT}/{world or '*'}/*"), endpoint, run, seconds or LISTEN_S, console)
    else:
        console.print(registry(world or Config().bus.world), markup=False)


def registry(world: str) -> Table:
    """Returns a table with a row for each topic that exists."""
    table = Table()
    for header in ("topic", "key", "message", "how often", "what it is"):
        table.add_column(header, no_wrap=header != "what it is")
    for topic in TOPICS.values():
        often = "once an episode" if topic.latched else "every step" if topic.in_step else "twice a second"
        about = (topic.type.__doc__ or "").strip().split("\n")[0]
        key = topic.key(world, "<part>" if topic.parts else None)
        table.add_row(topic.name, cell(key), topic.type.__name__, often, about)
    return table


def survey(source: Live, seconds: float) -> Keys:
    """Counts what comes on a bus for so many seconds, or until Ctrl-C. Messages that hold for the episode and came
    before are counted too. There is no queue here, so nothing is dropped."""
    keys, lock = Keys(), threading.Lock()

    def take(topic: Topic, part: str | None, payload: bytes, time_ns: int | None = None) -> None:
        try:
            stamp = stamp_of(payload)
        except MessageError:
            stamp = None
        with lock:
            keys.take(topic, part, len(payload), time_ns or time.time_ns(), stamp)

    with until_interrupted(source.stop):
        for heard in source.earlier():
            take(*heard)
        source.listen(take)
        source.inbox.stopping.wait(seconds)
    return keys


def _show_log(log: Path, console: Console) -> None:
    info = gather(log)
    if info.keys.found:
        console.print(info.keys.table(info.reader.world), markup=False)
    else:
        say(console, f"log {log} holds no message")
    if info.reader.cut:
        say(console, info.reader.cut)


def _show_bus(wanted: Wanted, endpoint: str | None, run: Path | None, seconds: int, console: Console) -> None:
    with closing(live(wanted, endpoint=endpoint, run=run)) as source, console.status(f"listening for {seconds} s"):
        keys = survey(source, seconds)
    if keys.found:
        console.print(keys.table(source.world), markup=False)
    else:
        say(console, f"nothing was heard in world {source.world!r}: listen longer with --seconds, or name another "
                     "--world")
