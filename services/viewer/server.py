"""Rerun's server with its web viewer. It keeps the recording for browsers that connect later, up to a memory limit.

It has two ports: one for the page, which passes through our own small web server (`door.py`), and one for the data.
Rerun's usage analytics are switched off.
"""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Collection
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType

from saccade.services.viewer.door import open_door
from saccade.services.viewer.priority import session_comes_last
from saccade.shared.config import Config, ViewerConfig
from saccade.shared.errors import SaccadeError

LOOPBACK = "127.0.0.1"
START_S, STOP_S = 20.0, 5.0  # how long to wait for the server to start and to stop
PORTS = 100  # how many ports are tried, from the requested one on
PR_SET_PDEATHSIG = 1  # Linux: the signal that a process gets when its parent dies


class Server:
    """Rerun's server as a child process, and the web server in front of its page, at `url`.

    Raises SaccadeError if it cannot be started, for example because Rerun is not installed or a port is in use.
    """

    def __init__(self, config: ViewerConfig) -> None:
        self._home = tempfile.TemporaryDirectory(prefix="saccade-viewer-", ignore_cleanup_errors=True)
        self.data_port = config.data_port or free_port(config.address, but=(config.port,))
        self.address, self.url = config.address, url_of(config)
        pages = free_port(config.address, but=(config.port, self.data_port))
        self._door = open_door(config, here(config.address), pages, self.data_port)
        self._child = self._start(config, pages)
        threading.Thread(target=self._door.serve_forever, name="door", daemon=True).start()

    @property
    def data_url(self) -> str:
        """The address to which a recording is sent."""
        return f"rerun+http://{here(self.address)}:{self.data_port}/proxy"

    @property
    def running(self) -> bool:
        """Whether the child process still runs."""
        return self._child.poll() is None

    def __enter__(self) -> Server:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._door.shutdown()
        self._door.server_close()
        self._child.terminate()
        try:
            self._child.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        self._home.cleanup()

    def _start(self, config: ViewerConfig, pages: int) -> subprocess.Popen:
        log = Path(self._home.name) / "log"
        command = [binary(), "--serve-web", "--bind", self.address, "--port", str(self.data_port), "--web-viewer-port",
                   str(pages), "--server-memory-limit", f"{config.memory_mb}MB"]
        if self.address != LOOPBACK:
            command += ["--cors-allow-origin", f"http://*:{config.port}"]
        with log.open("wb") as out:
            child = subprocess.Popen(command, env=self._environment(), stdin=subprocess.DEVNULL, stdout=out,
                                     stderr=subprocess.STDOUT, start_new_session=True, preexec_fn=_as_child())
        end_s = time.monotonic() + START_S
        while not (listens(self.address, self.data_port) and listens(self.address, pages)):
            if child.poll() is not None or time.monotonic() > end_s:
                child.kill()
                self._door.server_close()
                said = [line for line in log.read_text(errors="replace").splitlines() if line.strip()] or ["nothing"]
                raise SaccadeError(f"viewer: Rerun's server does not start on port {self.data_port}: it said "
                                   f"{said[-1][-300:]!r}")
            time.sleep(0.05)
        return child

    def _environment(self) -> dict[str, str]:
        """The environment of the child process, with a home folder of its own in which analytics are off."""
        kept = {name: value for name, value in os.environ.items() if not name.startswith("XDG_")}
        environment = {**kept, "HOME": self._home.name, "RUST_LOG": "warn", "NO_COLOR": "1"}
        subprocess.run([binary(), "analytics", "disable"], env=environment, capture_output=True, check=True)
        return environment


def url_of(config: ViewerConfig) -> str:
    """The address that a user types into a browser."""
    return f"http://{'localhost' if config.address in ('0.0.0.0', '::') else config.address}:{config.port}"


def with_free_ports(config: Config) -> Config:
    """The configuration with free ports for a viewer: the configured ones, or the next that are free.

    Raises SaccadeError if no port is free.
    """
    viewer = config.viewer
    port = free_port(viewer.address, viewer.port, but=(viewer.data_port,))
    return config.with_values({"viewer.port": port,
                               "viewer.data_port": viewer.data_port or free_port(viewer.address, but=(port,))})


def binary() -> str:
    """The path of Rerun's program. Raises SaccadeError if it is not installed."""
    spec = find_spec("rerun_cli")
    folder = Path(spec.origin).parent if spec and spec.origin else None
    path = folder / ("rerun.exe" if sys.platform == "win32" else "rerun") if folder else None
    if path is None or not path.is_file():
        raise SaccadeError("viewer: Rerun is not installed: pip install 'saccade[viewer]'")
    return str(path)


def free_port(address: str, first: int | None = None, *, but: Collection[int] = ()) -> int:
    """A port that is free now and not one of `but`. With `first` it is this port or the next free one after it.

    Raises SaccadeError if no port is free.
    """
    reason = "they are in use"
    for port in [0] * PORTS if first is None else range(first, min(first + PORTS, 65536)):
        try:
            with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((address, port))
                if (found := probe.getsockname()[1]) not in but:
                    return found
        except OSError as error:
            reason = error.strerror or str(error)
    raise SaccadeError(f"viewer: no port from {first or 0} on is free at {address}: {reason}")


def here(address: str) -> str:
    """The address at which this machine reaches a server that is bound to `address`."""
    return {"0.0.0.0": LOOPBACK, "::": "::1"}.get(address, address)


def listens(address: str, port: int) -> bool:
    """Whether a server listens at this port."""
    try:
        with socket.create_connection((here(address), port), timeout=1.0):
            return True
    except OSError:
        return False


def _as_child() -> Callable[[], None] | None:
    """A function that the child process runs before it starts the server; None if this is not Linux.

    With it the server ends when its parent is killed, so that its ports are free again, and the server's session gets
    the lowest priority.
    """
    if sys.platform != "linux":
        return None
    prctl = ctypes.CDLL(None).prctl

    def before_it_begins() -> None:
        prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        session_comes_last()

    return before_it_begins
