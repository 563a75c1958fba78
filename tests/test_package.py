"""What a wheel holds. `tests/package` installs one into an empty environment and uses it."""

from __future__ import annotations

import subprocess
import sys
import tarfile
import zipfile

import pytest

from saccade.shared.config import PACKAGE

ROOMS = ("app", "deploy", "services", "shared", "training")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> zipfile.ZipFile:
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run([sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, PACKAGE],
                   check=True, capture_output=True)
    path, = folder.glob("*.whl")
    with zipfile.ZipFile(path) as file:
        yield file


def test_one_importable_name(wheel):
    tops = {name.partition("/")[0] for name in wheel.namelist()}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"saccade"}


def test_everything_that_runs_is_in_it(wheel):
    files = subprocess.run(["git", "ls-files", "--cached", "--others", "--exclude-standard", "--", *ROOMS],
                           cwd=PACKAGE, capture_output=True, text=True, check=True).stdout.split("\n")
    modules = {f"saccade/{file}" for file in files if file.endswith(".py") and (PACKAGE / file).is_file()}
    assert len(modules) > 150
    assert modules <= set(wheel.namelist())


def test_weights_presets_scenes_and_licence_are_in_it(wheel):
    names = set(wheel.namelist())
    for folder in ("weights", "shared/presets", "services/simulator/scenes"):
        wanted = {f"saccade/{path.relative_to(PACKAGE)}" for path in (PACKAGE / folder).rglob("*") if path.is_file()}
        assert wanted, folder
        assert wanted <= names
    assert {"saccade/py.typed", "saccade/__init__.py", "saccade/__main__.py", "saccade/COMMIT"} <= names
    assert any(name.endswith("licenses/LICENSE") for name in names)


def test_what_is_for_the_repository_alone_is_not_in_it(wheel):
    for room in ("tests", "benchmarks", "examples", "docs", "results", "setup"):
        assert not [name for name in wheel.namelist() if name.startswith(f"saccade/{room}")], room


def test_a_source_distribution_has_no_part_of_the_tests(tmp_path):
    """They need files that are in the repository alone."""
    subprocess.run([sys.executable, "-m", "build", "--sdist", "--no-isolation", "--outdir", tmp_path, PACKAGE],
                   check=True, capture_output=True)
    path, = tmp_path.glob("*.tar.gz")
    with tarfile.open(path) as file:
        names = [name.partition("/")[2] for name in file.getnames()]
    assert "pyproject.toml" in names
    assert not [name for name in names if name.startswith("tests")]


def test_it_knows_the_commit_that_it_was_built_from(wheel):
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=PACKAGE, capture_output=True, text=True, check=True)
    assert wheel.read("saccade/COMMIT").decode() == head.stdout
