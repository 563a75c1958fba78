"""What a service's process loads: its own dependencies and no more."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = {"torch", "mujoco", "scipy", "filterpy", "cv2", "matplotlib", "typer", "rich", "rosbags"}
NEEDS = {
    "router": set(), "recorder": set(), "evaluator": set(),
    "simulator": {"mujoco"},
    "perception": {"torch"},
    "belief": {"filterpy", "scipy"},
    "planner": {"scipy"},
    "camera": {"scipy"},
    "viewer": set(),
    "ros": {"scipy"},
    "guide": set(),
}


@pytest.mark.parametrize("name", NEEDS)
def test_a_process_loads_what_its_service_needs_and_no_more(name):
    code = (f"import sys, saccade.services.{name}.core, saccade.shared.loop.main; "
            f"print(*sorted({HEAVY} & set(sys.modules)))")
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert set(loaded.split()) <= NEEDS[name]
