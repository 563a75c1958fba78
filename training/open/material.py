"""What the networks that know no names are trained on: views of many objects, and rendered tables."""

from __future__ import annotations

import multiprocessing
import os
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from saccade.shared.errors import SaccadeError
from saccade.shared.files import writing
from saccade.shared.render.groceries import grocery
from saccade.shared.render.mesh import Mesh, read_obj
from saccade.shared.render.objects import load_mesh, names_of
from saccade.training.open.composer import CropMaker
from saccade.training.open.table_crops import Sights, TableCrops, sights_of
from saccade.training.open.tables import Tables, render_tables
from saccade.training.open.tiles import Tiles, load_tiles, render_tiles
from saccade.training.settings import TrainingConfig

VARIANTS = 3  # of a scanned object
MADE_VIEWS, MADE_VARIANTS = 60, 2  # of a grocery made by code
SHARD = 200  # tables in a file
SCANNED, MADE_BESIDE = 14, 26  # objects of a shard
HELD = "held_out"  # name of the shard to evaluate on
BUILT_IN = "pantry"  # set of objects that everybody has
Show = Callable[[str, int, int], None]
Job = tuple[str, str, tuple[str, ...]]  # what is rendered, the file's name, and the objects


@dataclass(frozen=True)
class Material:
    """The tiles of all objects; `real` are the numbers of the scanned ones, `made` those of groceries made by code,
    `held_numbers` those of scanned objects that are not trained on. `composed` and `tables` make crops to train on,
    `held_out` those to evaluate on."""

    tiles: list[Tiles]
    real: NDArray[np.int64]
    made: NDArray[np.int64]
    held_numbers: NDArray[np.int64]
    composed: CropMaker
    tables: TableCrops
    held_out: TableCrops

    def drawn(self, rng: np.random.Generator, real: float) -> int:
        """The number of an object to train on, a scanned one with the probability `real`."""
        known = self.real[~np.isin(self.real, self.held_numbers)]
        return int(rng.choice(known if rng.random() < real or not len(self.made) else self.made))


