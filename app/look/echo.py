"""`saccade echo` prints messages as text, a block for each. Malformed messages are shown too."""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from saccade.app.log.source import log_of
from saccade.app.look.listen import Heard, Live, Logged, Wanted, live, until_interrupted
from saccade.shared.bus.messages import Message
from saccade.shared.bus.wire import MessageError, decode

MOST_NUMBERS = 16  # an array with at most so many numbers is printed in full
HEADER = ("run", "episode", "step", "seq")


def echo(key: str, *, log: Path | None, count: int | None, endpoint: str | None, run: Path | None) -> None:
    """Prints the messages on the keys that match a pattern, from a running run or from a log. Raises SaccadeError if no
    message can come."""
    wanted = Wanted.parse(key)
    try:
        if log is not None:
            show(Logged(wanted, log_of(log)), count)
        else:
            with closing(live(wanted, endpoint=endpoint, run=run)) as source:
                show(source, count)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of the output has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def show(source: Live | Logged, count: int | None, write: Callable[[str], Any] = print) -> int:
    """Writes up to `count` messages, and says how many were dropped. Returns how many were shown."""
    shown, told = 0, 0
    with until_interrupted(source.stop) if isinstance(source, Live) else nullcontext():
        for heard in source.heard():
            told = _say_dropped(source, told, write)
            if heard is not None:
                write("\n".join(block(heard, source.world)) + "\n")
                shown += 1
                if count is not None and shown >= count:
                    break
    _say_dropped(source, told, write)
    if isinstance(source, Logged) and source.reader.cut and (count is None or shown < count):
        write(source.reader.cut)
    return shown


def _say_dropped(source: Live | Logged, told: int, write: Callable[[str], Any]) -> int:
    dropped = source.dropped
    if dropped > told:
        write(f"{dropped - told} messages were dropped: they came faster than they could be shown\n")
    return dropped


def block(heard: Heard, world: str) -> Iterator[str]:
    """Yields the lines of one message."""
    when = datetime.fromtimestamp(heard.time_ns / 1e9, UTC).strftime("%H:%M:%S.%f")[:-3]
    title = f"{text(heard.topic.key(world, heard.part))}  {when} UTC, {len(heard.payload):,} bytes"
    try:
        message = decode(heard.topic.type, heard.payload)
    except MessageError as error:
        yield f"{title}\n  malformed: {text(str(error))}"
        return
    yield f"{title}, " + ", ".join(f"{name} {text(str(getattr(message, name)))}" for name in HEADER)
    yield from fields(message)


def fields(message: Message) -> Iterator[str]:
    """Yields a line for every field."""
    for field in dataclasses.fields(message):
        if field.name not in HEADER:
            yield f"  {field.name}: {told(getattr(message, field.name))}"


def told(value: Any) -> str:
    """Returns a value as one line."""
    if isinstance(value, np.ndarray):
        return of_array(value)
    if isinstance(value, list):
        return ", ".join(text(item) if isinstance(item, str) else "(" + "; ".join(
            line.strip() for line in fields(item)) + ")" for item in value) or "none"
    if isinstance(value, float):
        return f"{value:.6g}"
    return "none" if value is None else text(str(value))


def of_array(value: np.ndarray) -> str:
    """Describes an array: its type and shape, then all its numbers if they are few, else the minimum, the mean and the
    maximum."""
    kind = f"{value.dtype.str[1:]} {list(value.shape)}"
    if value.size == 0:
        return f"{kind}, empty"
    if value.size <= MOST_NUMBERS:
        numbers = np.array2string(value, separator=", ", max_line_width=10_000,
                                  formatter={"all": _number})
        return f"{kind} " + " ".join(numbers.split())
    return f"{kind}, min {value.min():.6g}, mean {value.mean(dtype=np.float64):.6g}, max {value.max():.6g}"


def _number(value: Any) -> str:
    return f"{value + 0:.6g}"


def text(words: str) -> str:
    """Returns words as they are if they are printable. Otherwise they are escaped, so that they cannot control a
    terminal."""
    return words if words.isprintable() else repr(words)
