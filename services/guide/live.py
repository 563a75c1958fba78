"""The process of the page that guides a hand. It only listens: no service waits for it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from saccade.services.guide.core import SHOWN, Guide
from saccade.services.guide.server import PageServer
from saccade.shared.bus.topics import GOAL
from saccade.shared.bus.transport import Bus, ZenohBus
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.process import Health, Heartbeat, Inbox, messages_of, run_process
from saccade.shared.model.weights import Weights

NAME = "guide"
QUEUE_BYTES = 16 * 1024 * 1024  # of messages that wait; what does not fit is dropped


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the process of the page."""
    run_process(NAME, _work, inbox=Inbox(QUEUE_BYTES), argv=argv)


def _work(config: Config, folder: Path, inbox: Inbox) -> None:
    health = Health(NAME, at=(config.run or folder.name, 0, 0))
    guide = Guide(_sizes_m(config))
    with (closing(PageServer(config.viewer, guide)) as server,
          closing(ZenohBus(config.bus.endpoint, world=config.bus.world, onlooker=True)) as bus,
          Heartbeat(bus, health, inbox.stop)):
        health.say("ready", note=f"guides at port {server.port}")
        listen(bus, guide, inbox, health)


def listen(bus: Bus, guide: Guide, inbox: Inbox, health: Health) -> None:
    """Passes the messages of the run that `health` names to the guide, until the inbox is stopped."""
    bus.subscribe(SHOWN, inbox.put)
    for kept in bus.recall([GOAL], (health.at[0], 0, 0)):
        inbox.put(kept.topic, kept.part, kept.payload)
    for _, _, message in messages_of(inbox, health):
        guide.take(message)
        health.at = (message.run, message.episode, message.step)


def _sizes_m(config: Config) -> dict:
    """The sizes of the objects by name. Without weights nothing but the arrow and the frame is drawn."""
    try:
        return {card.name: card.size_m for card in Weights(config.weights).cards}
    except SaccadeError:
        return {}
