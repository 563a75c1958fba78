"""What all commands on logs need: the valid messages with their times, and outputs that are written whole or not at
all."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from saccade.app.run.display import say
from saccade.shared.bus.messages import Message
from saccade.shared.bus.wire import MessageError, decode
from saccade.shared.errors import SaccadeError
from saccade.shared.files import parse_json
from saccade.shared.log.folder import LOG_NAME
from saccade.shared.log.reading import Recorded, RunReader

SAY_EVERY = 50  # messages


def log_of(run: Path) -> Path:
    """Returns the log of a run. `run` is the run's folder or the log itself."""
    return run / LOG_NAME if run.is_dir() else run


class Log:
    """A log that is exported. Iterating yields every valid message with its entry.

    On `console` it says how far it is and, at the end, what the export lacks. Raises SaccadeError if the file is not a
    log or holds no message.
    """

    def __init__(self, path: Path, console: Console | None = None) -> None:
        self.reader = RunReader(path)
        self.console = console or Console(stderr=True)
        self.read = self.refused = 0

    def __iter__(self) -> Iterator[tuple[Recorded, Message]]:
        with self.console.status("reading") as status:
            for entry in self.reader.entries():
                try:
                    message = decode(entry.topic.type, entry.payload)
                except MessageError:
                    self.refused += 1
                    continue
                yield entry, message
                self.read += 1
                if self.read % SAY_EVERY == 0:
                    status.update(f"{self.read} messages of {escape(self.reader.path.name)}")
        if not self.read:
            raise SaccadeError(f"log {self.reader.path} holds no messages of Saccade: give the run.mcap of a run")
        for line in self.lacks.values():
            say(self.console, line)

    @property
    def lacks(self) -> dict[str, str]:
        """What an export of this log cannot hold, if there is anything: `cut` and `refused`. It is known when the log
        has been read."""
        refused = f"{self.refused} entries of {self.reader.path} are no valid messages and were left out"
        return ({"cut": self.reader.cut} if self.reader.cut else {}) | ({"refused": refused} if self.refused else {})

    @property
    def goal_view_is_known(self) -> bool:
        """Whether the goal's pose in the truth is that of the goal image. It is known from the first message on."""
        return setting_of(self.reader, "scene", "goal_image") is None and not setting_of(
            self.reader, "scene", "explore")


def setting_of(reader: RunReader, section: str, key: str) -> Any:
    """Returns the value of a key in the configuration that a log holds, or None if it holds none. It is known when the
    first entry has been read. It also works if the present Saccade would not accept the configuration."""
    try:
        tree = parse_json(reader.configuration or "{}")
    except ValueError:  # code that needs all of it reports the damage
        return None
    values = tree.get(section) if isinstance(tree, dict) else None
    return values.get(key) if isinstance(values, dict) else None


@contextmanager
def whole(out: Path) -> Iterator[Path]:
    """Yields a path beside `out`, for a file or a folder. It becomes `out` if all goes well, and is removed otherwise.
    Raises SaccadeError if `out` exists or cannot be written."""
    if out.exists():
        raise SaccadeError(f"{out} is there already: name a new place")
    partial = out.with_name(f"{out.name}.part")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        _remove(partial)
        yield partial
        partial.rename(out)
    except OSError as error:
        raise SaccadeError(f"{out} cannot be written: {error.strerror or error}") from error
    finally:
        _remove(partial)


@contextmanager
def extra() -> Iterator[None]:
    """Is put around imports that only exporting needs. Raises SaccadeError if a package is not installed."""
    try:
        yield
    except ImportError as error:
        what = error.name or error
        raise SaccadeError(f"exporting needs the package {what}: pip install 'saccade[export]'") from error


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()
