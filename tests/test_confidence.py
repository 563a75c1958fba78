"""The benchmark of what an agent believes against the truth: its measure, and the probability of being there."""

import numpy as np
import pytest

from saccade.benchmarks.calibration import KINDS, Told, draw, reliability, within_tolerance
from saccade.services.planner.goal import Preference, aim
from saccade.shared.bus.messages import Belief
from saccade.shared.world.geometry import INTRINSICS_PX, direction, viewing_grid
from saccade.tests.samples import sample


def test_the_error_is_the_mean_distance_of_what_was_told_from_how_often_it_was_so():
    told = [Told(0.75, True)] * 3 + [Told(0.75, False)] + [Told(0.2, True), Told(0.2, False)]
    found = reliability(told)
    assert found["expected_calibration_error"] == pytest.approx((4 * 0.0 + 2 * 0.3) / 6)
    assert [(each["count"], each["was"]) for each in found["bins"]] == [(2, 0.5), (4, 0.75)]


def test_a_probability_of_one_is_in_the_last_bin():
    assert reliability([Told(1.0, True)])["bins"] == [{"count": 1, "told": 1.0, "was": 1.0}]


def test_the_curves_from_before_are_drawn_beside_those_of_now(tmp_path):
    results = dict.fromkeys(KINDS, reliability([Told(0.7, True), Told(0.1, False)]))
    draw({"before": results, "now": results}, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 5000


def test_the_camera_is_within_the_tolerance_if_all_goal_poses_are_near_it_and_not_if_it_is_elsewhere():
    elevation, azimuth = viewing_grid()
    posterior = np.full((len(elevation), len(azimuth)), -60.0)
    posterior[5, 10] = 0.0
    preference = Preference("can", 0.4, 0.01, np.array([240.0, 240.0]), np.asarray(INTRINSICS_PX), 0.9)
    here = aim(0.4 * direction(azimuth[10], elevation[5]), np.zeros(3), preference.pixel, INTRINSICS_PX)
    there = aim(0.4 * direction(azimuth[10] + 2.0, elevation[5]), np.zeros(3), preference.pixel, INTRINSICS_PX)
    sure = {"presence": 1.0, "mean_m": np.zeros(3), "covariance_m2": 1e-6 * np.eye(3), "goal_range_m": 0.4,
            "goal_log_posterior": posterior.astype(np.float32)}
    rng = np.random.default_rng(0)
    assert within_tolerance(sample(Belief, world_from_camera=here, **sure), preference, rng) > 0.95
    assert within_tolerance(sample(Belief, world_from_camera=there, **sure), preference, rng) == 0.0
