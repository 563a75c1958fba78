"""`python -m saccade.benchmarks.strangers OUT FOLDER... [--objects SET] [--agent AGENT] [--views N] [--seed N]` counts
goal images of objects that are not known and are taken for one that is.

Each FOLDER holds objects in folders of their own, each with a mesh. Every object stands alone on the table, and is seen
from directions and ranges as goals have them, in the flat look. Beside them the objects of the set are seen in the same
way, because networks that know nothing would take no stranger for their own either. OUT is the file of the results.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from saccade.app.bench.table import wilson
from saccade.app.run.registry import agent_of
from saccade.services.perception.core import Model, model_of
from saccade.shared.config import load
from saccade.shared.errors import SaccadeError
from saccade.shared.files import write_json
from saccade.shared.log.provenance import commit
from saccade.shared.model.weights import weights_in_use
from saccade.shared.render.mesh import Mesh, read_obj
from saccade.shared.render.objects import load_mesh, names_in_use
from saccade.shared.render.world import World
from saccade.shared.world.geometry import Array, direction, look_at

UP = (0.0, 1.0, 0.0)  # goal images count as upright
NEAREST_M = 0.08  # from the ball around an object to the camera
RANGES = (0.8, 2.2)  # of the camera, in diagonals of the object
ELEVATIONS_RAD = (0.2, 1.3)
LIMITS = (0.5, 0.7)  # an object counts as seen, and a goal image as known, from these presences on


def presences(model: Model, mesh: Mesh, views: int, rng: np.random.Generator) -> Iterator[Array]:
    """The presence of every known object [K] in images of one object alone on the table."""
    world, diagonal = World((mesh,)), float(np.linalg.norm(mesh.size_m))
    center = np.array([0.0, 0.0, mesh.size_m[2] / 2])
    world.place({mesh.name: (center, rng.uniform(-np.pi, np.pi))})
    for _ in range(views):
        towards = direction(rng.uniform(-np.pi, np.pi), rng.uniform(*ELEVATIONS_RAD))
        range_m = max(rng.uniform(*RANGES) * diagonal, diagonal / 2 + NEAREST_M)
        image = world.render(look_at(center + range_m * towards, center))
        yield model.see(image, world.intrinsics_px, UP, alone=True).presence.copy()
    world.close()


def strangers(folders: list[Path], names: tuple[str, ...]) -> list[Path]:
    """The folders of objects that are not known. Raises SaccadeError if there are none."""
    found = {mesh.parent for folder in folders for mesh in folder.glob("*/*.obj") if mesh.parent.name not in names}
    if not found:
        raise SaccadeError(f"no objects in {', '.join(map(str, folders))}: each needs a folder of its own with an .obj")
    return sorted(found)


def counted(taken: list[float], limit: float) -> dict[str, Any]:
    """How many presences are above a limit, with Wilson's 95 % interval of the share."""
    share = wilson(sum(value > limit for value in taken), len(taken))
    return {"above": limit, "images": len(taken), "count": sum(value > limit for value in taken),
            "share": share.value, "low": share.low, "high": share.high}


def measure(options: argparse.Namespace, console: Console) -> dict[str, Any]:
    """The results. Raises SaccadeError if weights, meshes or OpenGL are missing."""
    config = load(None, agent_of(options.agent).preset).with_values({"scene.objects": options.objects})
    names = names_in_use(config.scene)
    model = model_of(weights_in_use(config), names, config.perception.passes)
    rng = np.random.default_rng(options.seed)
    unknown: dict[str, list[float]] = {}
    for folder in track(strangers(options.folders, names), "strangers", console=console):
        mesh = read_obj(folder, folder.name)
        unknown[folder.name] = [float(each.max()) for each in presences(model, mesh, options.views, rng)]
    known: dict[str, list[float]] = {}
    for k, name in enumerate(names):
        mesh = load_mesh(options.objects, name)
        known[name] = [float(each[k]) for each in presences(model, mesh, options.views, rng)]
    told = {"strangers": unknown, "known": known}
    return {"objects": options.objects, "agent": options.agent, "views": options.views, "seed": options.seed,
            "commit": commit()} | {
        kind: [counted([value for each in told[kind].values() for value in each], limit) for limit in LIMITS]
        for kind in told} | {"presence": told}


def main() -> None:
    """Measures, writes the results and tells them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--objects", default="ycb")
    parser.add_argument("--agent", default="open")
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    options, console = parser.parse_args(), Console()
    try:
        results = measure(options, console)
        write_json(options.out, results, "results")
    except SaccadeError as error:
        parser.exit(2, f"saccade: {error}\n")
    for kind in ("strangers", "known"):
        for each in results[kind]:
            console.print(f"{kind}: {each['count']} of {each['images']} above {each['above']} "
                          f"({100 * each['low']:.1f} to {100 * each['high']:.1f} %)")


if __name__ == "__main__":
    main()
