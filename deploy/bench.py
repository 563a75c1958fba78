"""`saccade bench`: an agent on every scene of a file, in processes that share nothing, and what it comes to.

Scene number k of the file is episode k whichever process runs it, so the split over processes changes no result.
"""

from __future__ import annotations

import functools
import hashlib
import json
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from deploy import table
from deploy.provenance import commit, machine, shown
from deploy.registry import local_pairs, weight_hashes
from deploy.threads import enforce_one_thread
from services.simulator.core import names_in_use
from services.simulator.objects import load_mesh
from services.simulator.scenes import PAPER_SCENES, Scene, generate_split, load_scenes, save_scenes
from shared.config import Config
from shared.errors import SaccadeError
from shared.loop import run_local
from shared.messages import Result
from shared.service import Core, Inputs, Output
from shared.topics import RESULT

RUN = "bench"  # the same in every benchmark: it is in the messages
MATTERS = ("agent", "objects", "config", "weights", "scenes")  # facts without which results do not belong together
RECORD_KEYS = ("scene", "target", "objects", "success", "steps", "azimuth_error_rad", "elevation_error_rad",
               "range_error_m", "declared", "declared_true")


@dataclass(frozen=True)
class Plan:
    """What is to be run: `config` as resolved by `prepare`, the file's scenes and the numbers of those in question."""

    agent: str
    config: Config
    scenes: tuple[Scene, ...]
    chosen: tuple[int, ...]
    out: Path

    @property
    def partial(self) -> Path:
        """Where results are kept as they come."""
        return self.out.with_name(self.out.name + ".partial.jsonl")


def prepare(agent: str, config: Config, out: Path, *, limit: int | None = None, yaw: str | None = None) -> Plan:
    """Resolves and checks everything before the first scene runs.

    Without a file: the paper's scenes for its objects, else a split drawn like the paper's, kept beside `out`.
    """
    names = names_in_use(config.scene)
    out.parent.mkdir(parents=True, exist_ok=True)
    path = config.scene.file
    if path is None:
        path = PAPER_SCENES
        if config.scene.objects != "ycb" or yaw is not None:
            path = out.with_name(out.stem + ".scenes.json")
            sizes = {name: load_mesh(config.scene.objects, name).size_m for name in names}
            counts = range(1, len(names) + 1)
            save_scenes(path, generate_split(sizes, seed=config.seed, counts=counts, yaw=yaw or "fixed"))
    config = config.with_values({"scene.names": list(names), "scene.file": str(path.resolve()), "bus.kind": "local"})
    weight_hashes(agent, config)
    scenes = tuple(load_scenes(path, names))
    return Plan(agent, config, scenes, spread(scenes, limit), out)


def spread(scenes: Sequence[Scene], limit: int | None) -> tuple[int, ...]:
    """Numbers of at most `limit` scenes, as even over targets and over object counts as can be; always the same."""
    if limit is None or limit >= len(scenes):
        return tuple(range(len(scenes)))
    targets = list(dict.fromkeys(scene.target for scene in scenes))
    counts = sorted({len(scene.on_table) for scene in scenes})
    cells: dict[tuple[int, int], list[int]] = {}
    for number, scene in enumerate(scenes):
        cells.setdefault((targets.index(scene.target), counts.index(len(scene.on_table))), []).append(number)
    # along the diagonals of targets x counts, so that any few in a row differ in both
    side = max(len(targets), len(counts))
    order = sorted(cells, key=lambda cell: ((cell[1] - cell[0]) % side, cell[0]))
    rounds = max(len(members) for members in cells.values())
    numbers = [cells[cell][k] for k in range(rounds) for cell in order if k < len(cells[cell])]
    return tuple(sorted(numbers[:limit]))


def facts(plan: Plan, command: str) -> dict[str, Any]:
    """Where the results come from: goes into the file, and decides whether a run may be taken up again."""
    config = plan.config.model_dump(mode="json")
    file = plan.config.scene.file
    config["scene"]["file"] = shown(file)
    if plan.config.perception.weights is not None:
        config["perception"]["weights"] = shown(plan.config.perception.weights)
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    return {"command": command, "commit": commit(), "agent": plan.agent, "objects": plan.config.scene.objects,
            "weights": weight_hashes(plan.agent, plan.config), "machine": machine(),
            "scenes": {"file": shown(file), "sha256": digest}, "config": config}


def bench(plan: Plan, *, jobs: int, command: str, console: Console) -> list[dict[str, Any]]:
    """Runs what is not there yet, writes `plan.out`, prints the table; returns the records in the file's order.

    Raises SaccadeError for a scene that cannot be run and for results of another run in the way; what has been reached
    is kept either way.
    """
    origin = facts(plan, command)
    known = _take_up(plan, origin)
    wanted = {plan.scenes[number].id: number for number in plan.chosen}
    done = {scene: record for scene, record in known.items() if scene in wanted}
    todo = [number for scene, number in wanted.items() if scene not in done]
    if done:
        console.print(f"{len(done)} of {len(wanted)} scenes are done already: {plan.partial}")
    try:
        with plan.partial.open("a") as partial, _progress(console, len(wanted)) as show:
            show(list(done.values()))
            for record in _records(plan, todo, jobs):
                partial.write(json.dumps(record) + "\n")
                partial.flush()
                done[record["scene"]] = record
                show(list(done.values()))
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"the same command goes on from the {len(done)} scenes in {plan.partial}") from None
    records = [done[scene] for scene in wanted]
    _finish(plan, origin, records)
    console.print(table.render(records, title=f"{plan.agent} on {plan.config.scene.objects}, {len(records)} scenes"))
    console.print(f"written to {plan.out}")
    return records


