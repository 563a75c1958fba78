"""`saccade run` runs an agent and logs everything, on the bus or within this process."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from saccade.app.run.display import Display, say
from saccade.app.run.launch import launched
from saccade.app.run.registry import DEFAULT_WORLD, agent_of, agent_processes, local_pairs, require_services, world_of
from saccade.app.run.summary import summary, unusable_line
from saccade.app.run.supervisor import VIEWER
from saccade.services.camera.calibration import calibration_path
from saccade.services.camera.core import build as build_camera
from saccade.services.camera.core import require_one_of_each
from saccade.services.camera.sources import absolute, is_live
from saccade.services.recorder.core import describe, to_be_finished
from saccade.services.viewer.server import binary, guide_url_of, url_of, with_free_ports, with_guide
from saccade.shared.bus.messages import Message, Result
from saccade.shared.bus.topics import Topic
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError, is_text
from saccade.shared.files import writing
from saccade.shared.log.folder import CONFIG_NAME, LOG_NAME
from saccade.shared.log.recording import FINISHED, RecordingStopped, RunLog
from saccade.shared.loop.local import run_local
from saccade.shared.render.objects import names_in_use

MANIFEST_NAME = "manifest.json"


@dataclass(frozen=True)
class Finished:
    """A run that is over: its resolved configuration, its folder, how its episodes ended, whether its viewer still
    shows it, and what did not end well, such as a log that lacks a part."""

    config: Config
    folder: Path
    results: list[Result]
    is_viewed: Callable[[], bool]
    lacks: tuple[str, ...] = ()


def run(config: Config, *, agent: str, out: Path | None, plain: bool, console: Console | None = None,
        world: str = DEFAULT_WORLD, view: bool = False, guide: bool | None = None,
        after: Callable[[Finished], None] | None = None) -> Finished:
    """Runs all episodes of a configuration into a new folder, and prints how they ended.

    A run with a real camera may also be ended by Ctrl-C. With `view` the run can be watched in a browser. With `guide`
    a page tells who holds the camera where to go; if this is left open, there is one if a hand moves it. `after` is
    called when the run is over, while the viewer is still there; a run that was interrupted has no viewer any more.
    Raises SaccadeError if the run cannot be started as it is configured, if the folder is not new, or if a service
    fails.
    """
    console, place = console or Console(), world_of(world)
    config = resolve(in_world(config, world))
    require_services(agent, config, world)
    require_weights(agent, config)
    if view:
        config = to_be_viewed(config)
    guide = config.planner.moved_by == "hand" and config.bus.kind == "zenoh" if guide is None else guide
    if guide:
        config = to_be_guided(config)
    if config.ros.publish and config.bus.kind != "zenoh":
        raise SaccadeError("ros.publish is for services on the bus: leave `--bus local` out")
    processes = agent_processes(agent, world, view=view, ros=config.ros.publish,
                                guide=guide) if config.bus.kind == "zenoh" else ()
    folder = _new_folder(out or Path("runs") / f"{time.strftime('%Y%m%d-%H%M%S')}-{config.seed}")
    lacks: list[str] = []
    ended = None  # stays None if the run is interrupted: then no viewer stays
    with ExitStack() as stack:
        with Display(console, plain=plain, judged=config.scene.goal_view_is_known,
                     source=place.source, live=place.live) as display:
            if view:
                display.say(f"look at {url_of(config.viewer)}")
            if guide:
                display.say(f"where to go next: {guide_url_of(config.viewer)}")
            try:
                if processes:
                    ended = stack.enter_context(
                        launched(config, folder, display.take, processes, display.say, display.topics))
                    results = ended.results
                    lacks += ended.lacks
                else:
                    results = run_here(config, agent, folder, display, world, lacks)
            except KeyboardInterrupt:
                if not place.live or display.progress.at is None:
                    raise
                results = []
        for text in summary(config, results, display.progress):
            say(console, text)
        finished = Finished(config, folder, results, lambda: ended is not None and ended.runs(VIEWER.name),
                            tuple(lacks))
        if after is not None:
            after(finished)
    return finished


def to_be_viewed(config: Config) -> Config:
    """Returns the configuration with free ports for the viewer. Raises SaccadeError if the run cannot have a viewer."""
    if config.bus.kind != "zenoh":
        raise SaccadeError("--view is for services on the bus: leave `--bus local` out, or look at the log with "
                           "`saccade view`")
    binary()
    return with_free_ports(config)


def to_be_guided(config: Config) -> Config:
    """Returns the configuration with a free port for the page that guides a hand. Raises SaccadeError if the run cannot
    have one."""
    if config.bus.kind != "zenoh":
        raise SaccadeError("--guide is for services on the bus: leave `--bus local` out")
    return with_guide(config)


def in_world(config: Config, world: str) -> Config:
    """Returns the configuration for that world. Raises SaccadeError if the world has no use for one of its keys, or if
    the camera's source cannot be used. This is checked before anything starts."""
    scene, camera = config.scene, config.camera
    if not world_of(world).live:
        if camera.source is not None:
            raise SaccadeError("camera.source is for a real camera: add `--world camera`, or world='camera' in Python")
        return config
    if scene.file or scene.scene or scene.n_objects or scene.count > 1:
        raise SaccadeError(f"scenes are the simulator's: in the world {world!r} give no scenes file, no scene, and no "
                           "number of objects or scenes")
    mover = "hand" if camera.source is not None and is_live(camera.source) else None
    config = config.with_values({"scene.explore": scene.explore or scene.goal_image is None,
                                 "bus.live": config.bus.kind == "zenoh",
                                 "planner.moved_by": config.planner.moved_by or mover})
    from_outside = config.services.source is not None
    if not from_outside:
        require_one_of_each(camera)
    if not from_outside and (camera.source is None or not is_live(camera.source)):
        build_camera(config)  # not for what is live: this would switch a webcam on and off
    return config


