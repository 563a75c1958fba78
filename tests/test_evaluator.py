"""The evaluator's core: the result it makes of an episode's last truth."""

from __future__ import annotations

import numpy as np
import pytest

from saccade.services.evaluator.core import Evaluator
from saccade.shared.bus.messages import Truth
from saccade.shared.bus.wire import encode
from saccade.shared.world.geometry import look_at

TARGET = np.array([0.1, 0.0, 0.05])
GOAL = look_at(TARGET + np.array([0.3, 0.0, 0.0]), TARGET)


def truth(camera, **more):
    values = {"run": "r", "episode": 2, "step": 7, "scene": "s", "target": "can", "names": ["can", "box"],
              "centers_m": np.zeros((2, 3)), "yaws_rad": np.zeros(2), "keep_out_m": np.full(2, 0.1),
              "target_center_m": TARGET, "world_from_camera": camera, "goal_world_from_camera": GOAL,
              "success": False, "done": True}
    return {"truth": Truth(**values | more)}


def test_there_is_no_result_before_the_end():
    evaluator = Evaluator()
    assert evaluator.begin("r", 2) == []
    assert evaluator.step(truth(GOAL, done=False)) == []


def test_the_result_says_how_the_episode_ended():
    """A quarter turn around the target, ten centimetres farther away."""
    camera = look_at(TARGET + np.array([0.0, 0.4, 0.0]), TARGET)
    result = Evaluator().step(truth(camera, declared=True))[0].message
    assert (result.run, result.episode, result.step, result.steps) == ("r", 2, 7, 7)
    assert (result.scene, result.target, result.objects) == ("s", "can", 2)
    assert (result.success, result.declared, result.declared_true) == (False, True, False)
    measured = (result.azimuth_error_rad, result.elevation_error_rad, result.range_error_m)
    assert measured == pytest.approx((np.pi / 2, 0.0, 0.1))
    assert encode(result)


def test_a_perfect_arrival_has_no_errors():
    result = Evaluator().step(truth(GOAL, success=True, declared=True, declared_true=True))[0].message
    assert result.success
    assert result.declared_true
    assert (result.azimuth_error_rad, result.elevation_error_rad, result.range_error_m) == pytest.approx((0, 0, 0))
