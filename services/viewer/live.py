"""The viewer of a live run. It only listens: no service waits for it, and it drops messages if it is too slow."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from datetime import timedelta
from pathlib import Path

import rerun as rr

from saccade.services.viewer import SHOWN
from saccade.services.viewer.core import Viewer
from saccade.services.viewer.priority import come_last
from saccade.services.viewer.server import Server
from saccade.shared.bus.outbox import KEPT_BYTES
from saccade.shared.bus.sequences import Sequences
from saccade.shared.bus.topics import STATUS, Topic
from saccade.shared.bus.transport import Bus, ZenohBus
from saccade.shared.bus.wire import MessageError, decode
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.process import Health, Heartbeat, Inbox, run_process

NAME = "viewer"
QUEUE_BYTES = 64 * 1024 * 1024  # of messages that wait to be shown; what does not fit is dropped and counted
TICK_S = 0.5
WAITED_FOR = 10_000  # how many missing messages are remembered because they may still come late
BATCH_S = 0.5  # time between two batches for the browsers, which draw everything again for each batch


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the viewer's process."""
    run_process(NAME, _work, inbox=Inbox(QUEUE_BYTES), argv=argv)


def _work(config: Config, folder: Path, inbox: Inbox) -> None:
    come_last()
    health = Health(NAME, at=(config.run or folder.name, 0, 0))
    with (Server(config.viewer) as server,
          closing(ZenohBus(config.bus.endpoint, world=config.bus.world, onlooker=True)) as bus,
          Heartbeat(bus, health, inbox.stop)):
        watch(bus, server, config, inbox, health)


def watch(bus: Bus, server: Server, config: Config, inbox: Inbox, health: Health) -> list[str]:
    """Shows a run until the inbox is stopped. Returns texts that say what could not be shown.

    It begins with the start of the run, as far as the services still have its messages. `health` counts messages and
    names the run; if it names none, the run that is going on is shown. Raises SaccadeError if the server ends.
    """
    bus.subscribe(SHOWN, inbox.put)
    run = health.at[0]
    past = bus.recall([topic for topic in SHOWN if topic != STATUS], (run, 0, 0) if run else None, KEPT_BYTES)
    batches = rr.ChunkBatcherConfig.DEFAULT()
    batches.flush_tick = timedelta(seconds=BATCH_S)
    recording = rr.RecordingStream("saccade", recording_id=run or (past[0].at[0] if past else None),
                                   batcher_config=batches)
    with connected(recording, server):
        feed = _Feed(Viewer(recording, config, truth=config.viewer.truth, live=True), health)
        health.say(state="ready", note=server.page)
        for kept in sorted(past, key=lambda kept: kept.published_ns):
            feed.take(kept.topic, kept.part, kept.payload)
        past.clear()  # frees the memory, which may be hundreds of megabytes
        for item in inbox.items(tick_s=TICK_S):
            if not server.running:
                raise SaccadeError("viewer: Rerun's server has ended")
            if item is not None:
                feed.take(*item)
        return feed.viewer.close()


@contextmanager
def connected(recording: rr.RecordingStream, server: Server) -> Iterator[None]:
    """A context in which the recording is sent to the server."""
    recording.connect_grpc(server.data_url)
    try:
        yield
    finally:
        recording.disconnect()


class _Feed:
    """Passes each valid message to the viewer, once."""

    def __init__(self, viewer: Viewer, health: Health) -> None:
        self.viewer, self._health, self._run = viewer, health, health.at[0]
        self._sequences = Sequences()

    def take(self, topic: Topic, part: str | None, payload: bytes) -> None:
        """Decodes a message and passes it on, unless it is not valid, is of another run, or was passed on before."""
        self._health.received += 1
        with suppress(MessageError):  # the services that compute with the message count it as refused
            message = decode(topic.type, payload)
            if self._run and message.run != self._run and (topic != STATUS or message.run):
                return
            lost = self._sequences.take(topic, part, message)
            if lost is None:
                return
            if lost:
                self._note_lost(lost)
            self.viewer.take(topic, part, message)
            self._health.at = (message.run, message.episode, message.step)

    def _note_lost(self, lost: int) -> None:
        """Counts messages that did not come in order: they came faster than this process could take them."""
        self._health.gaps += lost
        self.viewer.dropped(self._health.gaps)
        if sum(self._sequences.missing.values()) > WAITED_FOR:
            self._sequences = Sequences()
