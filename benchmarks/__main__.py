"""`python -m saccade.benchmarks [out.json]` measures how cost grows, as ratios that mean the same on any machine.

Perception: K objects are compared with K times one object. They are also compared with what the processor could do: the
time that as many operations take in a large matrix product. Planning: 5,000 candidates are compared with a plain loop,
and 500 to 50,000 candidates with 5,000. Wire: encoding and decoding a frame is compared with copying its pixels. Each
figure is the median of several repetitions on one thread.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch.utils.flop_counter import FlopCounterMode

from saccade.services.perception.core import SceneCCN
from saccade.services.perception.seen import Seen
from saccade.services.planner.free_energy import expected_free_energy
from saccade.services.planner.goal import Preference
from saccade.shared.bus.messages import Belief, Frame
from saccade.shared.bus.wire import decode, encode
from saccade.shared.config import WEIGHTS
from saccade.shared.model.generative_model import Encoder, Stacked
from saccade.shared.model.weights import Weights
from saccade.shared.world.geometry import GRID_AZIMUTHS, GRID_ELEVATIONS, IMAGE_SIZE_PX, INTRINSICS_PX
from saccade.shared.world.windows import CROP_PX


def milliseconds(work: Callable[[], object], repetitions: int = 9) -> float:
    """Median time of a call, after one call to warm up."""
    work()
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


def perception() -> list[dict]:
    """Measures the CCN encoders of K objects in one call against a loop over them, and the whole of perception for K
    objects. There are weights for five objects; for more, the same ones are used again."""
    rows, one = [], 0.0
    for count in (1, 2, 5, 10, 20):
        stacked = Stacked([Encoder() for _ in range(count)])
        crops = torch.rand(count, 1, 4, CROP_PX, CROP_PX)
        together = milliseconds(partial(stacked, crops))
        looped = milliseconds(partial(stacked.one_by_one, crops))
        one = one or together
        rows.append({"what": f"encode {count} objects", "ms": together, "of a loop": together / looped,
                     f"of {count} x one": together / (count * one)})
    weights, one, rate = Weights(WEIGHTS / "pantry"), 0.0, operations_per_ms()
    image = np.random.default_rng(0).integers(0, 256, (IMAGE_SIZE_PX, IMAGE_SIZE_PX, 3), dtype=np.uint8)
    for count in (1, 2, 5, 10, 20):
        model = SceneCCN(weights, (weights.names * 4)[:count])

        def see(m: SceneCCN = model) -> Seen:
            return m.see(image, INTRINSICS_PX, (0.0, 1.0, 0.0))

        together = milliseconds(see)
        one = one or together
        with FlopCounterMode(display=False) as counter:
            see()
        rows.append({"what": f"perceive {count} objects", "ms": together, f"of {count} x one": together / (count * one),
                     "x the limit": together * rate / counter.get_total_flops()})
    return rows


def operations_per_ms(side: int = 1024) -> float:
    """Floating-point operations per millisecond in a large matrix product [side, side]. This is what the processor
    could do."""
    a, b = torch.rand(side, side), torch.rand(side, side)
    return 2 * side ** 3 / milliseconds(lambda: a @ b)


def _belief(name: str, deviation: float, rng: np.random.Generator) -> Belief:
    mean = rng.uniform(-0.2, 0.2, 3)
    posterior = rng.normal(size=(GRID_ELEVATIONS, GRID_AZIMUTHS)).astype(np.float32)
    return Belief(run="b", episode=0, step=0, object=name, presence=0.9, world_from_camera=np.eye(4), mean_m=mean,
                  covariance_m2=np.eye(3) * deviation ** 2, views=3, goal_log_posterior=posterior,
                  particles_m=(mean + rng.normal(0, deviation, (512, 3))).astype(np.float32))


def planning() -> list[dict]:
    """Measures G of N candidates at once, against a loop over single candidates, and the time per candidate against
    that with 5,000."""
    rng = np.random.default_rng(0)
    beliefs = {name: _belief(name, deviation, rng) for name, deviation in (("a", 0.01), ("b", 0.02), ("c", 0.2))}
    preference = Preference("a", 0.3, 0.025, np.zeros(2), np.array(INTRINSICS_PX), 0.9)

    def score(count: int) -> float:
        eyes, gazes = rng.uniform([-0.5, -0.5, 0.1], [0.5, 0.5, 0.6], (count, 3)), rng.uniform(-0.3, 0.3, (count, 3))
        return milliseconds(lambda: expected_free_energy(eyes, gazes, beliefs, preference, 1.0), 5)

    base, single = score(5_000), score(1)
    rows = [{"what": "5,000 candidates", "ms": base, "of a loop": base / (5_000 * single)}]
    for count in (500, 15_000, 50_000):
        cost = score(count)
        rows.append({"what": f"{count:,} candidates", "ms": cost,
                     "per candidate, of 5,000": cost / count / (base / 5_000)})
    return rows


def wire() -> list[dict]:
    """Measures encoding and decoding a frame against copying its pixels."""
    frame = Frame(run="b", episode=0, step=0, rgb=np.zeros((480, 480, 3), np.uint8), intrinsics_px=np.ones(4),
                  world_from_camera=np.eye(4))
    copied = milliseconds(lambda: frame.rgb.copy(), 50)
    rows = []
    payload = encode(frame)
    for what, work in (("encode a frame", lambda: encode(frame)), ("decode a frame", lambda: decode(Frame, payload))):
        cost = milliseconds(work, 50)
        rows.append({"what": what, "ms": cost, "of copying its pixels": cost / copied})
    return rows


def main() -> None:
    """Prints a table. With a file's name it writes the numbers there."""
    parser = argparse.ArgumentParser(prog="python -m saccade.benchmarks",
                                     description="Measures how cost grows, in some minutes on one thread.")
    parser.add_argument("out", nargs="?", type=Path, metavar="OUT.json", help="file for the numbers")
    out = parser.parse_args().out
    torch.set_num_threads(1)
    results = {"perception": perception(), "planning": planning(), "wire": wire()}
    table = Table("what", "ms", "ratio")
    for rows in results.values():
        for row in rows:
            ratios = ", ".join(f"{value:.2f} {key}" for key, value in row.items() if key not in ("what", "ms"))
            table.add_row(row["what"], f"{row['ms']:.2f}", ratios)
        table.add_section()
    Console().print(table)
    if out is not None:
        out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
