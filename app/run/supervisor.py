"""The processes of a run: started, watched, started again when they die, stopped in order."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from saccade.app.run.threads import VARIABLES
from saccade.shared.errors import SaccadeError
from saccade.shared.log.folder import CONFIG_NAME, LOGS_NAME
from saccade.shared.loop.process import EXIT_ERROR, LAUNCHER_VARIABLE, STARTING

STOP_S = 10.0  # then a service that was told to stop is killed
RESTARTS, RESTARTS_S = 5, 60.0  # so often within so long a service is started again, no more
HUNG_S = 2.0  # without a heartbeat, of which there are two a second
HUNG_KILLED_S = 10.0
SETTLED_S = 5.0  # after which a service that died has been told what it missed
# A step's arrays are freed and made again: glibc would give their pages back each time, 5 ms of the planner's 30.
KEEP_PAGES = {"MALLOC_TRIM_THRESHOLD_": str(512 * 1024 * 1024), "MALLOC_MMAP_THRESHOLD_": str(64 * 1024 * 1024)}
BACK_S = 6.0  # what a router's return takes the others


@dataclass(frozen=True)
class Process:
    """One service's process: `python -m <module>`. An `onlooker` is not needed: nobody waits for it, a run does not
    fail with it, and it stays when the others are stopped."""

    name: str
    module: str
    onlooker: bool = False


VIEWER = Process("viewer", "saccade.services.viewer", onlooker=True)


class Supervisor:
    """One child process per service. `say(text)` is told what happens to them."""

    def __init__(self, run_dir: Path, say: Callable[[str], None]) -> None:
        self._run_dir, self._say = run_dir, say
        self._processes: dict[str, Process] = {}
        self._children: dict[str, subprocess.Popen] = {}
        self._heard_s: dict[str, float] = {}  # since a service was (re)started: when it was last heard of
        self._up: set[str] = set()  # those that have started, and not ended since
        self._silent: set[str] = set()
        self.stopped, self._checked_s = False, time.monotonic()
        self._restarts: dict[str, deque[float]] = defaultdict(deque)

    def start(self, process: Process) -> None:
        """Starts a service. A session of its own: Ctrl-C reaches the launcher, which then stops all in order."""
        environment = {**dict.fromkeys(VARIABLES, "1"), **KEEP_PAGES, **os.environ, LAUNCHER_VARIABLE: str(os.getpid())}
        self._processes[process.name] = process
        self._heard_s.pop(process.name, None)
        self._silent.discard(process.name)
        self._up.discard(process.name)
        with self.log_path(process.name).open("ab") as log:
            self._children[process.name] = subprocess.Popen(
                [sys.executable, "-m", process.module, "--config", str(self._run_dir / CONFIG_NAME)], env=environment,
                stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True)

    def settled(self, since_s: float) -> bool:
        """Whether all services are up and were heard since that time, and the last of those that died has been back for
        a while."""
        last_s = max((past[-1] for past in self._restarts.values() if past), default=-SETTLED_S)
        return (time.monotonic() - last_s >= SETTLED_S and self._up == set(self._children)
                and all(at_s > since_s for at_s in self._heard_s.values())
                and all(child.poll() is None for child in self._children.values()))

    def heard(self, name: str, state: str) -> None:
        """A heartbeat has come."""
        if name in self._children:
            self._heard_s[name] = time.monotonic()
            if state != STARTING:
                self._up.add(name)
            if name in self._silent:
                self._silent.discard(name)
                self._say(f"{name} is heard again")

    def check(self) -> None:
        """To be called a few times a second: starts again what died, names what hangs and ends it after a while.

        Raises SaccadeError for a service that says why it cannot run, or has died too often.
        """
        if self.stopped:
            return
        for name, child in list(self._children.items()):
            if child.poll() is not None:
                self._start_again(name, child.returncode)
        now_s = time.monotonic()
        if now_s - self._checked_s > HUNG_S:  # this process was suspended: it has heard nobody
            self._heard_s = dict.fromkeys(self._heard_s, now_s)
        self._checked_s = now_s
        silent = {name: now_s - at_s for name, at_s in self._heard_s.items() if now_s - at_s > HUNG_S}
        router = next(iter(self._processes), None)  # while it is silent, nobody else can be heard
        for name in [router] if router in silent else silent:
            if name not in self._silent:
                self._silent.add(name)
                self._say(f"{name} hangs: nothing was heard of it for {silent[name]:.0f} s")
            if silent[name] > HUNG_KILLED_S:
                self._say(f"{name} is ended: it hung for {silent[name]:.0f} s")
                self._children[name].kill()
                self._children[name].wait()

    def stop(self, *, onlookers: bool = True) -> None:
        """Ends the services in the order of the data, so that each works off what the one before it has sent; the
        router, which came first, last. Those that look on may stay."""
        self.stopped = True
        ended = [child for name, child in self._children.items() if onlookers or not self._processes[name].onlooker]
        router, others = ended[:1], ended[1:]
        for child in others + router:
            try:
                if child.poll() is None:
                    child.terminate()
                    child.wait(STOP_S)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()
            except BaseException:  # interrupted once more: no orphans, whatever happens
                for other in self._children.values():
                    other.kill()
                    other.wait()
                raise

    def runs(self, name: str) -> bool:
        """Whether a service's process is there."""
        return name in self._children and self._children[name].poll() is None

    def complaints(self) -> list[str]:
        """Of the stopped services: who did not end well, and what it said last."""
        return [f"{name}: {self._last_line(name, child.returncode)}"
                for name, child in self._children.items() if child.returncode]

    def log_path(self, name: str) -> Path:
        """What a service prints."""
        return self._run_dir / LOGS_NAME / f"{name}.log"

    def _start_again(self, name: str, code: int) -> None:
        reason, past, now_s = self._last_line(name, code), self._restarts[name], time.monotonic()
        while past and now_s - past[0] > RESTARTS_S:
            past.popleft()
        if code == EXIT_ERROR or len(past) >= RESTARTS:
            died = "" if code == EXIT_ERROR else f"; it has died {len(past) + 1} times in {RESTARTS_S:.0f} s"
            if not self._processes[name].onlooker:
                raise SaccadeError(f"{name}: {reason}{died}")
            self._say(f"on without the {name}: {reason}{died}")
            self._forget(name)
            return
        past.append(now_s)
        self.start(self._processes[name])
        self._say(f"{name} is started again: {reason}")
        if name == next(iter(self._processes)):
            self._heard_s = {other: now_s + BACK_S for other in self._heard_s}

    def _forget(self, name: str) -> None:
        for known in (self._children, self._processes, self._heard_s, self._restarts):
            known.pop(name, None)
        self._up.discard(name)
        self._silent.discard(name)

    def _last_line(self, name: str, code: int) -> str:
        lines = self.log_path(name).read_text(errors="replace").strip().splitlines()
        reason = lines[-1].removeprefix("saccade: ") if lines else "it said nothing"
        how = f"ended with code {code}" if code >= 0 else f"was ended by signal {signal.Signals(-code).name}"
        return f"{reason} (it {how}; see {self.log_path(name)})"
