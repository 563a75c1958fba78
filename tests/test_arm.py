"""The example's arm: it brings the camera where it is told, and stands in the simulator's place."""

from __future__ import annotations

import numpy as np
import pytest

from saccade.app.run.registry import local_pairs
from saccade.shared.bus.messages import Action, Frame, Truth
from saccade.shared.config import PACKAGE, Config
from saccade.shared.loop.local import run_local
from saccade.shared.world.geometry import look_at, rotation_angle
from saccade.shared.world.task import start_pose


@pytest.fixture
def arm(monkeypatch):
    monkeypatch.syspath_prepend(PACKAGE / "examples")
    from arm.arm import Arm

    return Arm()


def apart(a, b) -> tuple[float, float]:
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(rotation_angle(a[:3, :3], b[:3, :3]))


@pytest.mark.parametrize("eye", [(0.46, 0.0, 0.46), (-0.45, 0.1, 0.3), (0.1, 0.45, 0.15), (0.05, -0.45, 0.6)])
def test_the_joints_bring_the_camera_to_all_sides_of_the_table(arm, eye):
    wanted = look_at(eye, (0.0, 0.0, 0.05))
    arm.put(wanted)
    assert max(apart(arm.camera, wanted)) < 2e-3


def test_position_control_follows_an_action(arm):
    """It ends near the aim, not at it: there are masses and motors between."""
    arm.put(start_pose())
    wanted = look_at(start_pose()[:3, 3] + (0.0, 0.05, -0.01), np.zeros(3))
    arm.move(wanted, 0.05)
    assert apart(arm.camera, wanted)[0] > 0.005  # it takes time
    arm.move(wanted, 0.6)
    assert apart(arm.camera, wanted)[0] < 0.003
    assert apart(arm.camera, wanted)[1] < 0.01


def test_the_agent_moves_the_arm_by_its_actions(arm):
    """In the simulator's place, behind the same topics: what the frames tell is where the joints are."""
    config = Config().with_values({"scene.names": ["soup_can", "rice_box"], "services.source": "arm",
                                   "bus.kind": "local", "simulator.max_steps": 4, "planner.candidates": 50})
    heard = []
    run_local(local_pairs("sceneccn", config), config.names, "r",
              on_message=lambda topic, part, message, payload: heard.append(message))
    frames = [m for m in heard if isinstance(m, Frame)]
    actions = [m for m in heard if isinstance(m, Action)]
    assert len(actions) == 4
    for before, action, after in zip(frames, actions, frames[1:], strict=False):
        moved = after.world_from_camera[:3, 3] - before.world_from_camera[:3, 3]
        assert np.linalg.norm(moved - action.translation_m) < 0.005
        assert not np.array_equal(moved, action.translation_m)
    assert [m for m in heard if isinstance(m, Truth)][-1].done
