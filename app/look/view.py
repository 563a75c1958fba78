"""`saccade view` shows a run in Rerun's viewer, while it goes on or from its log. It can also write a file for
Rerun."""

from __future__ import annotations

import time
import webbrowser
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import rerun as rr
from rich.console import Console

from saccade.app.log.source import Log, log_of, whole
from saccade.app.look.listen import config_of, until_interrupted
from saccade.app.run.display import say
from saccade.services.viewer.core import Viewer
from saccade.services.viewer.live import QUEUE_BYTES, connected, watch
from saccade.services.viewer.priority import come_last
from saccade.services.viewer.server import Server, with_free_ports
from saccade.shared.bus.topics import GOAL_PERCEPT
from saccade.shared.bus.transport import ZenohBus
from saccade.shared.config import Config, ViewerConfig, recorded
from saccade.shared.log.folder import LOG_NAME
from saccade.shared.loop.process import Health, Inbox

POLL_S = 0.2


def view_log(path: Path, *, save: Path | None, truth: bool, port: int | None, open_page: bool, weights: Path | None,
             console: Console) -> None:
    """Shows a log until Ctrl-C, or writes it as a Rerun file to `save`. Raises SaccadeError if `path` is not a log."""
    path = log_of(path)
    log = Log(path, console)
    name = path.resolve().parent.name if path.name == LOG_NAME else path.stem
    recording = rr.RecordingStream("saccade", recording_id=name)
    if save is not None:
        with whole(save) as partial:
            try:
                recording.save(partial)
                _show(log, recording, truth, weights)
                recording.disconnect()
            except RuntimeError as error:  # Rerun's, whose thread has met a full disk and does not say so
                why = str(error) if "os error" in str(error) else f"perhaps the disk is full ({error})"
                raise OSError(why) from error
        say(console, f"written to {save}: `rerun {save}` shows it")
        return
    with Server(_ports(Config(), port).viewer) as server, connected(recording, server):
        say(console, f"{path} at {server.url} until Ctrl-C")
        if open_page:
            webbrowser.open(server.url)
        _show(log, recording, truth, weights)
        stay(lambda: server.running)


def view_live(*, endpoint: str | None, run: Path | None, truth: bool, port: int | None, open_page: bool,
              weights: Path | None, console: Console) -> None:
    """Shows a running run, from its start, until Ctrl-C. Raises SaccadeError if there is none."""
    config = _with_weights(config_of(endpoint=endpoint, run=run), weights)
    config = _ports(config, port).with_values({"viewer.truth": truth})
    come_last()
    inbox = Inbox(QUEUE_BYTES)
    with (closing(ZenohBus(config.bus.endpoint, world=config.bus.world, onlooker=True)) as bus,
          Server(config.viewer) as server):
        if not config.scene.names:
            names = sorted({kept.part for kept in bus.recall((GOAL_PERCEPT,)) if kept.part})
            config = config.with_values({"scene.names": names})
        say(console, f"{config.run or config.bus.endpoint} at {server.url} until Ctrl-C")
        if open_page:
            webbrowser.open(server.url)
        with until_interrupted(inbox.stop):
            lacks = watch(bus, server, config, inbox, Health("viewer", at=(config.run or "", 0, 0)))
        _tell(lacks, console)


def stay(running: Callable[[], bool]) -> None:
    """Waits until Ctrl-C, or until `running()` is false."""
    try:
        while running():
            time.sleep(POLL_S)
    except KeyboardInterrupt:
        return


def _ports(config: Config, port: int | None) -> Config:
    """Gives the viewer ports of its own, because the run's own viewer uses those of the configuration."""
    own = ViewerConfig()
    config = config.with_values({"viewer.address": own.address, "viewer.port": port or own.port,
                                 "viewer.data_port": own.data_port})
    return with_free_ports(config) if port is None else config


def _with_weights(config: Config, weights: Path | None) -> Config:
    return config if weights is None else config.with_values({"perception.weights": weights.resolve()})


def _show(log: Log, recording: rr.RecordingStream, truth: bool, weights: Path | None) -> None:
    """Shows every message of a log, then prints what could not be shown."""
    viewer = None
    for entry, message in log:
        if viewer is None:  # a log holds its configuration before the first message
            config = recorded(log.reader.configuration, f"the log {log.reader.path}")
            viewer = Viewer(recording, _with_weights(config, weights), truth=truth, live=False)
        viewer.take(entry.topic, entry.part, message)
    if viewer is not None:
        _tell(viewer.close(), log.console)


def _tell(lacks: list[str], console: Console) -> None:
    for text in lacks:
        say(console, text)
