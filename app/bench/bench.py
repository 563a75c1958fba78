"""`saccade bench` runs an agent on every scene of a file, in processes that share nothing, and reports the results.

Scene number k of the file is episode k, whichever process runs it. So the number of processes changes no result.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from saccade.app.bench import table
from saccade.app.bench.counting import counted
from saccade.app.bench.noticing import noticed
from saccade.app.bench.suites import default_suite, suite_file
from saccade.app.bench.workers import in_processes
from saccade.app.provenance import machine, shown
from saccade.app.run.display import say
from saccade.app.run.registry import Pair, local_pairs, weight_hashes
from saccade.services.simulator.scenes import Scene, load_scenes
from saccade.services.simulator.suites import SUITES
from saccade.shared.bus.messages import Belief, Events, Message, Result, Truth
from saccade.shared.bus.topics import Topic
from saccade.shared.config import Config, merged
from saccade.shared.errors import SaccadeError
from saccade.shared.files import MIB, append_line, parse_json, read_text, replace_whole, writing
from saccade.shared.log.provenance import commit
from saccade.shared.loop.local import run_local
from saccade.shared.model.object_card import symmetries
from saccade.shared.render.objects import names_in_use
from saccade.shared.world.symmetry import NONE

MAX_FILE_BYTES = 256 * MIB  # of results: some hundred thousand scenes
SCENES_ENDING = ".scenes.json"  # drawn scenes are kept in a file with this ending
RUN = "bench"  # the run's name is part of every message, so it is always the same
MATTERS = ("agent", "objects", "config", "weights", "scenes")  # results belong together only if these facts are equal
RECORD_KEYS = ("scene", "target", "objects", "success", "steps", "azimuth_error_rad", "elevation_error_rad",
               "range_error_m", "declared", "declared_true")


@dataclass(frozen=True)
class Plan:
    """What is to be run: `config` as `prepare` has resolved it, all scenes of the file, and the numbers of the chosen
    ones.

    `suite` is the name of the scenes, if they have one.
    """

    agent: str
    config: Config
    scenes: tuple[Scene, ...]
    chosen: tuple[int, ...]
    out: Path
    suite: str | None = None

    @property
    def file(self) -> Path:
        """The file of the scenes."""
        assert self.config.scene.file is not None  # because the configuration is resolved
        return self.config.scene.file

    @property
    def partial(self) -> Path:
        """The file that keeps the results while the benchmark runs."""
        return self.out.with_name(self.out.name + ".partial.jsonl")


def prepare(agent: str, config: Config, out: Path, *, suite: str | None = None, limit: int | None = None) -> Plan:
    """Resolves and checks everything before the first scene runs.

    If the configuration names no file, the scenes are those of the suite. Scenes that are drawn are kept beside `out`.
    Raises SaccadeError if both a file and a suite are given, or if scenes or weights cannot be used.
    """
    if config.scene.file is not None and suite is not None:
        raise SaccadeError("scenes come from a file or from a suite: leave --scenes or --suite out")
    names = names_in_use(config.scene)
    with writing(out, "results"):
        out.parent.mkdir(parents=True, exist_ok=True)
    path = config.scene.file
    if path is None:
        suite = suite or default_suite(config.scene.objects)
        path = suite_file(suite, config, out.with_name(out.stem + SCENES_ENDING))
        config = config.with_values(dict(SUITES[suite].values))
    config = config.with_values({"scene.names": list(names), "scene.file": str(path.resolve()), "bus.kind": "local"})
    weight_hashes(agent, config)
    scenes = tuple(load_scenes(path, names))
    return Plan(agent, config, scenes, spread(scenes, limit), out, suite)


def spread(scenes: Sequence[Scene], limit: int | None) -> tuple[int, ...]:
    """Returns the numbers of at most `limit` scenes, spread as evenly as possible over targets and object counts. The
    choice is always the same."""
    if limit is None or limit >= len(scenes):
        return tuple(range(len(scenes)))
    targets = list(dict.fromkeys(scene.target for scene in scenes))
    counts = sorted({len(scene.on_table) for scene in scenes})
    cells: dict[tuple[int, int], list[int]] = {}
    for number, scene in enumerate(scenes):
        cells.setdefault((targets.index(scene.target), counts.index(len(scene.on_table))), []).append(number)
    # Goes along the diagonals of targets x counts, so that successive scenes differ in both.
    side = max(len(targets), len(counts))
    order = sorted(cells, key=lambda cell: ((cell[1] - cell[0]) % side, cell[0]))
    rounds = max(len(members) for members in cells.values())
    numbers = [cells[cell][k] for k in range(rounds) for cell in order if k < len(cells[cell])]
    return tuple(sorted(numbers[:limit]))


def facts(plan: Plan, command: str) -> dict[str, Any]:
    """Describes where the results come from. These facts go into the file, and decide whether an interrupted run may be
    continued."""
    config = plan.config.model_dump(mode="json")
    config["scene"]["file"] = shown(plan.file)
    if plan.config.perception.weights is not None:
        config["perception"]["weights"] = shown(plan.config.perception.weights)
    symmetric = {name: value for name, value in symmetries(plan.config.scene.objects, plan.config.names).items()
                 if value != NONE}
    digest = hashlib.sha256(plan.file.read_bytes()).hexdigest()
    return {"command": command, "commit": commit(), "agent": plan.agent, "objects": plan.config.scene.objects,
            "weights": weight_hashes(plan.agent, plan.config), "machine": machine(),
            "scenes": {"suite": plan.suite, "file": shown(plan.file), "sha256": digest} |
            ({"symmetry": symmetric} if symmetric else {}), "config": config}


def differing(held: Mapping[str, Any], origin: Mapping[str, Any]) -> list[str]:
    """Which of the facts that matter differ. A setting that came after the held results were made counts there as its
    default. Of a file of scenes its content matters, not where it lies."""
    if isinstance(config := held.get("config"), dict):
        held = {**held, "config": merged(Config().model_dump(mode="json"), config)}
    held, origin = _wherever(held), _wherever(origin)
    return [key for key in MATTERS if held.get(key) != origin[key]]


def _wherever(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Facts without the place of the file of scenes."""
    scenes, config = facts.get("scenes"), facts.get("config")
    if not (isinstance(scenes, dict) and isinstance(config, dict) and isinstance(config.get("scene"), dict)):
        return dict(facts)
    scene = {**config["scene"], "file": None}
    return {**facts, "scenes": {**scenes, "file": None}, "config": {**config, "scene": scene}}