def resolve(config: Config) -> Config:
    """Returns the configuration with the names of its objects and with absolute paths."""
    scene = config.scene
    paths = {"scene.file": scene.file, "scene.goal_image": scene.goal_image,
             "camera.poses": config.camera.poses, "camera.board": config.camera.board,
             "perception.weights": config.perception.weights}
    more = {"camera.more_boards": [str(path.resolve()) for path in config.camera.more_boards]} \
        if config.camera.more_boards else {}
    source = {} if config.camera.source is None else {"camera.source": absolute(config.camera.source)}
    if config.camera.calibration is not None:
        paths["camera.calibration"] = calibration_path(config.camera.calibration)
    return config.with_values({"scene.names": list(names_in_use(scene))} | source | more |
                              {key: path.resolve() for key, path in paths.items() if path is not None})


def require_weights(agent: str, config: Config) -> None:
    """Checks for the agent's weights before any process starts, without loading PyTorch. Raises SaccadeError if they
    are missing."""
    if agent_of(agent).weights and not (config.weights / MANIFEST_NAME).is_file():
        from saccade.shared.model.weights import weights_in_use

        weights_in_use(config)


def run_here(config: Config, agent: str, folder: Path, display: Display, world: str, lacks: list[str]) -> list[Result]:
    """Runs within this process, and logs as on the bus. If the log cannot take any more, the run goes on without it,
    and `lacks` says why."""
    pairs = local_pairs(agent, config, world)
    source = pairs[0][1]
    with writing(folder, "run"):
        folder.mkdir(parents=True, exist_ok=True)
    config.save(folder / CONFIG_NAME)
    log = RunLog(folder / LOG_NAME, world=config.bus.world, configuration=config.model_dump_json(indent=2),
                 metadata=describe(config, folder.name) | to_be_finished())

    def on_message(topic: Topic, part: str | None, message: Message, payload: bytes | None) -> None:
        end_if_interrupted()
        assert payload is not None  # because of encoded=True
        with _told(lacks):  # once; later messages are not logged
            log.write(topic, part, payload, sequence=message.seq)
        display.take(topic, part, message)

    display.note("\n".join(getattr(source, "notes", ())))
    with _interrupted_between_messages() as end_if_interrupted:
        try:
            run_local(pairs, config.names, folder.name, on_message=on_message, encoded=True)
            _finish(log, source, lacks)
        except KeyboardInterrupt:
            if world_of(world).live:  # one of the ends that the run of a real camera has
                _finish(log, source, lacks)
            raise
        finally:
            with _told(lacks):
                log.close()
            if left_out := getattr(source, "skipped", 0):
                display.note(f"{left_out} images without a pose were left out")
            if unusable := getattr(source, "refused", 0):
                display.note(unusable_line(unusable))
    return display.progress.results


def _finish(log: RunLog, source: object, lacks: list[str]) -> None:
    """Notes in the log that the run has come to its end."""
    with _told(lacks):
        log.note(FINISHED, {"episodes": getattr(source, "episodes", 1)})


@contextmanager
def _told(lacks: list[str]) -> Iterator[None]:
    """Around what writes a log. A log that cannot take any more is no end of the run: it is said, and added to
    `lacks`."""
    try:
        yield
    except RecordingStopped as error:
        lacks.append(str(error))
        print(f"saccade: {error}", file=sys.stderr)


@contextmanager
def _interrupted_between_messages() -> Iterator[Callable[[], None]]:
    """Yields a function. Ctrl-C takes effect where this function is called, because an interruption within a write
    would damage the log. A second Ctrl-C takes effect at once."""
    interrupted = threading.Event()

    def raise_if_interrupted() -> None:
        if interrupted.is_set():
            raise KeyboardInterrupt

    def on_interrupt(_number: int, _frame: object) -> None:
        raise_if_interrupted()
        interrupted.set()

    if threading.current_thread() is not threading.main_thread():
        yield raise_if_interrupted
        return
    before = signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield raise_if_interrupted
    finally:
        signal.signal(signal.SIGINT, before)


def _new_folder(folder: Path) -> Path:
    if not is_text(str(folder.absolute())):
        raise SaccadeError(f"run folder {folder} must be Unicode without control codes: name another folder")
    if os.path.lexists(folder) and (not os.path.isdir(folder) or any(folder.iterdir())):
        raise SaccadeError(f"{folder} is there already: a run needs a new folder, name another one")
    return folder
