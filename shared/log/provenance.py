"""Where a log comes from: the state of the source, the versions, the configuration and the weights."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
from importlib import metadata

from saccade.shared.config import PACKAGE, Config
from saccade.shared.log.recording import CUT

WRITTEN = ("results", "docs")
BUILT_FROM = PACKAGE / "COMMIT"  # this file is in a wheel
PACKAGES = ("saccade", "eclipse-zenoh", "mcap", "msgpack", "numpy", "mujoco", "torch")


def describe(config: Config, run: str) -> dict[str, dict[str, str]]:
    """The origin of the log: run, seed, commit, hash of the configuration, versions, hashes of the weights."""
    text = config.model_dump_json()
    cut = {CUT: {"start": str(config.bus.first_step)}} if config.bus.first_step else {}
    return {**cut, "run": {"run": run, "seed": str(config.seed), "commit": commit(),
                    "configuration_sha256": hashlib.sha256(text.encode()).hexdigest()},
            "versions": {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}},
            "weights_sha256": {str(p.relative_to(config.weights)): hashlib.sha256(p.read_bytes()).hexdigest()
                               for p in sorted(config.weights.glob("**/*.safetensors"))}}


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "absent"


def commit() -> str:
    """Returns the commit of the source, followed by "-dirty" if the source was changed since.

    Changes of results and documents do not count, because runs write them. A package that was built knows its own
    commit. If there is neither a built package nor a git repository, it is the value of SACCADE_COMMIT, or "unknown".
    """
    if BUILT_FROM.is_file():  # first, because the environment may lie in a checkout of another project
        return BUILT_FROM.read_text().strip()
    try:
        head = _git("rev-parse", "HEAD")
        changed = _git("status", "--porcelain", "--untracked-files=no", "--", ".", *(f":!{room}" for room in WRITTEN))
    except (OSError, subprocess.SubprocessError):
        return os.environ.get("SACCADE_COMMIT", "unknown")
    return head + "-dirty" * bool(changed)


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(PACKAGE), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