def bench(plan: Plan, *, jobs: int, command: str, console: Console, cluster: str | None = None) -> list[dict[str, Any]]:
    """Runs the scenes that have no result yet, writes `plan.out` and prints the table. Returns the records in the
    file's order.

    Raises SaccadeError if a scene cannot be run, or if results of another run are in the way. The results so far are
    kept in both cases.
    """
    origin = facts(plan, command)
    known = _take_up(plan, origin)
    wanted = {plan.scenes[number].id: number for number in plan.chosen}
    done = {scene: record for scene, record in known.items() if scene in wanted}
    todo = [number for scene, number in wanted.items() if scene not in done]
    if done:
        say(console, f"{len(done)} of {len(wanted)} scenes are done already: {plan.partial}")
    try:
        with _progress(console, len(wanted)) as show:
            show(list(done.values()))
            for record in _records(plan, todo, jobs, cluster):
                with _kept(plan, len(done), len(wanted)):
                    append_line(plan.partial, json.dumps(record))
                done[record["scene"]] = record
                show(list(done.values()))
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"the same command goes on from the {len(done)} scenes in {plan.partial}") from None
    records = [done[scene] for scene in wanted]
    with _kept(plan, len(done), len(wanted)):
        _finish(plan, origin, records)
    where = f"{plan.config.scene.objects}, {plan.suite or plan.file.name}"
    console.print(table.render(records, title=f"{plan.agent} on {where}, {len(records)} scenes"))
    say(console, f"written to {plan.out}")
    return records


