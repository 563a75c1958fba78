"""A wheel in an empty environment, used from an empty folder, without the repository: `make test-package`.

It is built as a release is (from an sdist, in isolation), and its dependencies come from the package index: so this
takes minutes, and stands beside the other tests.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from saccade.shared.config import PACKAGE

WAIT_S = 900


class Installed:
    """The environment and the folder in which commands are given."""

    def __init__(self, folder: Path) -> None:
        self.bin, self.folder = folder / "venv" / "bin", folder / "empty"
        self.folder.mkdir()

    def __call__(self, *command: str | Path, code: int = 0) -> str:
        """What a command prints; it must end with this exit code."""
        environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "SACCADE"))}
        done = subprocess.run([self.bin / str(command[0]), *map(str, command[1:])], cwd=self.folder, text=True,
                              env=environment | {"COLUMNS": "200"}, capture_output=True, timeout=WAIT_S, check=False)
        assert done.returncode == code, done.stdout + done.stderr
        return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Installed:
    folder = tmp_path_factory.mktemp("package")
    subprocess.run([sys.executable, "-m", "build", "--outdir", folder / "dist", PACKAGE], check=True)
    wheel, = (folder / "dist").glob("*.whl")
    assert list((folder / "dist").glob("*.tar.gz"))
    subprocess.run([sys.executable, "-m", "venv", folder / "venv"], check=True)
    place = Installed(folder)
    place("pip", "install", "--quiet", f"{wheel}[all]")
    return place


@pytest.fixture(scope="module")
def run(installed) -> Installed:
    """With one run on the bus in `r`."""
    printed = installed("saccade", "run", "--seed", 4, "--plain", "--out", "r")
    assert "reached the goal in" in printed
    return installed


def test_nothing_else_of_ours_is_importable(installed):
    site, = (installed.bin.parent / "lib").glob("python*/site-packages")
    record, = site.glob("saccade-*.dist-info/RECORD")
    tops = {line.partition("/")[0] for line in record.read_text().splitlines() if not line.startswith("..")}
    assert tops == {"saccade", record.parent.name}
    told = installed("python", "-c", "import importlib.util as u; print([n for n in ('services', 'shared', 'training', "
                                     "'deploy', 'app', 'tests', 'benchmarks') if u.find_spec(n)])")
    assert told.strip() == "[]"


def test_it_says_version_and_commit(installed):
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=PACKAGE, capture_output=True, text=True, check=True)
    assert head.stdout.strip() in installed("saccade", "--version")


def test_a_run_leaves_log_configuration_and_picture(run):
    assert {"run.mcap", "config.json", "picture.png"} <= {path.name for path in (run.folder / "r").iterdir()}
    assert run("saccade", "log", "check", "r").startswith("complete: ")
    assert "soup_can" in run("saccade", "log", "info", "r")


def test_a_run_is_replayed_shown_and_filmed(run):
    assert " 0 differ in a byte" in run("saccade", "replay", "r", "--into", "perception,belief,planner", "--check")
    run("saccade", "view", "r", "--save", "r.rrd")
    run("saccade", "film", "r", "r.gif")
    assert (run.folder / "r.rrd").stat().st_size > 10_000
    assert (run.folder / "r.gif").stat().st_size > 10_000


def test_an_agent_is_measured(installed):
    assert "pantry" in installed("saccade", "bench", "--limit", 2, "--jobs", 2, "--json", "b.json")
    installed("saccade", "bench", "--objects", "ycb", "--limit", 1, code=2)  # there are no scans


def test_networks_are_trained(installed):
    installed("saccade", "train", "--names", "soup_can,rice_box", "--steps-ccn", 2, "--steps-extraction", 2, "--views",
              20, "--out", "t", "--weights", "w")
    assert (installed.folder / "w" / "manifest.json").is_file()


def test_the_machine_is_examined(installed):
    assert "zenoh" in installed("saccade", "doctor").lower()


def test_it_is_used_from_python(run):
    code = ("import saccade; episode = next(iter(saccade.open('r'))); step = next(iter(episode)); "
            "agent = saccade.Agent(goal=episode.goal.rgb, seed=4); "
            "action = agent.step(step.frame.rgb, step.frame.world_from_camera); "
            "print(action.translation_m == step.action.translation_m)")
    assert run("python", "-c", code).strip() == "[ True  True  True]"
