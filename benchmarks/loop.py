"""`python -m saccade.benchmarks.loop [out.json]` measures the steps per second of the closed loop.

It compares the bus, with and without the recorder, with the same cores in one process. The scenes are the same. The
ways take turns, round after round.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from rich.console import Console

from saccade.app.run.launch import PROCESSES, launch
from saccade.app.run.registry import local_pairs
from saccade.benchmarks.rounds import compared, in_turn
from saccade.shared.bus.topics import TRUTH
from saccade.shared.config import Config
from saccade.shared.loop.local import run_local

ROUNDS = 6
CONFIG = Config().with_values({"seed": 3, "scene.names": ["coffee_can", "cereal_box", "rice_box", "soup_can",
                                                          "squeeze_bottle"], "scene.count": 12})


class Clock:
    """Counts steps and seconds, from the first truth to the last."""

    def __init__(self) -> None:
        self.seen_s: list[float] = []

    def see(self, topic, part, message, payload=None) -> None:
        """Takes a message, as `on_message` does."""
        if topic == TRUTH:
            self.seen_s.append(time.perf_counter())

    @property
    def steps_per_s(self) -> float:
        """Steps per second in the closed loop."""
        return (len(self.seen_s) - 1) / (self.seen_s[-1] - self.seen_s[0])


def here() -> float:
    """Steps per second in this process. Each message is encoded and decoded as on the bus."""
    clock = Clock()
    run_local(local_pairs("sceneccn", CONFIG), CONFIG.names, "loop", on_message=clock.see, encoded=True)
    return clock.steps_per_s


def on_bus(recorder: bool) -> float:
    """Steps per second of processes on Zenoh."""
    clock = Clock()
    with tempfile.TemporaryDirectory() as folder:
        processes = [p for p in PROCESSES if recorder or p.name != "recorder"]
        launch(CONFIG, Path(folder) / "loop", clock.see, processes, topics=(TRUTH,))
    return clock.steps_per_s


def main() -> None:
    """Prints a table. With a file's name it writes the numbers there."""
    ways: dict[str, Callable[[], float]] = {"one process": here, "bus": partial(on_bus, False),
                                            "bus, recorded": partial(on_bus, True)}
    Console().print(compared(in_turn(ways, ROUNDS), "where", ("one process", "bus")))


if __name__ == "__main__":
    main()
