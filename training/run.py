"""A training run: it renders the views, trains all parts in parallel, shows the progress and exports the weights."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from saccade.services.perception.likeness import COHORT
from saccade.services.perception.local_features import SHA256
from saccade.services.perception.paper import CROP_SIDE_M
from saccade.shared.errors import SaccadeError
from saccade.shared.files import replace_whole, writing
from saccade.shared.log.provenance import commit
from saccade.shared.model.weights import ObjectCard, write_weights
from saccade.shared.render.objects import load_mesh
from saccade.shared.render.views import crop_side_m
from saccade.training.checkpoints import ccn_of, finished
from saccade.training.dataset import render_missing
from saccade.training.open.material import prepare
from saccade.training.open.tasks import banks_for, judged
from saccade.training.part import pick_device
from saccade.training.settings import EXTRACTION, WHOLE, TrainingConfig, load_settings

NETWORKS = "open"  # folder of the networks that know no object, beside those of the objects' banks


def start(run_dir: Path, config: TrainingConfig) -> TrainingConfig:
    """Creates the folder of a run, or continues the run that is there. Returns its configuration.

    Raises SaccadeError if the folder holds a run with other settings, or if the device is not available.
    """
    pick_device(config.device)
    path = run_dir / "training.json"
    with writing(run_dir, "training run"):
        run_dir.mkdir(parents=True, exist_ok=True)
    if path.is_file() and load_settings(run_dir) != config:
        raise SaccadeError(f"{run_dir} holds a run with other settings: continue with the same, or name another folder")
    with writing(path, "training settings"):
        replace_whole(path, (config.model_dump_json(indent=2) + "\n").encode())
    return config


def train(run_dir: Path, config: TrainingConfig, *, jobs: int, console: Console) -> None:
    """Trains every part that is not finished, each in its own process, at most `jobs` at a time. Where the console is
    no terminal, the progress is printed as lines, a line for each tenth of a part.

    Raises SaccadeError if the run cannot be started, or if a part fails.
    """
    start(run_dir, config)
    columns = (TextColumn("{task.description:>24}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
               TextColumn("{task.fields[note]}"))
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        bars: dict[str, TaskID] = {}
        tenths: dict[str, int] = {}

        def show(name: str, done: int, total: int, note: str = "") -> None:
            if not console.is_terminal and 10 * done // total > tenths.get(name, -1):
                tenths[name] = 10 * done // total
                console.print(f"{name}: {done} of {total}  {note}".rstrip(), markup=False, highlight=False,
                              soft_wrap=True)
            if name not in bars:
                bars[name] = progress.add_task(name, total=total, note="")
            progress.update(bars[name], completed=done, note=note)

        if config.architecture == "open":
            if config.parts:
                prepare(run_dir, config, show, jobs)
        elif config.architecture not in WHOLE:  # which render their own images
            render_missing(run_dir, config, lambda name, done, total: show(f"views {name}", done, total))
        _train_parts(run_dir, config, jobs, show)


def _train_parts(run_dir: Path, config: TrainingConfig, jobs: int, show) -> None:
    waiting = list(config.parts)
    running: dict[str, subprocess.Popen] = {}
    try:
        while waiting or running:
            while len(running) < jobs:
                ready = [part for part in waiting if config.needs(part) not in (*waiting, *running)]
                if not ready:
                    break
                waiting.remove(part := ready[0])
                command = [sys.executable, "-m", "saccade.training.part", str(run_dir), part]
                running[part] = subprocess.Popen(command, stderr=subprocess.PIPE, text=True,
                                                 env={"OMP_NUM_THREADS": "1", **os.environ})
            time.sleep(0.5)
            for part, process in list(running.items()):
                code = process.poll()
                _show_part(run_dir, part, config, show)
                if code is None:
                    continue
                if code:
                    assert process.stderr is not None  # it is a pipe
                    lines = process.stderr.read().strip().splitlines() or [f"exit code {code}"]
                    raise SaccadeError(f"training {part} stopped: {lines[-1].removeprefix('saccade: ')}")
                del running[part]
    finally:
        for process in running.values():
            process.terminate()
            process.wait()


def _show_part(run_dir: Path, part: str, config: TrainingConfig, show) -> None:
    try:
        state = json.loads((run_dir / part / "progress.json").read_text())
    except (OSError, ValueError):
        return
    losses = {k: v for k, v in state.items() if k not in ("step", "steps", "seconds") and "." not in k}
    show(part, state["step"], config.steps(part), "  ".join(f"{k} {v:g}" for k, v in losses.items()))


def export(run_dir: Path, weights_dir: Path) -> None:
    """Writes the weights of a finished run and their manifest. Raises SaccadeError if a part is not finished.

    Of the architecture "open", the networks go to a folder of their own beside the objects' banks.
    """
    config = load_settings(run_dir)
    if config.architecture == "open":
        _export_open(run_dir, config, weights_dir)
        return
    states, losses, commits, seconds = {}, {}, {}, 0.0
    for part in config.parts:
        facts, states[part] = finished(run_dir, config, part)
        if config.architecture == "lexa":  # what only training needs stays behind
            states[part] = {name.removeprefix("actor."): value for name, value in states[part].items()
                            if name.startswith("actor.")}
        losses[part] = _told(run_dir / part)[-1]
        commits[part] = facts.get("commit", "unknown")
        seconds += facts["seconds"]
    for name in config.names if config.ccns else ():
        facts, states[name] = ccn_of(run_dir, config, name)
        losses[name], commits[name] = facts["losses"], facts["commit"]
        seconds += losses[name].get("seconds", 0.0)
    paper = config.architecture == "paper"
    lived = {}
    if config.architecture == "lexa":
        keys = ("environment_steps", "goals", "reached", "nearest")
        lived["measured"] = [{key: row[key] for key in keys} for row in _told(run_dir / "lexa")]
    sizes = {name: load_mesh(config.objects, name).size_m for name in config.names}
    cards = tuple(ObjectCard(name, size, CROP_SIDE_M if paper else crop_side_m(size)) for name, size in sizes.items())
    data = f"{config.views} directions of each object of {config.objects!r}, from {{}}, composed"
    described = {"default": data.format("four ranges"), "paper": data.format("0.40 m"),
                 "posecnn": f"images of the objects of {config.objects!r}, rendered at every step",
                 "lexa": f"one room with the objects of {config.objects!r}, lived in"}
    write_weights(weights_dir, states, cards, {
        **({} if config.architecture == "default" else {"architecture": config.architecture}),
        **({"calibration": _calibration(config, losses)} if config.architecture in ("paper", "posecnn") else {}),
        **lived, "data": described[config.architecture],
        "training": config.model_dump(mode="json"), "losses": losses, "commits": commits,
        "where_trained": _where(pick_device(config.device)), "seconds": round(seconds), "torch": torch.__version__})


def _export_open(run_dir: Path, config: TrainingConfig, weights_dir: Path) -> None:
    networks = weights_dir.parent / (config.networks or NETWORKS)
    if config.parts:
        trained = {part: finished(run_dir, config, part) for part in config.parts}
        losses = {part: _told(run_dir / part)[-1] for part in config.parts}
        states = {part: state for part, (_, state) in trained.items()}
        cohort, log_odds = judged(run_dir, config, states)
        write_weights(networks, {**states, COHORT: {"vectors": cohort}}, (), {
            "architecture": config.architecture, "calibration": asdict(log_odds), "local_features": SHA256,
            "data": "views and rendered tables of scanned objects, the pantry's, and of "
            f"{config.groceries} groceries made by code", "training": config.model_dump(mode="json"), "losses": losses,
            "commits": {part: facts.get("commit", "unknown") for part, (facts, _) in trained.items()},
            "where_trained": _where(pick_device(config.device)),
            "seconds": round(sum(facts["seconds"] for facts, _ in trained.values())), "torch": torch.__version__})
    cards = tuple(ObjectCard(name, size, crop_side_m(size)) for name, size in
                  ((name, load_mesh(config.objects, name).size_m) for name in config.names))
    write_weights(weights_dir, {}, cards, {
        "architecture": config.architecture, "networks": networks.name, "commit": commit(),
        "data": f"views of the objects of {config.objects!r} from all around"}, banks_for(config, networks))


def _calibration(config: TrainingConfig, losses: dict[str, dict]) -> dict[str, float]:
    """Standard deviations of the percepts of networks that do not predict them themselves.

    They are those of Gaussians with the median errors that were measured on held-out views.
    """
    if config.architecture == "posecnn":
        measured = {name: {key: losses["posecnn"][f"{name}.{key}"] for key in ("centre_px", "log_scale")}
                    for name in config.names}
    else:
        measured = {name: losses[f"{name}.{EXTRACTION}"] for name in config.names}
    pixel = {f"{name}.pixel_std": round(max(m["centre_px"] / 1.1774, 2.0), 2) for name, m in measured.items()}
    return pixel | {f"{name}.log_scale_std": round(max(m["log_scale"] / 0.6745, 0.02), 4)
                    for name, m in measured.items()}


def _told(folder: Path) -> list[dict[str, Any]]:
    """The losses and measures of a part at each of its checkpoints."""
    return [json.loads(line) for line in (folder / "losses.jsonl").read_text().splitlines()]


def _where(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"CPU, {platform.machine()}, {os.cpu_count()} cores"
