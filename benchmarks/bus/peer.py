"""The two ends of a contender. Each is a process that `python -m saccade.benchmarks.bus.contenders` starts.

FOLDER/round.json says what to do. FOLDER/<role>.npy gets the times.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

import numpy as np

from saccade.benchmarks.bus.measure import Plan, Receive, Send, receive_all, send_all
from saccade.shared.errors import SaccadeError

SENDER, RECEIVER = ROLES = ("sender", "receiver")
ROUND = "round.json"
LOG = "log.txt"
POLL_S = 0.05
STOP_S = 10.0


class Contender(Protocol):
    """A way to send bytes from one process to another."""

    name: str

    @property
    def modules(self) -> tuple[str, ...]:
        """The modules that must be installed."""

    def run(self, plan: Plan, folder: Path) -> None:
        """Starts both ends, waits for them and cleans up. Raises SaccadeError if that fails."""

    def sender(self, address: str) -> AbstractContextManager[Send]:
        """The sending end, in its own process."""

    def receiver(self, address: str) -> AbstractContextManager[Receive]:
        """The receiving end, in its own process."""


def command(name: str, role: str, folder: Path, address: str) -> list[str]:
    """The command line of one end."""
    return [sys.executable, "-m", "saccade.benchmarks.bus.contenders", name, role, str(folder), address]


def run_pair(contender: Contender, plan: Plan, folder: Path, address: str, beside: Sequence[str] = ()) -> None:
    """Runs both ends as our own processes. The command `beside` runs as long as they do."""
    run_all([command(contender.name, role, folder, address) for role in ROLES], plan, folder, beside)


def run_all(commands: Sequence[Sequence[str]], plan: Plan, folder: Path, beside: Sequence[str] = ()) -> None:
    """Runs the commands side by side to their end. The command `beside`, if any, runs as long as they do. If a command
    fails, it raises SaccadeError with the last line that was printed."""
    children: list[subprocess.Popen] = []
    with (folder / LOG).open("ab") as log:
        try:
            for line in (*([beside] if beside else ()), *commands):
                children.append(subprocess.Popen(line, stdin=subprocess.DEVNULL, stdout=log, stderr=log, cwd=folder,
                                                 start_new_session=True))
            _wait(children[-len(commands):], plan, folder)
            if beside:
                children[0].terminate()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    children[0].wait(STOP_S)
        finally:
            for child in children:
                if child.poll() is None:
                    os.killpg(child.pid, signal.SIGKILL)
                    child.wait()


def _wait(children: Sequence[subprocess.Popen], plan: Plan, folder: Path) -> None:
    end = time.monotonic() + plan.limit_s
    while not any(codes := [child.poll() for child in children]):
        if None not in codes:
            return
        if time.monotonic() > end:
            raise SaccadeError(f"not done within {plan.limit_s:.0f} s: {_last_line(folder)}")
        time.sleep(POLL_S)
    raise SaccadeError(f"failed: {_last_line(folder)}")


def _last_line(folder: Path) -> str:
    lines = (folder / LOG).read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else "nothing was said"


def run_round(contender: Contender, plan: Plan, kind: str) -> np.ndarray:
    """Runs one round in fresh processes and returns the latencies, nanoseconds [plan.total]. Raises SaccadeError if it
    fails."""
    with tempfile.TemporaryDirectory(prefix="bus-") as name:
        folder = Path(name)
        (folder / ROUND).write_text(json.dumps({"kind": kind, "plan": dataclasses.asdict(plan)}))
        contender.run(plan, folder)
        missing = [role for role in ROLES if not _times(folder, role).exists()]
        if missing:
            raise SaccadeError(f"no times of the {missing[0]}: {_last_line(folder)}")
        return np.load(_times(folder, RECEIVER)) - np.load(_times(folder, SENDER))


def serve(contender: Contender, role: str, folder: Path, address: str) -> None:
    """Runs one end, from connecting to closing. The sender stays until the receiver has everything."""
    told = json.loads((folder / ROUND).read_text())
    plan, kind = Plan(**told["plan"]), told["kind"]
    signal.alarm(int(plan.limit_s))  # ends the process even if the library that started it lost it
    if role == SENDER:
        with contender.sender(address) as send:
            _save(send_all(plan, kind, send, folder), folder, role)
            while not _times(folder, RECEIVER).exists():
                time.sleep(POLL_S)
    else:
        with contender.receiver(address) as receive:
            _save(receive_all(plan, kind, receive, folder), folder, role)


def _times(folder: Path, role: str) -> Path:
    return folder / f"{role}.npy"


def _save(times: np.ndarray, folder: Path, role: str) -> None:
    unfinished = folder / f"{role}.unfinished.npy"
    np.save(unfinished, times)
    unfinished.rename(_times(folder, role))
