"""Exports the log of a run for other tools: as MCAP that Foxglove and Rerun can show, and as tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

from mcap.writer import Writer
from rich.console import Console

from saccade.app.log.source import Log, extra, whole
from saccade.app.run.display import Progress
from saccade.shared.log.recording import CONFIGURATION

VALUES = "/values"


def export_foxglove(log: Path, out: Path, *, console: Console | None = None) -> dict[str, int]:
    """Writes a run's log as MCAP of Foxglove's messages, with the times of the log. Returns the number of messages on
    each topic.

    The topics `/camera/...`, `/goal/...`, `/belief/<object>/...`, `/plan/...` and `/truth/...` can be looked at. The
    numbers of every message are on `/values/<topic>[/<part>]` and can be plotted. A log that was cut is exported up to
    the cut; this is said on `console` (by default standard error) and in the file. Raises SaccadeError if `log` is not
    a log, if `out` exists or cannot be written, or if a package is missing.
    """
    with extra():
        from saccade.app.log.foxglove import Scene
        from saccade.app.log.plottable import Values

    source = Log(log, console)
    shown: tuple[Scene, Progress] | None = None
    with whole(out) as partial, partial.open("wb") as stream:
        file = FoxgloveFile(stream)
        for entry, message in source:
            if shown is None:
                known = source.goal_view_is_known
                shown = Scene(goal_view_is_known=known), Progress(judged=known)
                file.attach(CONFIGURATION, source.reader.configuration, entry.log_time_ns)
            scene, progress = shown
            for name, told in scene.take(entry.topic, entry.part, message, entry.log_time_ns):
                file.write(name, told, entry.log_time_ns)
            progress.take(entry.topic, entry.part, message)
            name = "/".join(filter(None, (VALUES, entry.topic.name, entry.part)))
            file.write(name, Values(message, progress), entry.log_time_ns)
        file.close(source.reader.metadata | {"export": {"log": log.name} | source.lacks})
    return file.counts


def export_tables(log: Path, folder: Path, *, console: Console | None = None) -> list[Path]:
    """Writes `<topic>.parquet` into a new folder for every topic of a run's log, with a row for each message. Returns
    the files.

    It says what is missing, and raises SaccadeError, in the same way as `export_foxglove`.
    """
    with extra():
        from saccade.app.log.tables import Table

    source, tables = Log(log, console), {}
    with whole(folder) as partial:
        partial.mkdir()
        try:
            for entry, message in source:
                if entry.topic not in tables:
                    tables[entry.topic] = Table(partial / f"{entry.topic.name}.parquet", entry.topic)
                tables[entry.topic].add(entry, message)
        finally:
            for table in tables.values():
                table.close(source.lacks)
    return [folder / table.path.name for table in tables.values()]


class FoxgloveFile:
    """An MCAP file of messages that know their schema and encode themselves: Foxglove's own messages, and `Values`."""

    def __init__(self, stream: BinaryIO) -> None:
        self.counts: dict[str, int] = {}
        self._writer = Writer(stream)
        self._writer.start(library="saccade")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def write(self, topic: str, message: Any, time_ns: int) -> None:
        """Appends a message. The first message of a topic opens its channel."""
        if topic not in self._channels:
            schema = message.get_schema()
            if schema.name not in self._schemas:
                self._schemas[schema.name] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
            self._channels[topic] = self._writer.register_channel(topic, schema.encoding, self._schemas[schema.name])
        sequence = self.counts.get(topic, 0)
        self._writer.add_message(self._channels[topic], time_ns, message.encode(), time_ns, sequence)
        self.counts[topic] = sequence + 1

    def attach(self, name: str, text: str | None, time_ns: int) -> None:
        """Attaches a text as a file, if there is one."""
        if text is not None:
            self._writer.add_attachment(time_ns, time_ns, name, "application/json", text.encode())

    def close(self, metadata: dict[str, dict[str, str]]) -> None:
        """Writes the metadata and the index."""
        for name, values in metadata.items():
            self._writer.add_metadata(name, values)
        self._writer.finish()