def _take_up(plan: Plan, origin: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Returns the records that an interrupted run has kept, by scene, and appends this run's header. Raises
    SaccadeError if they belong to another run."""
    # A last line that was cut is dropped
    there = os.path.lexists(plan.partial)
    need = "delete it to start anew, or give another --json"
    text = read_text(plan.partial, "results", need, MAX_FILE_BYTES) if there else ""
    records = {}
    for line in text.split("\n")[:-1]:
        entry = _entry(line)
        if isinstance(facts := entry.get("facts"), dict):
            if differ := differing(facts, origin):
                raise SaccadeError(f"{plan.partial} holds results of another run (its {differ[0]} differ): {need}")
        elif entry.keys() >= set(RECORD_KEYS) and isinstance(entry["scene"], str):
            records[entry["scene"]] = entry
    with _kept(plan, len(records), len(plan.chosen)):
        append_line(plan.partial, ("\n" if text else "") + json.dumps({"facts": origin}))
    return records


def _entry(line: str) -> dict[str, Any]:
    """What a line of the partial file says; nothing where an earlier crash has cut it."""
    try:
        entry = parse_json(line)
    except ValueError:
        return {}
    return entry if isinstance(entry, dict) else {}


@contextmanager
def _kept(plan: Plan, done: int, wanted: int) -> Iterator[None]:
    """Around what writes results. Raises SaccadeError where they cannot be written, and says what is kept."""
    try:
        yield
    except OSError as error:
        kept = f"the results of {done} of {wanted} scenes are kept in {plan.partial}" if done else "none are there yet"
        raise SaccadeError(f"results {plan.out} cannot be written ({error.strerror or error}), {kept}: free some "
                           "space, or give a --json where you may write, and the same command again") from error


def _finish(plan: Plan, origin: dict[str, Any], records: list[dict[str, Any]]) -> None:
    """Writes the results as one JSON object. It names every commit whose code has contributed results."""
    entries = map(_entry, plan.partial.read_text().splitlines())
    told = [entry["facts"] for entry in entries if isinstance(entry.get("facts"), dict)]
    commits = ", ".join(dict.fromkeys(str(facts.get("commit")) for facts in told))
    text = json.dumps(origin | {"commit": commits, "results": records}, indent=1)
    replace_whole(plan.out, (text + "\n").encode())
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


def _records(plan: Plan, numbers: Sequence[int], jobs: int, cluster: str | None = None) -> Iterator[dict[str, Any]]:
    """Yields the records of these scenes as they are ready."""
    text = plan.config.model_dump_json()
    work = {plan.scenes[number].id: (plan.agent, text, number) for number in numbers}
    try:
        for _, record in in_processes(run_scene, work, jobs, cluster):
            yield record
    except SaccadeError as error:
        raise SaccadeError(f"{error}; the results so far are in {plan.partial}") from error


@functools.lru_cache(maxsize=1)
def cores(agent: str, config_text: str) -> tuple[Config, list[Pair]]:
    """Builds declarations and cores. Meshes, OpenGL and weights are thus loaded once per process."""
    config = Config.model_validate_json(config_text)
    return config, local_pairs(agent, config)


def run_scene(agent: str, config_text: str, number: int) -> dict[str, Any]:
    """Runs one scene within this process as episode `number`, and returns its record with what the agent noticed of
    the events, how many of a kind it has found, the seconds of the scene and the mean milliseconds per step of each
    service."""
    config, pairs = cores(agent, config_text)
    heard: dict[type[Message], list[Any]] = {Result: [], Truth: [], Events: []}
    beliefs: dict[str, Belief] = {}
    spent_ms: dict[str, list[float]] = {service.name: [] for service, _ in pairs}
    start = time.perf_counter()

    def hear(_topic: Topic, _part: str | None, message: Message, _payload: bytes | None) -> None:
        if isinstance(message, Belief):
            beliefs[message.object] = message
        elif type(message) in heard:
            heard[type(message)].append(message)

    run_local(pairs, config.names, RUN, (number,), hear,
              on_step=lambda service, milliseconds: spent_ms[service].append(milliseconds))
    seconds = round(time.perf_counter() - start, 3)
    means = {service: round(fmean(values), 3) for service, values in spent_ms.items() if values}
    told = noticed(heard[Truth], heard[Events])._asdict() if heard[Events] else {}  # not every agent tells events
    if beliefs and heard[Truth]:
        at = next(truth for truth in heard[Truth] if truth.step == next(iter(beliefs.values())).step)
        told |= counted(at, beliefs)._asdict()
    return record_of(heard[Result][0]) | told | {"seconds": seconds, "milliseconds": means}


def record_of(result: Result) -> dict[str, Any]:
    """Returns what the results file says about an episode, without its times."""
    return {key: getattr(result, key) for key in RECORD_KEYS}
