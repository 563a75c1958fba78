"""What pyproject.toml cannot express. The root of the repository is the package `saccade`, its subpackages are found
from the folders, and a distribution carries the commit that it was built from."""

import os
import shutil
import subprocess
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

ROOMS = ("app", "deploy", "services", "shared", "training")
COMMIT = Path("COMMIT")  # this file is in an sdist, which has no git history


def commit() -> str:
    if COMMIT.is_file():
        return COMMIT.read_text().strip()
    try:
        done = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, timeout=10, check=True)
        return done.stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return os.environ.get("SACCADE_COMMIT", "unknown")


class BuildWithCommit(build_py):
    def run(self) -> None:
        if not self.editable_mode:
            shutil.rmtree(self.build_lib, ignore_errors=True)  # otherwise modules that were removed would be packed
        super().run()
        if not self.editable_mode:
            target = Path(self.build_lib, "saccade", COMMIT)
            # the folder may be missing: a container image installs the dependencies before the code is there
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(commit() + "\n")

    def find_package_modules(self, package: str, package_dir: str) -> list[tuple[str, str, str]]:
        return [module for module in super().find_package_modules(package, package_dir) if module[1] != "setup"]


class SdistWithCommit(sdist):
    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        super().make_release_tree(base_dir, files)
        Path(base_dir, COMMIT).write_text(commit() + "\n")


setup(package_dir={"saccade": "."},
      packages=["saccade", *(f"saccade.{name}" for name in find_packages(include=[f"{room}*" for room in ROOMS]))],
      cmdclass={"build_py": BuildWithCommit, "sdist": SdistWithCommit})
