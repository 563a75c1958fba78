"""`python -m saccade.benchmarks.crowd [out.json]` compares a step with fifteen objects on the table with one with five.

The scenes are heaps of fifteen objects of YCB, drawn as in the suite `crowd`, and the same heaps with the target and
four others alone. The agent explores, so that it comes to know what is there. Both take turns, round after round.
"""

from __future__ import annotations

import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import count, islice
from pathlib import Path
from statistics import fmean

import numpy as np
from rich.console import Console
from rich.table import Table

from saccade.app.run.registry import Pair, configuration, local_pairs
from saccade.benchmarks.rounds import in_turn, ratio
from saccade.services.simulator.scene import Scene
from saccade.services.simulator.scenes import save_scenes
from saccade.services.simulator.tables import draw_table
from saccade.shared.loop.local import run_local
from saccade.shared.render.objects import load_mesh, names_in_use

MANY, FEW, HEAPS, STEPS, ROUNDS = 15, 5, 2, 20, 4
SERVICES = ("perception", "belief", "planner")
NAMES = names_in_use(configuration(None, {"scene.objects": "ycb"})[0].scene)
KEYS = {"scene.objects": "ycb", "scene.names": list(NAMES), "scene.explore": True, "simulator.max_steps": STEPS}


def heaps() -> Iterator[Scene]:
    """Heaps of fifteen objects, the same every time."""
    meshes = {name: load_mesh("ycb", name) for name in NAMES}
    drawn = (draw_table("crowd", np.random.default_rng([31, k]), meshes, NAMES[k % len(NAMES)], 0, f"heap-{k}")
             for k in count())
    return islice((scene for scene in drawn if len(scene.objects) == MANY), HEAPS)


def alone(scene: Scene) -> Scene:
    """The same scene with its target and four others of its objects only."""
    others = [placed for placed in scene.objects if placed is not scene.target_placed]
    return replace(scene, objects=(scene.target_placed, *others[:FEW - 1]))


def built(scenes: Sequence[Scene], folder: Path) -> list[Pair]:
    """The cores of the agent `open` and of a simulator of these scenes."""
    folder.mkdir()
    save_scenes(folder / "scenes.json", scenes)
    config, agent = configuration(None, {**KEYS, "scene.file": str(folder / "scenes.json")}, "open")
    return local_pairs(agent, config)


def milliseconds(pairs: list[Pair], spent: dict[str, list[float]]) -> float:
    """The mean milliseconds of a step of the agent. Those of each of its services are added to `spent`."""
    taken: dict[str, float] = defaultdict(float)

    def see(service: str, taken_ms: float) -> None:
        taken[service] += taken_ms / (HEAPS * STEPS)

    run_local(pairs, NAMES, "crowd", on_step=see)
    for service in SERVICES:
        spent[service].append(taken[service])
    return sum(taken[service] for service in SERVICES)


def main() -> None:
    """Prints a table. With a file's name it writes the numbers of all rounds there."""
    many = list(heaps())
    spent: dict[int, dict[str, list[float]]] = {number: defaultdict(list) for number in (FEW, MANY)}
    with tempfile.TemporaryDirectory() as folder:
        ways = {f"{number} objects": partial(milliseconds, built(scenes, Path(folder) / str(number)), spent[number])
                for number, scenes in ((FEW, [alone(scene) for scene in many]), (MANY, many))}
        whole = list(in_turn(ways, ROUNDS).values())
    table = Table("a step of", f"{FEW} objects, ms", f"{MANY} objects, ms", "ratio")
    for service in SERVICES:
        few, more = (spent[number][service] for number in (FEW, MANY))
        table.add_row(service, f"{fmean(few):.0f}", f"{fmean(more):.0f}", ratio(more, few))
    table.add_row("the agent", *(f"{fmean(each):.0f}" for each in whole), ratio(whole[1], whole[0]))
    Console().print(table)


if __name__ == "__main__":
    main()
