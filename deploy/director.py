"""`python -m saccade.deploy.director` prepares a run, follows it, and says how it ended.

It is for services that something else starts, such as Docker. It writes the configuration of each world into a new
folder in SACCADE_RUNS, where every service reads it. At the end it writes a file that tells them that the run is over.
"""

from __future__ import annotations

import argparse
import os
import queue
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

from rich.console import Console

from saccade.app.cli.texts import configured, numbers
from saccade.app.run.display import LINE_EVERY, Progress, line, say
from saccade.app.run.follow import Messages, follow
from saccade.app.run.launch import resolve
from saccade.app.run.registry import AGENTS, DEFAULT_WORLD, WORLDS, agent_processes, world_of
from saccade.app.run.summary import summary
from saccade.app.run.supervisor import HUNG_S, Process
from saccade.deploy.container import LATEST, OVER, ROUTER_S, heartbeat_file, runs_folder
from saccade.services.camera.sources import ROS_PREFIX, is_live
from saccade.services.viewer.server import guide_url_of, url_of
from saccade.shared.admission import with_token
from saccade.shared.bus.messages import Message, Result
from saccade.shared.bus.topics import BELIEF, FRAME, PLAN, RESULT, STATUS, TRUTH, Topic
from saccade.shared.bus.transport import ZenohBus
from saccade.shared.config import Config, load, weights_folder
from saccade.shared.errors import SaccadeError
from saccade.shared.log.folder import CONFIG_NAME, LOG_NAME
from saccade.shared.loop.process import EXIT_ERROR, Item

SHOWN = (PLAN, BELIEF, STATUS, RESULT)
BEAT_S = 0.5


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m saccade.deploy.director", description=__doc__.splitlines()[0])
    parser.add_argument("--endpoint", default="tcp/127.0.0.1:7447", help="the router's address, for the services")
    parser.add_argument("--listen", help="the address at which the router listens, if it is another one")
    parser.add_argument("--objects", default=None, help="object set: pantry, ycb")
    parser.add_argument("--agent", help=f"one of {', '.join(AGENTS)}; without it the one that knows the objects")
    parser.add_argument("--weights", default=None, help="a folder of weights, or its name in weights/")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--count", type=int, default=None, help="number of scenes, one after the other")
    parser.add_argument("--worlds", type=int, default=1, help="number of worlds, side by side")
    parser.add_argument("--world", default=DEFAULT_WORLD, help=f"one of {', '.join(WORLDS)}")
    parser.add_argument("--profiles", help="instead: profiles of Compose, of which one is the world, and the others "
                                           "may be guide and ros")
    parser.add_argument("--source", help="images of a camera: a folder, a video, a webcam or a topic of ROS 2")
    parser.add_argument("--poses", help="poses of that camera: JSON lines or TUM")
    parser.add_argument("--intrinsics", metavar="fx,fy,cx,cy", help="intrinsics of its images, in pixels")
    parser.add_argument("--board", help="description of a printed board that tells its poses")
    parser.add_argument("--calibration", help="calibration of its lens")
    parser.add_argument("--goal", help="image of the view to find; without it a camera's agent explores")
    parser.add_argument("--ros-router", help="address of the router of ROS 2")
    parser.add_argument("--guide-port", type=int, help="port of the page that guides a hand")
    parser.add_argument("--view-port", type=int, help="port of the viewer's page, open to other hosts")
    parser.add_argument("--view-data-port", type=int, default=9876, help="port of the viewer's data")
    parser.add_argument("--view-published", metavar="ADDRESS",
                        help="address of the machine on which a container publishes these ports")
    parser.add_argument("--set", default="", metavar="'KEY=VALUE ...'", help="configuration by dotted keys")
    return parser