class Objects:
    """The objects of a run: scanned ones, the pantry's, and groceries made by code. Raises SaccadeError if two have one
    name, or if one that is held out is not there."""

    def __init__(self, config: TrainingConfig):
        self.seed = config.seed
        self._paths: dict[str, Path | str] = {name: BUILT_IN for name in names_of(BUILT_IN)}
        self._paths |= dict.fromkeys(config.names, config.objects)
        for folder in config.scans:
            for path in _folders(Path(folder)):
                if self._paths.setdefault(path.name, path) != path:
                    raise SaccadeError(f"two objects are called {path.name!r}, one of them in {folder}: rename it")
        self.scanned = tuple(self._paths)
        self.made = tuple(f"grocery{n:04}" for n in range(config.groceries))
        if lacks := set(config.held_out) - set(self.scanned):
            raise SaccadeError(f"held_out names {', '.join(sorted(lacks))}: no object has this name")
        self.trained = tuple(name for name in self.scanned if name not in config.held_out)

    def mesh(self, name: str) -> Mesh:
        """The mesh of an object. Raises SaccadeError if it cannot be read."""
        if name in self._paths:
            where = self._paths[name]
            return load_mesh(where, name) if isinstance(where, str) else read_obj(where, name)
        return grocery(np.random.default_rng([self.seed, 7, self.made.index(name)]), name)

    def shards(self, tables: int) -> Iterator[tuple[str, tuple[str, ...]]]:
        """The names of the shards of tables, and those of their objects. Every object is on the held-out shard, but no
        grocery."""
        yield HELD, self.scanned
        for n in range(-(-tables // SHARD)):
            rng = np.random.default_rng([self.seed, 11, n])
            yield f"{n:03}", (*map(str, rng.permutation(self.trained)[:SCANNED]),
                              *map(str, rng.permutation(self.made)[:MADE_BESIDE]))


def prepare(run_dir: Path, config: TrainingConfig, show: Show, jobs: int = 1) -> None:
    """Renders what the run's folder lacks, in `jobs` processes. `show` is told (what, how many are done, how many there
    are)."""
    objects, folder = Objects(config), run_dir / "views"
    kinds = {"views of scans": objects.scanned, "views of groceries": objects.made}
    work: list[Job] = [(what, name, (name,)) for what, names in kinds.items() for name in names
                       if not (folder / f"{name}.npy").is_file()]
    work += [("tables", shard, names) for shard, names in objects.shards(config.tables)
             if not _shard(run_dir, shard).is_file()]
    total, done = Counter(what for what, _, _ in work), Counter[str]()
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        try:
            for rendering in as_completed([pool.submit(_render, run_dir, config, job) for job in work]):
                done[what := rendering.result()] += 1
                show(what, done[what], total[what])
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _render(run_dir: Path, config: TrainingConfig, job: Job) -> str:
    """Renders one file. Returns what it is."""
    what, name, names = job
    objects = Objects(config)
    meshes = tuple(objects.mesh(each) for each in names)
    if what == "tables":
        seed = config.seed, 13, *name.encode()
        _save(_shard(run_dir, name), meshes, render_tables(meshes, min(SHARD, config.tables),
                                                           np.random.default_rng(seed)))
    else:
        made = name in objects.made
        render_tiles(run_dir / "views", meshes, count=min(MADE_VIEWS, config.views) if made else config.views,
                     variants=MADE_VARIANTS if made else VARIANTS, seed=config.seed)
    return what


def _shard(run_dir: Path, name: str) -> Path:
    return run_dir / "tables" / f"{name}.npz"


def _save(path: Path, meshes: tuple[Mesh, ...], tables: Tables) -> None:
    sights = sights_of(tables, meshes, {name: n for n, name in enumerate(tables.names)})
    temporary = path.with_suffix(".tmp.npz")
    with writing(path, "tables"):
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(temporary, names=np.array(tables.names), rgb=tables.rgb, instance=tables.instance,
                 **{f"sight_{key}": value for key, value in asdict(sights).items()})
        os.replace(temporary, path)


def load_material(run_dir: Path, config: TrainingConfig, device: torch.device) -> Material:
    """Reads what was rendered. Raises SaccadeError if something is missing or damaged."""
    objects = Objects(config)
    names = (*objects.scanned, *objects.made)
    numbers = {name: n for n, name in enumerate(names)}
    tiles = list(load_tiles(run_dir / "views", names))
    maker = CropMaker(tiles, device, config.seed)
    paths = [_shard(run_dir, shard) for shard, _ in objects.shards(config.tables)]
    held, tables = (_table_crops(some, numbers, maker) for some in (paths[:1], paths[1:]))
    real = np.arange(len(objects.scanned))
    return Material(tiles, real, np.arange(len(real), len(names)), np.array([numbers[n] for n in config.held_out], int),
                    maker, tables, held)


def _table_crops(paths: list[Path], numbers: dict[str, int], maker: CropMaker) -> TableCrops:
    """The tables of several shards as one, with the run's numbers of their objects."""
    rgb, instance, sights, start = [], [], [], 0
    for path in paths:
        try:
            with np.load(path, allow_pickle=False) as file:
                rgb.append(file["rgb"])
                instance.append(file["instance"])
                some = {field.name: file[f"sight_{field.name}"] for field in fields(Sights)}
                number = np.array([numbers[name] for name in file["names"]])
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise SaccadeError(f"tables {path} are missing or damaged ({error}): remove the file, they are rendered "
                               "again") from error
        sights.append(some | {"object": number[some["object"]], "table": some["table"] + start})
        start += len(rgb[-1])
    joined = Sights(*(np.concatenate([some[field.name] for some in sights]) for field in fields(Sights)))
    return TableCrops(np.concatenate(rgb), np.concatenate(instance), joined, maker)


def _folders(folder: Path) -> list[Path]:
    """The folders with a mesh in a folder of scans. Raises SaccadeError if there is none."""
    found = sorted(path for path in folder.glob("*") if any(path.glob("*.obj")))
    if not found:
        raise SaccadeError(f"{folder} holds no folders with meshes (OBJ): name another folder in scans")
    return found
