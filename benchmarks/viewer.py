"""`python -m saccade.benchmarks.viewer [out.json]` measures what a viewer costs, in steps per second of the closed
loop.

It compares no viewer, a viewer that nobody uses, a viewer with a browser, a browser that is suspended, and a viewer
that is suspended. The scenes are the same. The ways take turns, round after round. The browser draws in software on the
same processors, with the time that the agent leaves.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path

import psutil
from rich.console import Console

from saccade.app.run.launch import launch
from saccade.app.run.registry import agent_processes
from saccade.app.run.supervisor import VIEWER
from saccade.benchmarks.loop import CONFIG, Clock
from saccade.benchmarks.rounds import compared, in_turn
from saccade.services.viewer.priority import come_last
from saccade.services.viewer.server import url_of, with_free_ports
from saccade.shared.bus.topics import STATUS, TRUTH

ROUNDS = 4
SUSPENDED_AT = 20  # a browser or viewer is suspended after so many views
FLAGS = ("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
         "--remote-debugging-port=0", "--window-size=1600,1000")


@contextmanager
def browser(url: str) -> Iterator[int]:
    """Opens a page in headless Chromium, and yields its process group."""
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        sys.exit("saccade: no Chromium is installed: apt-get install chromium")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        child = subprocess.Popen([program, *FLAGS, f"--user-data-dir={profile}", url],
                                 stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
                                 preexec_fn=come_last)
        try:
            yield child.pid
        finally:
            os.killpg(child.pid, signal.SIGKILL)
            child.wait()


def measure(view: bool, look: bool = False, suspend: str = "") -> float:
    """Returns the steps per second. `suspend` names what is suspended once the run is under way: `browser` or
    `viewer`."""
    config, clock = with_free_ports(CONFIG), Clock()
    pages: list[str] = []
    with tempfile.TemporaryDirectory() as folder, browser(url_of(config.viewer)) if look else nullcontext() as group:
        def see(topic, part, message) -> None:
            if topic == STATUS and part == VIEWER.name and message.note and look and not pages:
                pages.append(message.note)
            clock.see(topic, part, message)
            if suspend and len(clock.seen_s) == SUSPENDED_AT:
                whom = group if suspend == "browser" else viewer_of(folder)
                assert whom is not None  # a suspended browser was opened before
                os.killpg(whom, signal.SIGSTOP)

        launch(config, Path(folder) / "loop", see, agent_processes("sceneccn", view=view), topics=(TRUTH,),
               say=lambda text: print(text, file=sys.stderr))
    return clock.steps_per_s


def viewer_of(folder: str) -> int:
    """Returns the process id of the viewer of the run in that folder."""
    return next(p.pid for p in psutil.process_iter(["cmdline"])
                if VIEWER.module in (line := p.info["cmdline"] or []) and any(folder in word for word in line))


def main() -> None:
    """Prints a table. With a file's name it writes the numbers there."""
    ways = {"no viewer": partial(measure, False), "viewer": partial(measure, True),
            "viewer and browser": partial(measure, True, look=True),
            "browser suspended": partial(measure, True, look=True, suspend="browser"),
            "viewer suspended": partial(measure, True, suspend="viewer")}
    Console().print(compared(in_turn(ways, ROUNDS), "who looks", ("no viewer",)))


if __name__ == "__main__":
    main()
