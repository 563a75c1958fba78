"""A clone of the repository as a newcomer has it, and Docker Compose in it. Needs an engine: `make test-compose`."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from saccade.app.log.check import Missing, missing
from saccade.services.viewer.server import LOOPBACK, free_port
from saccade.shared.config import PACKAGE

USER = 1000 if os.getuid() == 0 else os.getuid()
BUILD_S, RUN_S = 1800, 300


class Compose:
    """`docker compose` in a clone, as a project of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.project = folder, f"saccade-test-{os.getpid()}"
        self.port = free_port(LOOPBACK)
        self.view_port = free_port(LOOPBACK, but=(self.port,))
        view_data_port = free_port(LOOPBACK, but=(self.port, self.view_port))
        self._environment = {name: value for name, value in os.environ.items() if not name.startswith("SACCADE_")}
        self._environment |= {"SACCADE_UID": str(USER), "SACCADE_GID": str(USER), "SACCADE_PORT": str(self.port),
                              "SACCADE_VIEW_PORT": str(self.view_port), "SACCADE_VIEW_DATA_PORT": str(view_data_port),
                              "SACCADE_VIEW_S": "0"}

    def __call__(self, *arguments: str, timeout_s: float = RUN_S, check: bool = True, **environment: str) -> str:
        """What it prints. With `check` its exit code is 0."""
        done = subprocess.run(["docker", "compose", "-p", self.project, *arguments], cwd=self.folder, text=True,
                              env=self._environment | environment, timeout=timeout_s, stdout=subprocess.PIPE,
                              stderr=subprocess.STDOUT)
        assert not check or done.returncode == 0, done.stdout
        return done.stdout

    def up(self, *arguments: str, timeout_s: float = RUN_S, **environment: str) -> str:
        """A run from its start until all containers have ended."""
        return self("up", "--no-color", *arguments, timeout_s=timeout_s, **environment)

    def until_said(self, text: str, timeout_s: float = RUN_S) -> str:
        """What all containers have printed, once it holds the text."""
        end_s = time.monotonic() + timeout_s
        while text not in (said := self("logs", "--no-color", check=False)):
            assert time.monotonic() < end_s, f"{text!r} did not come:\n{said}"
            time.sleep(0.5)
        return said

    def until_ended(self, service: str, timeout_s: float = RUN_S) -> int:
        """A container's exit code, at once where it has ended already. (`compose wait` knows running ones alone.)"""
        return int(self._docker("wait", f"{self.project}-{service}-1", timeout_s=timeout_s))

    def inspect(self, service: str, number: int = 1) -> dict:
        """Docker's own words on a container."""
        return json.loads(self._docker("inspect", f"{self.project}-{service}-{number}"))[0]

    @staticmethod
    def _docker(*arguments: str, timeout_s: float = RUN_S) -> str:
        return subprocess.run(["docker", *arguments], text=True, check=True, capture_output=True,
                              timeout=timeout_s).stdout

    def kill(self, service: str, number: int = 1) -> None:
        """All its processes but the first, whose end ends that one too. (A container that a user kills stays down.)"""
        subprocess.run(["docker", "exec", f"{self.project}-{service}-{number}", "sh", "-c",
                        "kill -9 $(ls /proc | grep -E '^[0-9]+$' | grep -vxE \"1|$$\")"], capture_output=True)

    @property
    def run(self) -> Path:
        """The folder of the newest run."""
        return (self.folder / "runs" / "latest").resolve()

    def log(self, world: str = ".") -> Missing:
        """What `saccade log check` finds."""
        return missing(self.run / world / "run.mcap")


@pytest.fixture(scope="session")
def clone(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("clone") / "saccade"
    files = subprocess.run(["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"], cwd=PACKAGE,
                           capture_output=True, text=True, check=True).stdout.split("\0")
    for name in filter(None, files):
        if (source := PACKAGE / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, folder / name)
    for path in (folder, *folder.rglob("*")):
        shutil.chown(path, USER, USER)
    return folder


@pytest.fixture(scope="session")
def built(clone) -> Compose:
    compose = Compose(clone)
    compose("build", timeout_s=BUILD_S, COMPOSE_PROFILES="simulator,camera,replay")  # older images may be there
    return compose


@pytest.fixture
def compose(built) -> Iterator[Compose]:
    yield built
    built("down", "--volumes", "--timeout", "10", check=False)
    shutil.rmtree(built.folder / "runs", ignore_errors=True)
