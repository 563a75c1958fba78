"""`python -m deploy.container SERVICE`: a service where something else starts and restarts it, such as Docker.

One process for each world of the newest run in SACCADE_RUNS, until that run is over. It ends with code 1 when one of
them died or hung, so that it is started again; a service that said why it cannot run stays down until told to stop.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from deploy.supervisor import CONFIG_NAME, HUNG_KILLED_S, KEEP_PAGES, STOP_S
from deploy.threads import VARIABLES
from shared.errors import SaccadeError
from shared.process import EXIT_ERROR, HEARTBEAT_VARIABLE, LAUNCHER_VARIABLE

RUNS_VARIABLE, HEARTBEATS_VARIABLE = "SACCADE_RUNS", "SACCADE_HEARTBEATS"
LATEST, OVER = "latest", "over"  # in the folder of the runs, and in the one of a run
ONE_FOR_ALL = ("router",)  # worlds share it
POLL_S = 0.2
EXIT_AGAIN = 1


def runs_folder() -> Path:
    """Where runs are, for containers."""
    return Path(os.environ.get(RUNS_VARIABLE, "runs"))


def heartbeat_file(name: str) -> Path:
    """Where a container's process says that it is well; `healthy.sh` looks there."""
    folder = Path(os.environ.get(HEARTBEATS_VARIABLE, "/tmp/heartbeats"))
    folder.mkdir(parents=True, exist_ok=True)
    return folder / name


def worlds_of(run: Path) -> list[Path]:
    """The folders of a run's worlds: its own, or those in it. Raises SaccadeError where it has none."""
    if (run / CONFIG_NAME).is_file():
        return [run.resolve()]
    if found := sorted(path.parent.resolve() for path in run.glob(f"*/{CONFIG_NAME}")):
        return found
    raise SaccadeError(f"{run} holds no configuration: the director makes it; is the same folder mounted here?")


class Container:
    """The processes of one service."""

    def __init__(self, name: str, worlds: Sequence[Path]) -> None:
        self._name, self._worlds = name, worlds
        self._stopping = threading.Event()
        self._children = {world: self._start(world) for world in (worlds[:1] if name in ONE_FOR_ALL else worlds)}

    def _start(self, world: Path) -> subprocess.Popen:
        environment = {**dict.fromkeys(VARIABLES, "1"), **KEEP_PAGES, **os.environ, LAUNCHER_VARIABLE: str(os.getpid()),
                       HEARTBEAT_VARIABLE: str(heartbeat_file(world.name))}
        return subprocess.Popen([sys.executable, "-m", f"services.{self._name}", "--config", world / CONFIG_NAME],
                                env=environment, start_new_session=True)

    def stop(self, *_: object) -> None:
        """Ends them; safe in a signal handler."""
        self._stopping.set()

    def run(self) -> int:
        """Until the run is over or `stop` was called; the exit code."""
        while not self._stopping.wait(POLL_S) and not all((world / OVER).exists() for world in self._worlds):
            if self._died() or self._hung():
                self._end()
                return EXIT_AGAIN
        self._end()
        return EXIT_ERROR if any(child.returncode == EXIT_ERROR for child in self._children.values()) else 0

    def _died(self) -> bool:
        codes = {world: child.poll() for world, child in self._children.items()}
        died = {world: code for world, code in codes.items() if code not in (None, 0, EXIT_ERROR)}
        for world, code in died.items():
            how = f"ended with code {code}" if code > 0 else f"was ended by signal {-code}"
            hint = ": was there enough memory?" if code == -signal.SIGKILL else ""
            print(f"saccade: {self._name} in {world.name} {how}{hint}", file=sys.stderr)
        return bool(died)

    def _hung(self) -> bool:
        for world, child in self._children.items():
            file = heartbeat_file(world.name)
            if child.poll() is None and file.exists() and time.time() - file.stat().st_mtime > HUNG_KILLED_S:
                print(f"saccade: {self._name} hung for {HUNG_KILLED_S:.0f} s: it is ended", file=sys.stderr)
                child.kill()
                return True
        return False

    def _end(self) -> None:
        for child in self._children.values():
            child.terminate()
        end_s = time.monotonic() + STOP_S - 1  # Docker kills after STOP_S
        for child in self._children.values():
            try:
                child.wait(max(0.1, end_s - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()


def main(argv: Sequence[str] | None = None) -> None:
    """Exit code 2, with one line, where there is no run."""
    name, = sys.argv[1:] if argv is None else argv
    try:
        container = Container(name, worlds_of(runs_folder() / LATEST))
    except SaccadeError as error:
        print(f"saccade: {name}: {error}", file=sys.stderr)
        sys.exit(EXIT_ERROR)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, container.stop)
    sys.exit(container.run())


if __name__ == "__main__":
    main()
