"""python -m saccade.tests.fakes.onlooker --config FILE: takes every message and does nothing with it."""

from contextlib import closing

from saccade.shared.bus.transport import ZenohBus
from saccade.shared.loop.process import Health, Heartbeat, run_process


def work(config, folder, inbox):
    health = Health("replayer", state="ready", at=(folder.name, 0, 0))
    with closing(ZenohBus(config.bus.endpoint, world=config.bus.world)) as bus, Heartbeat(bus, health):
        for _ in inbox.items():
            pass


if __name__ == "__main__":
    run_process("onlooker", work)
