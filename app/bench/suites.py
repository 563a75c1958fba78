"""The scenes of a suite for a run, as a file (services/simulator/suites.py lists the suites)."""

from __future__ import annotations

from pathlib import Path

from saccade.services.simulator.scenes import save_scenes
from saccade.services.simulator.suites import SUITES, suite_of
from saccade.shared.config import Config
from saccade.shared.render.objects import load_mesh, names_in_use


def default_suite(objects: str) -> str:
    """The paper's scenes for the paper's objects. For other objects, scenes that are drawn by the same rules."""
    return "paper-500" if objects == SUITES["paper-500"].objects else "paper-like"


def suite_file(name: str, config: Config, beside: Path) -> Path:
    """Returns the file with a suite's scenes: its own file, or `beside`, which is then written here.

    Raises SaccadeError if the suite is unknown, or if it is not of the configured objects.
    """
    suite = suite_of(name, config.scene.objects)
    if suite.file is not None:
        return suite.file
    meshes = {each: load_mesh(config.scene.objects, each) for each in names_in_use(config.scene)}
    save_scenes(beside, suite.scenes(meshes, config.seed))
    return beside
