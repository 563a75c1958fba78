"""`python -m saccade.benchmarks.perception [OUT.json] [--known N]` measures perception of the agents `open` and
`sceneccn` on the same images of the five objects of YCB, and tells what takes the time of `open`.

Both look at every image in turn, and processor time is measured, so that ratios hold also where other programs use the
machine. With `--known N` the agent `open` knows N objects. Those beyond the five stand on no table: the views and the
landmarks in their banks are those of strangers.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from rich.console import Console
from rich.table import Table

from saccade.app.run.registry import configuration
from saccade.app.run.threads import limit_torch
from saccade.benchmarks.rounds import ratio
from saccade.services.perception import open_world
from saccade.services.perception.core import Model, model_of
from saccade.services.perception.landmark_fit import LandmarkFit
from saccade.services.perception.local_features import LocalFeatures
from saccade.services.perception.open_world import OpenWorld
from saccade.services.perception.placed import Placed
from saccade.services.perception.proposer import Proposer
from saccade.services.simulator.scenes import generate_scene
from saccade.shared.errors import SaccadeError
from saccade.shared.files import write_json
from saccade.shared.model.bank import Bank
from saccade.shared.model.weights import weights_in_use
from saccade.shared.render.objects import load_mesh, names_in_use
from saccade.shared.render.world import World
from saccade.shared.world.geometry import INTRINSICS_PX, Array, direction, look_at

OBJECTS, TABLES, VIEWS, ROUNDS = "ycb", 4, 4, 3
RANGES_M, ELEVATIONS_RAD = (0.35, 0.7), (0.4, 1.1)
PARTS: dict[str, tuple[Any, str]] = {  # functions that do not call one another
    "finding local features": (LocalFeatures, "__call__"), "fitting landmarks": (LandmarkFit, "__call__"),
    "cutting out crops": (OpenWorld, "_cut"), "comparing with known views": (OpenWorld, "_compared"),
    "encoding crops, also rolled": (OpenWorld, "rolled_things"), "proposals from votes": (open_world, "propose"),
    "the network that votes": (Proposer, "forward"), "how objects are turned": (Placed, "modes")}

Image = tuple[np.ndarray, Array]


def images() -> Iterator[Image]:
    """Images of tables with all objects, and what is up in the camera's frame."""
    meshes = [load_mesh(OBJECTS, name) for name in _names()]
    world, rng, middle = World(tuple(meshes)), np.random.default_rng(11), np.array([0.0, 0.0, 0.05])
    for _ in range(TABLES):
        scene = generate_scene(rng, {mesh.name: mesh.size_m for mesh in meshes}, meshes[0].name, len(meshes))
        world.place({each.name: (each.center_m, each.yaw_rad) for each in scene.on_table})
        for _ in range(VIEWS):
            towards = direction(rng.uniform(-np.pi, np.pi), rng.uniform(*ELEVATIONS_RAD))
            camera = look_at(middle + rng.uniform(*RANGES_M) * towards, middle)
            yield world.render(camera).copy(), camera[2, :3]
    world.close()


def _names() -> tuple[str, ...]:
    return names_in_use(configuration(None, {"scene.objects": OBJECTS})[0].scene)


def model(agent: str) -> Model:
    """The networks of an agent, for the five objects."""
    config = configuration(None, {"scene.objects": OBJECTS}, agent)[0]
    return model_of(weights_in_use(config), _names(), config.perception.passes)


def knowing(known: OpenWorld, count: int) -> OpenWorld:
    """The same networks, which know `count` objects: also some that are nowhere."""
    rng, strangers = np.random.default_rng(12), known.cohort.vectors.numpy()

    def nowhere(like: Bank, number: int) -> Bank:
        vectors = strangers[rng.integers(len(strangers), size=len(like.vectors))] + 0.02 * rng.normal(
            size=like.vectors.shape)
        codes = rng.permuted(like.landmarks.codes, axis=1)
        return replace(like, name=f"{like.name}-{number}", landmarks=replace(like.landmarks, codes=codes),
                       vectors=(vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32))

    banks = known.banks + [nowhere(known.banks[n % len(known.banks)], n) for n in range(count - len(known.banks))]
    return OpenWorld(known.proposer, known.encoder, known.comparison, known.features, banks, known.cohort,
                     known.log_odds)


@contextmanager
def parts() -> Iterator[dict[str, float]]:
    """Counts the processor seconds of each part."""
    spent: dict[str, float] = defaultdict(float)

    def timed(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def work(*arguments: Any, **options: Any) -> Any:
            start = time.process_time()
            try:
                return function(*arguments, **options)
            finally:
                spent[part] += time.process_time() - start
        return work

    with ExitStack() as stack:
        for part, (owner, name) in PARTS.items():
            stack.enter_context(patch.object(owner, name, timed(part, getattr(owner, name))))
        yield spent


def seconds(eyes: Model, image: Image) -> float:
    """How long a look takes, in processor seconds."""
    start = time.process_time()
    eyes.see(image[0], INTRINSICS_PX, image[1])
    return time.process_time() - start


def measure(count: int) -> dict[str, Any]:
    """The times (ms) of both, and of the parts of `open`, where it knows `count` objects."""
    shown, default, known = list(images()), model("sceneccn"), model("open")
    assert isinstance(known, OpenWorld)
    known = knowing(known, count)
    taken: dict[str, list[float]] = {"open": [], "sceneccn": []}
    for image in shown:  # what they have seen, they may keep
        seconds(default, image), seconds(known, image)
    with parts() as spent:
        for _ in range(ROUNDS):
            for image in shown:
                taken["open"].append(1e3 * seconds(known, image))
                taken["sceneccn"].append(1e3 * seconds(default, image))
    looks = ROUNDS * len(shown)
    spent["the rest"] = sum(taken["open"]) / 1e3 - sum(spent.values())
    return {"known": count, "images": len(shown), "ms": taken,
            "parts_ms": {part: 1e3 * each / looks for part, each in sorted(spent.items(), key=lambda one: -one[1])}}


def main() -> None:
    """Prints a table. With a file's name it writes the numbers there."""
    parser = argparse.ArgumentParser(prog="python -m saccade.benchmarks.perception", description=__doc__)
    parser.add_argument("out", type=Path, nargs="?")
    parser.add_argument("--known", type=int, default=5, metavar="N")
    options = parser.parse_args()
    limit_torch()
    results = measure(options.known)
    mean = {agent: float(np.mean(each)) for agent, each in results["ms"].items()}
    table = Table(f"perception, {results['known']} objects known", "ms", "of sceneccn")
    for agent, each in mean.items():
        table.add_row(agent, f"{each:.1f}", ratio(results["ms"][agent], results["ms"]["sceneccn"]))
    for part, each in results["parts_ms"].items():
        table.add_row(f"  {part}", f"{each:.1f}", f"{each / mean['sceneccn']:.2f}")
    Console().print(table)
    if options.out is not None:
        try:
            write_json(options.out, results, "results")
        except SaccadeError as error:
            parser.exit(2, f"saccade: {error}\n")


if __name__ == "__main__":
    main()
