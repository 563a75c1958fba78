"""The rehearsal's hand: as slow, as late and as unsteady as it is said to be, and it arrives all the same."""

from __future__ import annotations

import numpy as np
import pytest

from saccade.benchmarks.hand import (
    RATE_HZ,
    REACTION_S,
    SPEED_M_S,
    SWAY_M,
    SWAY_RAD,
    Hand,
    Sway,
    rehearsed,
    summary,
)
from saccade.benchmarks.hand_eyes import as_measured
from saccade.shared.world.geometry import INTRINSICS_PX, look_at, rotation_angle
from saccade.shared.world.guidance import guide
from saccade.shared.world.task import Spheres, spheres_around, start_pose

GAZE = np.array([0.0, 0.0, 0.05])
GOAL = look_at((-0.2, 0.35, 0.3), GAZE)
FREE = Spheres(np.zeros((0, 3)), np.zeros(0))


def led(hand, images) -> list:
    """The poses of a hand that is led to GOAL."""
    poses = [hand.camera]
    for _ in range(images):
        hand.follow(guide(hand.camera, GOAL, GAZE, INTRINSICS_PX, (480, 480)))
        poses.append(hand.camera)
    return poses


def test_the_sway_is_as_large_as_it_is_said_to_be():
    swings = [Sway(np.random.default_rng(seed)).at(time_s) for seed in range(200) for time_s in (0.0, 3.1, 7.7)]
    for which, size in ((0, SWAY_M), (1, SWAY_RAD)):
        lengths = np.linalg.norm([swing[which] for swing in swings], axis=1)
        assert np.sqrt((lengths ** 2).mean()) == pytest.approx(size, rel=0.1)


def test_a_hand_reacts_after_half_a_second_and_is_no_faster_than_a_hand(monkeypatch):
    monkeypatch.setattr("saccade.benchmarks.hand.SWAY_M", 0.0)
    poses = led(Hand(start_pose(), FREE, np.random.default_rng(0)), 40)
    moved = np.linalg.norm(np.diff([pose[:3, 3] for pose in poses], axis=0), axis=1)
    still = round(REACTION_S * RATE_HZ)
    assert (moved[:still] == 0).all()
    assert moved[still] > 0
    assert moved.max() <= SPEED_M_S / RATE_HZ + 1e-9


def test_it_comes_to_the_viewpoint_and_stays_about_there():
    for seed in range(5):
        poses = led(Hand(start_pose(), FREE, np.random.default_rng(seed)), 160)[-60:]
        away = np.linalg.norm([pose[:3, 3] - GOAL[:3, 3] for pose in poses], axis=1)
        turned = [float(rotation_angle(pose[:3, :3], GOAL[:3, :3])) for pose in poses]
        assert np.median(away) < 0.05
        assert np.median(turned) < 0.2


def test_it_stays_out_of_the_objects_and_its_poses_are_those_of_a_board():
    spheres = spheres_around([(0.1, 0.15, 0.2)], [(0.1, 0.1, 0.2)])
    rng = np.random.default_rng(1)
    for pose in led(Hand(start_pose(), spheres, rng), 80):
        assert spheres.depth_m(pose[:3, 3]) < 1e-6
    off_m = [np.linalg.norm(as_measured(GOAL, rng)[:3, 3] - GOAL[:3, 3]) for _ in range(400)]
    assert np.median(off_m) == pytest.approx(0.0007, rel=0.15)


def test_the_summary_counts_of_what():
    record = {"seconds": 5.0, "viewpoints": 2, "metres": 1.0}
    told = summary([{**record, "reached": True, "declared": True, "declared_rightly": True},
                    {**record, "reached": True, "declared": True, "declared_rightly": False},
                    {**record, "reached": False, "declared": False, "declared_rightly": False}])
    assert [(told[key]["count"], told[key]["of"]) for key in (
        "reached", "declared", "declared_rightly_of_the_declared", "declared_rightly_of_all")] == [
        (2, 3), (2, 3), (1, 2), (1, 3)]


def test_rehearsals_go_on_where_they_were_interrupted_and_others_are_not_counted(tmp_path):
    file = tmp_path / "hand.json"
    assert rehearsed(file, seed=1, board=False) == {}
    file.write_text('{"seed": 1, "rehearsals": [{"scene": "a"}]}')
    assert rehearsed(file, seed=1, board=False) == {"a": {"scene": "a"}}
    assert rehearsed(file, seed=2, board=False) == rehearsed(file, seed=1, board=True) == {}
