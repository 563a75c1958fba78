"""`saccade run`: one run of the agent, logged whole; on the bus, or in this one process."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from rich.console import Console

from deploy.display import Display, Progress, spread_cm
from deploy.launch import launch
from deploy.registry import agent_of, agent_processes, local_pairs
from deploy.supervisor import CONFIG_NAME
from services.camera.sources import absolute
from services.recorder.core import LOG_NAME, describe
from services.simulator.core import names_in_use
from shared.config import Config
from shared.errors import SaccadeError
from shared.loop import run_local
from shared.messages import Message, Result
from shared.recording import RecordingStopped, RunLog
from shared.topics import Topic

PICTURE_NAME = "picture.png"
MANIFEST_NAME = "manifest.json"


def run(config: Config, *, agent: str, out: Path | None, plain: bool, console: Console | None = None) -> list[Result]:
    """Runs all episodes of a configuration into a new folder; prints how they ended and where it is."""
    console = console or Console()
    config = resolve(config)
    require_weights(agent, config)
    processes = agent_processes(agent) if config.bus.kind == "zenoh" else ()
    folder = _new_folder(out or Path("runs") / f"{time.strftime('%Y%m%d-%H%M%S')}-{config.seed}")
    judged = not config.scene.explore and config.scene.goal_image is None
    with Display(console, plain=plain, judged=judged) as display:
        if processes:
            results = launch(config, folder, display.take, processes, display.say)
        else:
            results = run_here(config, agent, folder, display)
    for text in _ending(config, results, display.progress):
        console.print(text, markup=False, highlight=False, soft_wrap=True)
    _draw(folder)
    console.print(f"log, configuration and picture are in {folder}", markup=False, highlight=False, soft_wrap=True)
    return results


def resolve(config: Config) -> Config:
    """The configuration with its objects named and its paths absolute."""
    scene = config.scene
    paths = {"scene.file": scene.file, "scene.goal_image": scene.goal_image,
             "camera.poses": config.camera.poses, "perception.weights": config.perception.weights}
    source = {} if config.camera.source is None else {"camera.source": absolute(config.camera.source)}
    return config.with_values({"scene.names": list(names_in_use(scene))} | source |
                              {key: path.resolve() for key, path in paths.items() if path is not None})


def require_weights(agent: str, config: Config) -> None:
    """Raises SaccadeError where the agent's weights are missing: before any process starts, and without torch."""
    if agent_of(agent).weights and not (config.weights / MANIFEST_NAME).is_file():
        from shared.weights import Weights

        Weights(config.weights)


def run_here(config: Config, agent: str, folder: Path, display: Display) -> list[Result]:
    """The run within this process, logged as on the bus. A log that can take no more does not stop it."""
    pairs = local_pairs(agent, config)
    folder.mkdir(parents=True, exist_ok=True)
    config.save(folder / CONFIG_NAME)
    log = RunLog(folder / LOG_NAME, world=config.bus.world, configuration=config.model_dump_json(indent=2),
                 metadata=describe(config, folder.name))

    def on_message(topic: Topic, part: str | None, message: Message, payload: bytes | None) -> None:
        try:
            log.write(topic, part, payload, sequence=message.seq)
        except RecordingStopped as error:  # once; what follows is not logged
            print(f"saccade: {error}", file=sys.stderr)
        display.take(topic, part, message)

    try:
        run_local(pairs, config.scene.names, folder.name, on_message=on_message, encoded=True)
    finally:
        log.close()
    return display.progress.results


def _new_folder(folder: Path) -> Path:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SaccadeError(f"{folder} is there already: a run needs a new folder, give another --out")
    return folder


def _ending(config: Config, results: list[Result], progress: Progress) -> list[str]:
    lines = [_result_line(config, result) for result in results] + _doubts(config, progress)
    if config.scene.explore:
        found = [belief for _, belief in sorted(progress.beliefs.items()) if belief.presence > 0.5]
        for belief in found:
            where = ", ".join(f"{x:.3f}" for x in belief.mean_m)
            lines.append(f"found {belief.object} at ({where}) m ± {spread_cm(belief):.1f} cm")
    elif len(results) > 1 and config.scene.goal_image is None:
        lines.append(f"reached {sum(r.success for r in results)} of {len(results)} goals")
    return lines


def _doubts(config: Config, progress: Progress) -> list[str]:
    """What the agent itself says, after the last episode, of why there was nothing to reach."""
    plan = progress.plan
    if plan is None or config.scene.explore:
        return []
    if not plan.target:
        return [f"the goal image shows none of the known objects (confidence {plan.goal_confidence:.2f}): the agent "
                "explored instead"]
    target = progress.beliefs.get(plan.target)
    if target is not None and target.presence < 0.5:
        return [f"{plan.target} was not found: believed not to be there (presence {target.presence:.2f})"]
    return []


def _result_line(config: Config, result: Result) -> str:
    """How one episode ended; errors only where the goal's true view is known."""
    if config.scene.explore:
        return f"{result.scene}: explored for {result.steps} steps"
    if config.scene.goal_image is not None:
        said = f"says after {result.steps} steps that it is there" if result.declared else \
            f"did not find the goal's view in {result.steps} steps"
        return f"goal image {config.scene.goal_image.name}: the agent {said}"
    reached = "reached the goal" if result.success else "did not reach the goal"
    return (f"{result.scene}: {reached} in {result.steps} steps; errors: azimuth {result.azimuth_error_rad:.3f} rad, "
            f"elevation {result.elevation_error_rad:.3f} rad, range {result.range_error_m:.3f} m")


def _draw(folder: Path) -> None:
    """The picture; that it cannot be drawn does not undo the run."""
    from deploy.picture import draw

    try:
        draw(folder / LOG_NAME, folder / PICTURE_NAME)
    except SaccadeError as error:
        print(f"saccade: no picture: {error}", file=sys.stderr)
