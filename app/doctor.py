"""`saccade doctor` checks what works on this machine and what is missing, and says how to repair it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from saccade.shared.bus.messages import Status
from saccade.shared.bus.topics import STATUS, Topic
from saccade.shared.bus.transport import ZenohBus, free_endpoint
from saccade.shared.bus.wire import encode
from saccade.shared.config import Config, SceneConfig
from saccade.shared.errors import SaccadeError
from saccade.shared.render.objects import names_of, ycb_folder
from saccade.shared.render.opengl import choose_backend

OLDEST_PYTHON = (3, 11)
ANSWER_S = 10.0
RENDER_S = 120.0
ROOM_BYTES = 64 * 1024 * 1024
RENDER = """
import numpy as np
from saccade.shared.render.objects import load_mesh, names_of
from saccade.shared.render.world import World
from saccade.shared.world.task import start_pose
mesh = load_mesh("pantry", names_of("pantry")[0])
world = World((mesh,))
world.place({mesh.name: (np.array([0, 0, mesh.size_m[2] / 2]), 0.0)})
image = world.render(start_pose())
world.close()
assert len(np.unique(image.reshape(-1, 3), axis=0)) > 10, "the image is empty"
"""


@dataclass(frozen=True)
class Finding:
    """The result of one check: what was found, and how to repair it if it is missing."""

    ok: bool
    detail: str
    mend: str = ""


@dataclass(frozen=True)
class Check:
    """One check. If it is `needed`, the default run does not work without it."""

    name: str
    look: Callable[[], Finding]
    needed: bool = True


def checks() -> tuple[Check, ...]:
    """All checks, in the order of the table."""
    return (Check("Python", python), Check("OpenGL", opengl), Check("Zenoh", zenoh),
            Check("shared memory", shared_memory, needed=False), Check("objects pantry", lambda: objects("pantry")),
            Check("weights pantry", lambda: weights("pantry")), Check("objects ycb", ycb, needed=False),
            Check("weights ycb", lambda: weights("ycb"), needed=False), Check("torch device", torch_device))


def examine(console: Console | None = None, which: tuple[Check, ...] | None = None) -> int:
    """Runs the checks and prints the table. Returns 1 if the default run lacks something, else 0."""
    console, lacking = console or Console(), []
    table = Table(title="saccade doctor")
    for header in ("what", "state", "found"):
        table.add_column(header, overflow="fold")
    for check in which or checks():
        finding = _look(check)
        state = "[green]ok[/]" if finding.ok else "[red]missing[/]" if check.needed else "[yellow]missing (optional)[/]"
        mend = f"\n[bold]{_escape(finding.mend)}[/]" if finding.mend else ""
        table.add_row(check.name, state, _escape(finding.detail) + mend)
        lacking += [check.name] if check.needed and not finding.ok else []
    console.print(table)
    console.print(f"`saccade run` lacks: {', '.join(lacking)}" if lacking else "`saccade run` has all that it needs")
    return 1 if lacking else 0


def _look(check: Check) -> Finding:
    """Runs one check. An error becomes a finding that says what is missing."""
    try:
        return check.look()
    except SaccadeError as error:  # the text of the error says what to do
        return Finding(False, str(error))
    except (ImportError, OSError) as error:
        return Finding(False, f"{type(error).__name__}: {error}", "install Saccade again: pip install -e .")


def _escape(text: str) -> str:
    return text.replace("[", "\\[")


def python() -> Finding:
    """Checks the version of Python."""
    version = ".".join(str(n) for n in sys.version_info[:3])
    wanted = ".".join(str(n) for n in OLDEST_PYTHON)
    return Finding(sys.version_info >= OLDEST_PYTHON, version, "" if sys.version_info >= OLDEST_PYTHON else
                   f"install Python {wanted} or newer")


def opengl() -> Finding:
    """Renders one image in a process of its own, because a bad driver may crash the process."""
    backend = choose_backend()
    try:
        done = subprocess.run([sys.executable, "-c", RENDER], timeout=RENDER_S, capture_output=True,
                              text=True, check=False)
    except subprocess.TimeoutExpired:
        return Finding(False, f"{backend}: no image after {RENDER_S:.0f} s", "set MUJOCO_GL to osmesa or egl")
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"the process ended with code {done.returncode}"]
        return Finding(False, f"{backend}: {lines[-1]}",
                       "install libosmesa6 (`sudo apt-get install libosmesa6`) or set MUJOCO_GL to another backend")
    return Finding(True, f"{backend} renders")


def zenoh() -> Finding:
    """Opens a router on a free port of this machine, and sends a message through it."""
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    sent = encode(Status(run="doctor", episode=0, step=0, service="doctor", state="ready"))
    arrived = threading.Event()

    def hear(_topic: Topic, _part: str | None, payload: bytes) -> None:
        if payload == sent:
            arrived.set()

    router = ZenohBus(endpoint, world="doctor", listen=True)
    try:
        client = ZenohBus(endpoint, world="doctor")
        try:
            router.subscribe((STATUS,), hear)
            end = time.monotonic() + ANSWER_S
            while not arrived.is_set() and time.monotonic() < end:
                client.publish(STATUS, "doctor", sent)
                arrived.wait(0.1)
        finally:
            client.close()
    finally:
        router.close()
    if arrived.is_set():
        return Finding(True, f"a message passed through {endpoint}")
    return Finding(False, f"nothing came through {endpoint} in {ANSWER_S:.0f} s",
                   "allow connections within this machine")


def shared_memory() -> Finding:
    """Checks that /dev/shm has room for images. Images in shared memory need not be copied."""
    folder = Path("/dev/shm")
    if not folder.is_dir():
        return Finding(False, "there is no /dev/shm", "nothing to do: images are copied instead")
    usage = shutil.disk_usage(folder)
    detail = f"{usage.free / 2 ** 20:.0f} of {usage.total / 2 ** 20:.0f} MiB free in /dev/shm"
    return Finding(usage.free >= ROOM_BYTES, detail, "" if usage.free >= ROOM_BYTES else
                   "make room there; in Docker: --shm-size=256m")


def objects(object_set: str) -> Finding:
    """Lists the objects of a set. Raises SaccadeError if the set is unknown."""
    return Finding(True, ", ".join(names_of(object_set)))


def ycb() -> Finding:
    """Checks that the YCB scans are there. They are not part of the project."""
    folder = ycb_folder()
    absent = [name for name in names_of("ycb") if not (folder / name / "textured.obj").is_file()]
    if absent:
        return Finding(False, f"{folder} lacks {', '.join(absent)}",
                       "set SACCADE_YCB to a folder that holds <name>/textured.obj and texture_map.png or .jpg")
    return Finding(True, str(folder))


def weights(object_set: str) -> Finding:
    """Reads the manifest of a set's weights, and compares every file with its hash."""
    from saccade.shared.model.weights import Weights

    folder = Config(scene=SceneConfig(objects=object_set)).weights
    try:
        found = Weights(folder)
        found.cards_of(names_of(object_set))
        for name in found.hashes:
            found.state(name.removesuffix(".safetensors"))
    except SaccadeError as error:
        return Finding(False, str(error).split(": ")[0], f"train them: saccade train --objects {object_set}")
    return Finding(True, f"{len(found.hashes)} files in {folder} as in their manifest")


def torch_device() -> Finding:
    """Names the device on which training runs. The agent itself runs on the processor."""
    import torch

    if torch.cuda.is_available():
        return Finding(True, f"torch {torch.__version__}: {torch.cuda.get_device_name()}")
    return Finding(True, f"torch {torch.__version__}: processor only, {os.cpu_count()} cores")
