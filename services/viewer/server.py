"""Rerun's server with its web viewer. It keeps the recording for browsers that connect later, up to a memory limit.

It has two ports: one for the page, and one for the data. Both are behind a door of ours (`door.py`), which decides who
may pass. Rerun's usage analytics are switched off.
"""

from __future__ import annotations

import ctypes
import os
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Collection
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType

from saccade.services.viewer.door import Door
from saccade.services.viewer.home import Home
from saccade.services.viewer.priority import session_comes_last
from saccade.shared.admission import with_token
from saccade.shared.config import Config, ViewerConfig
from saccade.shared.errors import SaccadeError

LOOPBACK = "127.0.0.1"
START_S, STOP_S = 20.0, 5.0  # how long to wait for the server to start and to stop
PORTS = 100  # how many ports are tried, from the requested one on
PR_SET_PDEATHSIG = 1  # Linux: the signal that a process gets when its parent dies


class Server:
    """Rerun's server as a child process, and the door in front of it, at `url`. `page` is the address without a token.

    Raises SaccadeError if it cannot be started, for example because Rerun is not installed or a port is in use.
    """

    def __init__(self, config: ViewerConfig) -> None:
        config = config if config.token else with_token(config)
        self.data_port = config.data_port or free_port(config.address, but=(config.port,))
        self.url, self.page = url_of(config), url_of(config, token=False)
        self._address = own_address()
        self._data = free_port(self._address)
        pages = free_port(self._address, but=(self._data,))
        self._door = Door(config, self.data_port, (self._address, pages), (self._address, self._data))
        self._home = Home()
        try:
            self._child = self._start(config, pages)
        except BaseException:
            self._door.close()
            self._home.close()
            raise
        self._door.open()

    @property
    def data_url(self) -> str:
        """The address to which this process sends a recording. It is Rerun's own, which nobody else is told."""
        return f"rerun+http://{self._address}:{self._data}/proxy"

    @property
    def running(self) -> bool:
        """Whether the child process still runs."""
        return self._child.poll() is None

    def __enter__(self) -> Server:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._door.close()
        self._child.terminate()
        try:
            self._child.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        self._home.close()

    def _start(self, config: ViewerConfig, pages: int) -> subprocess.Popen:
        log = self._home.path / "log"
        command = [binary(), "--serve-web", "--bind", self._address, "--port", str(self._data), "--web-viewer-port",
                   str(pages), "--server-memory-limit", f"{config.memory_mb}MB"]
        with log.open("wb") as out:
            child = subprocess.Popen(command, env=self._environment(), stdin=subprocess.DEVNULL, stdout=out,
                                     stderr=subprocess.STDOUT, start_new_session=True, preexec_fn=_as_child())
        end_s = time.monotonic() + START_S
        while not (listens(self._address, self._data) and listens(self._address, pages)):
            if child.poll() is not None or time.monotonic() > end_s:
                child.kill()
                child.wait()
                said = [line for line in log.read_text(errors="replace").splitlines() if line.strip()] or ["nothing"]
                raise SaccadeError(f"viewer: Rerun's server does not start at {self._address}: it said "
                                   f"{said[-1][-300:]!r}; start the viewer again")
            time.sleep(0.05)
        return child

    def _environment(self) -> dict[str, str]:
        """The environment of the child process, with a home folder of its own in which analytics are off."""
        kept = {name: value for name, value in os.environ.items() if not name.startswith("XDG_")}
        environment = {**kept, "HOME": str(self._home.path), "RUST_LOG": "warn", "NO_COLOR": "1"}
        subprocess.run([binary(), "analytics", "disable"], env=environment, capture_output=True, check=True)
        return environment


def url_of(config: ViewerConfig, *, token: bool = True) -> str:
    """The address that a user opens in a browser."""
    name = "localhost" if config.address in ("0.0.0.0", "::") else config.address
    page = f"http://{f'[{name}]' if ':' in name else name}:{config.port}"
    return f"{page}/?token={config.token}" if config.token and token else page


def guide_url_of(config: ViewerConfig) -> str:
    """The address of the page that guides a hand."""
    return url_of(config.model_copy(update={"port": config.guide_port}))


def own_address() -> str:
    """A loopback address for Rerun's server, which checks no Host and no Origin.

    Linux has 16 million of them. This is one at random, so that a page of another site would have to guess it.
    """
    if sys.platform != "linux":
        return LOOPBACK
    return f"127.{secrets.randbelow(256)}.{secrets.randbelow(256)}.{1 + secrets.randbelow(254)}"


def with_free_ports(config: Config) -> Config:
    """The configuration with free ports for a viewer: the configured ones, or the next that are free. If other hosts
    reach the viewer, it gets a new token.

    Raises SaccadeError if no port is free.
    """
    viewer = config.viewer
    port = free_port(viewer.address, viewer.port, but=(viewer.data_port,))
    return config.with_values({"viewer.port": port, "viewer.token": with_token(viewer).token,
                               "viewer.data_port": viewer.data_port or free_port(viewer.address, but=(port,))})


def with_guide(config: Config) -> Config:
    """The configuration with a free port for the page that guides a hand. If other hosts reach it, it has a token.

    Raises SaccadeError if no port is free.
    """
    viewer = config.viewer
    port = free_port(viewer.address, viewer.guide_port, but=(viewer.port, viewer.data_port))
    return config.with_values({"viewer.guide_port": port, "viewer.token": viewer.token or with_token(viewer).token})


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