def _take_up(plan: Plan, origin: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The records kept by an interrupted run, by scene; appends this run's header."""
    lines = plan.partial.read_text().split("\n")[:-1] if plan.partial.is_file() else []  # a cut last line is dropped
    records = {}
    for line in lines:
        try:
            entry = json.loads(line)
        except ValueError:  # cut by a crash in an earlier round
            continue
        if "facts" not in entry:
            records[entry["scene"]] = entry
            continue
        for key in MATTERS:
            if entry["facts"].get(key) != origin[key]:
                raise SaccadeError(f"{plan.partial} holds results of another run (its {key} differ): "
                                   "delete it to start anew, or give another --json")
    with plan.partial.open("a") as partial:
        partial.write(("\n" if lines or plan.partial.stat().st_size else "") + json.dumps({"facts": origin}) + "\n")
    return records


def _finish(plan: Plan, origin: dict[str, Any], records: list[dict[str, Any]]) -> None:
    """Writes the one JSON object; results of an older state of the code say so."""
    lines = [line for line in plan.partial.read_text().splitlines() if line.startswith('{"facts"')]
    commits = ", ".join(dict.fromkeys(json.loads(line)["facts"]["commit"] for line in lines))
    text = json.dumps(origin | {"commit": commits, "results": records}, indent=1)
    draft = plan.out.with_name(plan.out.name + ".draft")
    draft.write_text(text + "\n")
    draft.replace(plan.out)
    plan.partial.unlink()


@contextmanager
def _progress(console: Console, total: int) -> Iterator:
    columns = (TextColumn("scenes"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
               TextColumn("{task.fields[note]}"))
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("scenes", total=total, note="")

        def show(records: list[dict[str, Any]]) -> None:
            share = 100 * sum(r["success"] for r in records) / len(records) if records else 0.0
            progress.update(bar, completed=len(records), note=f"success {share:.1f} %")

        yield show


def _records(plan: Plan, numbers: Sequence[int], jobs: int) -> Iterator[dict[str, Any]]:
    """The records of these scenes as they are ready."""
    if not numbers:
        return
    enforce_one_thread()
    context = multiprocessing.get_context("spawn")
    text = plan.config.model_dump_json()
    with ProcessPoolExecutor(min(jobs, len(numbers)), mp_context=context, initializer=_start_worker) as pool:
        waiting = {pool.submit(run_scene, plan.agent, text, number): number for number in numbers}
        try:
            for future in as_completed(waiting):
                scene = plan.scenes[waiting[future]].id
                try:
                    yield future.result()
                except SaccadeError as error:
                    raise SaccadeError(f"scene {scene}: {error}; the results so far are in {plan.partial}") from error
                except BrokenProcessPool as error:
                    raise SaccadeError("a process of the benchmark has died, perhaps for want of memory: the results "
                                       f"so far are in {plan.partial}; give the same command again") from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for child in multiprocessing.active_children():
                child.terminate()
            raise


def _start_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle

    def watch() -> None:
        multiprocessing.parent_process().join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@functools.lru_cache(maxsize=1)
def _cores(agent: str, config_text: str) -> tuple[Config, list]:
    """Meshes, OpenGL and weights are loaded once per process."""
    config = Config.model_validate_json(config_text)
    return config, local_pairs(agent, config)


def run_scene(agent: str, config_text: str, number: int) -> dict[str, Any]:
    """The record of one scene, run within this process as episode `number`."""
    config, pairs = _cores(agent, config_text)
    results: list[Result] = []
    start = time.perf_counter()
    run_local([(service, _as_episode(core, number)) for service, core in pairs], config.scene.names, RUN,
              on_message=lambda topic, part, message, payload: results.append(message) if topic == RESULT else None)
    seconds = round(time.perf_counter() - start, 3)
    return {key: getattr(results[0], key) for key in RECORD_KEYS} | {"seconds": seconds}


class _Episode:
    """A core that takes part in episode `number`, which is the only one, 0, to whoever runs it."""

    def __init__(self, core: Core, number: int):
        self.core, self.number = core, number

    def begin(self, run: str, episode: int) -> list[Output]:
        return self._out(self.core.begin(run, self.number))

    def step(self, inputs: Inputs) -> list[Output]:
        return self._out(self.core.step({name: self._in(value) for name, value in inputs.items()}))

    def _in(self, value: Any) -> Any:
        if isinstance(value, dict):
            return {part: self._in(message) for part, message in value.items()}
        return replace(value, episode=self.number)

    def _out(self, outputs) -> list[Output]:
        return [replace(output, message=replace(output.message, episode=0)) for output in outputs]


class _SourceEpisode(_Episode):
    episodes = 1


def _as_episode(core: Core, number: int) -> _Episode:
    return (_SourceEpisode if hasattr(core, "episodes") else _Episode)(core, number)