def _given(told: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """The configuration that the command line asks for, by dotted keys, and its world."""
    profiles = (told.profiles or told.world).split(",")
    world = next((name for name in profiles if name in WORLDS), profiles[0])
    source = told.source or None
    given = {"bus.endpoint": told.endpoint, "bus.listen": told.listen, "scene.objects": told.objects,
             "perception.weights": weights_folder(told.weights), "seed": told.seed, "scene.count": told.count,
             "camera.source": source, "camera.poses": told.poses or None,
             "camera.intrinsics_px": numbers(told.intrinsics or None), "camera.board": told.board or None,
             "camera.calibration": told.calibration or None, "scene.goal_image": told.goal or None}
    if told.ros_router and ("ros" in profiles or (source or "").startswith(ROS_PREFIX)):
        given |= {"ros.router": told.ros_router, "ros.publish": "ros" in profiles}
    if world_of(world).live:  # a real camera has no scenes to draw, and waits for nobody
        given |= {"scene.count": None, "scene.explore": not told.goal, "bus.live": True,
                  "planner.moved_by": "hand" if source and is_live(source) else None}
    if told.view_port:
        given |= {"viewer.address": "0.0.0.0", "viewer.port": told.view_port,
                  "viewer.data_port": told.view_data_port, "viewer.published": told.view_published}
    if told.guide_port and "guide" in profiles:
        given |= {"viewer.guide_port": told.guide_port}
    return given, world


def main(argv: Sequence[str] | None = None) -> None:
    """Directs one run. If the run cannot be prepared or does not come to its end, it prints one line and ends with exit
    code 2."""
    told = _parser().parse_args(argv)
    signal.signal(signal.SIGTERM, lambda *_: os._exit(0))  # its threads wait for messages, and nothing is left to save
    try:
        given, world = _given(told)
        config, agent = configured(None, given, shlex.split(told.set), told.agent or None)
        config = config.with_values({"viewer.token": with_token(config.viewer).token})
        if told.profiles and "guide" in told.profiles.split(","):
            print(f"where to go next: {guide_url_of(config.viewer)}", flush=True)
        direct(config, agent, world, told.worlds, runs_folder(), Console(width=200))
    except SaccadeError as error:
        print(f"saccade: {error}", file=sys.stderr)
        sys.exit(EXIT_ERROR)


def direct(config: Config, agent: str, world: str, worlds: int, runs: Path, console: Console) -> list[Result]:
    """Prepares a run and follows it to its end. Returns the results of all its worlds. Raises SaccadeError if it cannot
    be prepared, or if a service is not ready in time."""
    processes = agent_processes(agent, world)
    folders = prepare(resolve(config, processes), worlds, runs)
    with _Beating():
        console.print(f"run {folders[0].parent.name if worlds > 1 else folders[0].name}: waits for its services")
        if config.viewer.data_port:
            console.print(f"look at {url_of(config.viewer)}", highlight=False)
        with ThreadPoolExecutor(worlds) as pool:
            found = list(pool.map(lambda folder: _follow(folder, processes, console, worlds), folders))
    for folder in folders:
        (folder / OVER).touch()
    return [result for results in found for result in results]


def prepare(config: Config, worlds: int, runs: Path) -> list[Path]:
    """Writes the configuration of each world into a new folder of `runs`, and makes the link `latest` point to that
    folder. Returns the folders of the worlds. Raises SaccadeError if they cannot be written, or if `worlds` is less
    than one."""
    if worlds < 1:
        raise SaccadeError(f"{worlds} worlds: it takes one at least")
    run = runs / f"{time.strftime('%Y%m%d-%H%M%S')}-{config.seed}"
    folders = [run / f"{config.bus.world}-{k}" for k in range(worlds)] if worlds > 1 else [run]
    try:
        for k, folder in enumerate(folders):
            folder.mkdir(parents=True)
            values: dict[str, Any] = {"run": run.name, "seed": config.seed + k}
            if worlds > 1:
                values |= {"run": f"{run.name}-{folder.name}", "bus.world": folder.name}
            config.with_values(values).save(folder / CONFIG_NAME)
        pointer = runs / f".{LATEST}"
        pointer.unlink(missing_ok=True)
        pointer.symlink_to(run.name)
        pointer.replace(runs / LATEST)
    except OSError as error:
        raise SaccadeError(f"{runs} cannot be written by user {os.getuid()} ({error.strerror}): set SACCADE_UID to "
                           "the number of its owner, or give the folder to that user") from error
    return folders


def _follow(folder: Path, processes: Sequence[Process], console: Console, worlds: int) -> list[Result]:
    config = load(folder / CONFIG_NAME)
    prefix = f"{config.bus.world}: " if worlds > 1 else ""
    progress = Progress(judged=not config.bus.live)
    arrived: queue.SimpleQueue[Item] = queue.SimpleQueue()
    view = FRAME if config.bus.live else TRUTH

    def tell(text: str) -> None:
        say(console, prefix + text)

    def on_message(topic: Topic, part: str | None, message: Message) -> None:
        progress.take(topic, part, message)
        if topic == view and message.step % LINE_EVERY == 0:
            tell(line(progress))

    with closing(ZenohBus(config.bus.endpoint, world=config.bus.world, timeout_s=ROUTER_S)) as bus:
        bus.subscribe((view, *SHOWN), lambda *item: arrived.put(item))
        # Not the router, which only the first world hears
        elsewhere = Elsewhere([process.name for process in processes[1:]], tell)
        told = Messages(arrived, bus, elsewhere, config.run or folder.name, tell)
        results = follow(told, elsewhere, processes, on_message, live=config.bus.live)
    for text in summary(config, results, progress):
        tell(text)
    tell(f"log: {Path(runs_folder().name) / folder.relative_to(runs_folder()) / LOG_NAME}")
    return results


class Elsewhere:
    """Takes the supervisor's place where something else starts the services. It hears their heartbeats, and names the
    services that fall silent."""

    def __init__(self, names: Sequence[str], say: Callable[[str], None]) -> None:
        self.stopped = False
        self._names, self._say = frozenset(names), say
        self._heard_s: dict[str, float] = {}
        self._silent: set[str] = set()

    def heard(self, name: str, state: str) -> None:
        """Takes a heartbeat of a service."""
        if name in self._silent and name in self._names:
            self._silent.discard(name)
            self._say(f"{name} is heard again")
        self._heard_s[name] = time.monotonic()

    def check(self) -> None:
        """Names each service that was heard and is silent now."""
        for name, at_s in self._heard_s.items():
            if name in self._names and name not in self._silent and time.monotonic() - at_s > HUNG_S:
                self._silent.add(name)
                self._say(f"nothing is heard of {name} for {HUNG_S:.0f} s")

    def settled(self, since_s: float) -> bool:
        """Whether all services were heard since that time (monotonic clock, seconds)."""
        return all(self._heard_s.get(name, 0.0) > since_s for name in self._names)


class _Beating:
    """This process's own heartbeat, in a file."""

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def _run(self) -> None:
        file = heartbeat_file("director")
        file.write_text("ready")
        while not self._stop.wait(BEAT_S):
            file.touch()

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._stop.set()


if __name__ == "__main__":
    main()
