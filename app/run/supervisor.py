"""The processes of a run: this module starts them, watches them, starts them again when they die, and stops them in
order."""

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

STOP_S = 10.0  # a service that was told to stop is killed after this time
RESTARTS, RESTARTS_S = 5, 60.0  # a service is started again at most 5 times in 60 s
HUNG_S = 2.0  # a service without a heartbeat for so long hangs; there are two per second
HUNG_KILLED_S = 10.0
SETTLED_S = 5.0  # until a restarted service has got what it missed
# The arrays of a step are freed and made again. By default glibc would return their memory to the system each time,
# which takes 5 ms of the planner's 30.
KEEP_PAGES = {"MALLOC_TRIM_THRESHOLD_": str(512 * 1024 * 1024), "MALLOC_MMAP_THRESHOLD_": str(64 * 1024 * 1024)}
BACK_S = 6.0  # the others need so long to find a restarted router


@dataclass(frozen=True)
class Process:
    """The process of one service: `python -m <module>`. An `onlooker` is not needed: nobody waits for it, a run does
    not fail with it, and it can stay when the others are stopped."""

    name: str
    module: str
    onlooker: bool = False


VIEWER = Process("viewer", "saccade.services.viewer", onlooker=True)
ROS = Process("ros", "saccade.services.ros", onlooker=True)
GUIDE = Process("guide", "saccade.services.guide", onlooker=True)


class Supervisor:
    """Holds one child process for each service. `say(text)` is told what happens to them."""

    def __init__(self, run_dir: Path, say: Callable[[str], None]) -> None:
        self._run_dir, self._say = run_dir, say
        self._processes: dict[str, Process] = {}
        self._children: dict[str, subprocess.Popen] = {}
        self._heard_s: dict[str, float] = {}  # when each service was last heard since its (re)start
        self._up: set[str] = set()  # the services that have started and not ended since
        self._silent: set[str] = set()
        self.stopped, self._checked_s = False, time.monotonic()
        self._restarts: dict[str, deque[float]] = defaultdict(deque)

    def start(self, process: Process) -> None:
        """Starts a service in a session of its own. So Ctrl-C reaches only the launcher, which then stops all services
        in order."""
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
        """Whether all services are up and were heard since that time (monotonic clock, seconds), and the last restart
        was at least SETTLED_S ago."""
        last_s = max((past[-1] for past in self._restarts.values() if past), default=-SETTLED_S)
        return (time.monotonic() - last_s >= SETTLED_S and self._up == set(self._children)
                and all(at_s > since_s for at_s in self._heard_s.values())
                and all(child.poll() is None for child in self._children.values()))

    def heard(self, name: str, state: str) -> None:
        """Takes a heartbeat of a service."""
        if name in self._children:
            self._heard_s[name] = time.monotonic()
            if state != STARTING:
                self._up.add(name)
            if name in self._silent:
                self._silent.discard(name)
                self._say(f"{name} is heard again")

    def check(self) -> None:
        """It must be called a few times a second. It starts a service again that died. It names a service that hangs,
        and kills it after HUNG_KILLED_S.

        Raises SaccadeError if a service says why it cannot run, or if it has died too often.
        """
        if self.stopped:
            return
        for name, child in list(self._children.items()):
            if child.poll() is not None:
                self._start_again(name, child.returncode)
        now_s = time.monotonic()
        if now_s - self._checked_s > HUNG_S:  # this process itself was suspended
            self._heard_s = dict.fromkeys(self._heard_s, now_s)
        self._checked_s = now_s
        silent = {name: now_s - at_s for name, at_s in self._heard_s.items() if now_s - at_s > HUNG_S}
        router = next(iter(self._processes), None)  # while the router is silent, no other can be heard
        for name in [router] if router in silent else silent:
            if name not in self._silent:
                self._silent.add(name)
                self._say(f"{name} hangs: nothing was heard of it for {silent[name]:.0f} s")
            if silent[name] > HUNG_KILLED_S:
                self._say(f"{name} is ended: it hung for {silent[name]:.0f} s")
                self._children[name].kill()
                self._children[name].wait()

    def stop(self, *, onlookers: bool = True) -> None:
        """Ends the services in the order of the data, so that each can work off what the one before it has sent. The
        router was started first and is ended last. Onlookers stay if `onlookers` is false."""
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
            except BaseException:  # interrupted again: leave no process behind
                for other in self._children.values():
                    other.kill()
                    other.wait()
                raise

    def runs(self, name: str) -> bool:
        """Whether the process of a service is running."""
        return name in self._children and self._children[name].poll() is None

    def complaints(self) -> list[str]:
        """For each stopped service that did not end well, onlookers aside: its name, and what it said last."""
        return [f"{name}: {self._last_line(name, child.returncode)}"
                for name, child in self._children.items() if child.returncode and not self._processes[name].onlooker]

    def was_killed(self, name: str) -> bool:
        """Whether a stopped service was ended by a signal, before it could end by itself."""
        return name in self._children and (self._children[name].returncode or 0) < 0

    def log_path(self, name: str) -> Path:
        """The file that holds what a service prints."""
        return self._run_dir / LOGS_NAME / f"{name}.log"

    def _start_again(self, name: str, code: int) -> None:
        reason, past, now_s = self._last_line(name, code), self._restarts[name], time.monotonic()
        while past and now_s - past[0] > RESTARTS_S:
            past.popleft()
        if code == EXIT_ERROR or len(past) >= RESTARTS:
            died = "" if code == EXIT_ERROR else f"; it has died {len(past) + 1} times in {RESTARTS_S:.0f} s"
            router = next(iter(self._processes))
            if code == EXIT_ERROR and self._restarts.get(router):  # without it nobody can work
                reason = f"{reason}; the {router} has died {len(self._restarts[router])} times"
            if not self._processes[name].onlooker:
                raise SaccadeError(f"{name}: {reason}{died}")
            self._say(f"the run goes on without the {name}: {reason}{died}")
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
