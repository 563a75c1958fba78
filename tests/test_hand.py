"""The planner with a hand: it waits, it notices that the hand goes elsewhere, and it says when the hand is there."""

from __future__ import annotations

import numpy as np
import pytest

from saccade.app.run.run import in_world
from saccade.services.planner.core import build
from saccade.services.planner.declaring import Evidence
from saccade.services.planner.hand import ALIKE_M, ELSEWHERE_M, LOOKS, MOST_LOOKS, MOVED_M, PATIENCE, SHIFTED_M, Hand
from saccade.shared.bus.messages import Belief, Percept
from saccade.shared.config import Config
from saccade.shared.world.geometry import INTRINSICS_PX, look_at, pose, viewing_grid
from saccade.shared.world.guidance import NEAR_M
from saccade.shared.world.task import Spheres, spheres_around, start_pose, success

GOAL = look_at((0.4, 0.0, 0.3), (0.0, 0.0, 0.05))
EYE = GOAL[:3, 3]
FREE = Spheres(np.zeros((0, 3)), np.zeros(0))
OLD = 10


def at(away_m, viewpoint=GOAL) -> np.ndarray:
    return pose(viewpoint[:3, :3], viewpoint[:3, 3] + (0, away_m, 0))


def followed(spheres=FREE) -> Hand:
    hand = Hand(OLD)
    hand.follow(GOAL, spheres, EYE)
    return hand


def verdicts(hand, poses, look=0.9, eye=EYE, fused=0.9, rival=False, agreement=None) -> list[str]:
    return [hand.take(camera, look and Evidence(look, fused, rival, agreement=agreement), eye) for camera in poses]


def test_the_plan_waits_for_the_hand():
    """It may rest for as long as it likes, and come nearer and sway."""
    assert set(verdicts(followed(), [at(0.4)] * 300 + [at(x) for x in (0.3, 0.25, 0.33, 0.2)])) == {"stay"}


def test_a_hand_that_goes_elsewhere_gets_another_plan():
    hand = followed()
    assert verdicts(hand, [at(0.4), at(0.2), at(0.2 + ELSEWHERE_M - 0.01), at(0.2 + ELSEWHERE_M + 0.01)]) == [
        "stay", "stay", "stay", "renew"]


@pytest.mark.parametrize(("look", "fused", "rival", "verdict"), [
    (0.9, 0.9, False, "there"), (0.45, 0.9, False, "there"), (0.7, 0.02, False, "wrong"), (0.1, 0.5, False, "wrong"),
    (0.8, 0.9, True, "rival"), (0.95, 0.9, True, "there"), (0.1, 0.1, True, "wrong")])
def test_several_looks_and_all_views_together_decide_whether_it_is_the_goal(look, fused, rival, verdict):
    """The looks alone are not enough against all views; where a rival is left, only clear looks are."""
    hand = followed()
    told = verdicts(hand, [at(0.2)] + [at(NEAR_M / 2)] * LOOKS, look, fused=fused, rival=rival)
    assert told == ["stay"] * LOOKS + [verdict]


def test_one_look_does_not_decide_against_the_others():
    hand = followed()
    looks = [hand.take(at(0), Evidence(look, 0.9), EYE) for look in (0.9, 0.9, 0.1, 0.9, 0.9)]
    assert looks[-1] == "there"


def test_where_the_last_images_agree_the_hand_is_there_a_bit_aside_of_the_viewpoint():
    """One image that agrees by chance is not enough, and farther away the images may agree as well."""
    aside, agrees = at(ALIKE_M - 0.01), Evidence(0.1, 0.95, agreement=0.8)
    hand = followed()
    assert [hand.take(aside, agrees, EYE) for _ in range(2)] == ["stay"] * 2
    assert hand.take(aside, Evidence(0.1, 0.95), EYE) == "stay"
    assert hand.take(aside, agrees, EYE) == "there"
    assert np.array_equal(hand.viewpoint, aside)
    assert hand.take(at(0.2), None, EYE) == "stay"
    assert "there" not in verdicts(followed(), [at(ALIKE_M + 0.05)] * LOOKS, agreement=0.8)


@pytest.mark.parametrize(("agreements", "verdict"), [
    ((0.6, 0.6, 0.1, 0.6, 0.6), "there"), ((0.1, 0.1, 0.6, 0.1, 0.6), "wrong")])
def test_the_mean_of_comparisons_with_the_goal_image_decides(agreements, verdict):
    """One blurred image does not decide, nor does one that agrees by chance."""
    hand = followed()
    told = [hand.take(at(0), Evidence(0.1, 0.95, agreement=agreement), EYE) for agreement in agreements]
    assert told[-1] == verdict


def test_where_looks_leave_a_doubt_there_are_more_of_them():
    doubt = {"look": 0.4, "fused": 0.6}
    assert verdicts(followed(), [at(0)] * MOST_LOOKS, **doubt) == ["stay"] * (MOST_LOOKS - 1) + ["wrong"]
    hand = followed()
    assert set(verdicts(hand, [at(0)] * LOOKS, **doubt)) == {"stay"}
    assert "there" in verdicts(hand, [at(0)] * LOOKS, look=0.95, fused=0.6)


def test_before_it_decides_the_hand_is_led_to_where_the_goal_is_believed_now():
    shifted = EYE + np.array([0.0, 0.0, 1.2 * SHIFTED_M])
    assert verdicts(followed(), [at(0)] * LOOKS, eye=shifted)[-1] == "renew"


def test_a_hand_that_cannot_come_nearer_is_asked_no_more():
    hand = followed()
    assert verdicts(hand, [at(2 * NEAR_M - 0.005)] * PATIENCE)[-2:] == ["stay", "there"]


def test_to_search_the_tolerance_of_the_task_is_enough():
    assert verdicts(followed(), [at(0.2), at(0.06)], look=None) == ["stay", "renew"]


def test_once_there_it_stays_there():
    hand = followed()
    verdicts(hand, [at(0)] * LOOKS)
    assert verdicts(hand, [at(0.05), at(0.5), at(0.0)], look=0.01) == ["there", "stay", "there"]


def test_a_goal_that_is_believed_elsewhere_renews_an_old_plan_only():
    up = np.array([0.0, 0.0, MOVED_M])
    assert verdicts(followed(), [at(0.4)] * OLD, eye=EYE + 2 * up) == ["stay"] * (OLD - 1) + ["renew"]
    assert set(verdicts(followed(), [at(0.4)] * (2 * OLD), eye=EYE + up / 2)) == {"stay"}


def test_a_hand_is_told_a_position_to_which_it_can_come():
    around = spheres_around([EYE], [(0.02, 0.02, 0.02)])
    told = Hand(OLD).follow(GOAL, around, EYE)
    assert around.depth_m(told[:3, 3]) < 1e-9
    np.testing.assert_array_equal(told[:3, :3], GOAL[:3, :3])


@pytest.mark.parametrize(("source", "values", "moved_by"), [
    ("webcam:0", {}, "hand"), ("webcam:0", {"planner.moved_by": "agent"}, "agent")])
def test_a_live_camera_is_in_a_hand_unless_told_otherwise(source, values, moved_by):
    config = in_world(Config().with_values({"camera.source": source} | values), "camera")
    assert config.planner.moved_by == moved_by


NAME, CENTER = "soup_can", np.array([0.0, 0.0, 0.05])
STAMP = {"run": "r", "episode": 0}


def belief(step, camera, goal_here=0.9) -> Belief:
    """The can is found, and looks like the goal from azimuth 0 and elevation 0.6."""
    elevation, azimuth = viewing_grid()
    apart = np.hypot((elevation[:, None] - 0.6) / 0.1, azimuth[None] / 0.1)
    return Belief(**STAMP, step=step, object=NAME, presence=1.0, world_from_camera=camera, mean_m=CENTER,
                  covariance_m2=1e-5 * np.eye(3), particles_m=np.tile(CENTER, (16, 1)).astype(np.float32), views=3,
                  goal_log_posterior=(-0.5 * apart ** 2).astype(np.float32), goal_range_m=0.4, goal_here=goal_here)


def test_the_planner_keeps_its_plan_until_the_hand_is_there_and_then_for_good():
    goal = Percept(**STAMP, step=0, object=NAME, presence=1.0, pixel=np.array([240.0, 240.0]), pixel_std=2.0, scale=1.0,
                   log_scale_std=0.05, latent_mean=np.zeros(0, np.float32), latent_std=np.zeros(0, np.float32),
                   intrinsics_px=np.array(INTRINSICS_PX), world_from_camera=np.eye(4))
    planner = build(Config().with_values({"scene.names": [NAME], "planner.moved_by": "hand",
                                          "planner.candidates": 30}))
    planner.begin("r", 0)
    step = 0

    def plan_at(camera):
        nonlocal step
        inputs = {"belief": {NAME: belief(step, camera)}, "goal_percept": {NAME: goal}}
        plan, _ = (output.message for output in planner.step(inputs))
        step += 1
        return plan

    first = plan_at(start_pose())
    waited = [plan_at(start_pose()) for _ in range(25)]
    assert all(np.array_equal(plan.viewpoint, first.viewpoint) for plan in waited)
    assert waited[-1].step == 25
    looked = [plan_at(first.viewpoint) for _ in range(LOOKS)]
    assert [plan.arrived for plan in looked] == [False] * (LOOKS - 1) + [True]
    gone = plan_at(start_pose())
    assert (gone.arrived, success(gone.viewpoint, first.viewpoint)) == (False, True)
    assert plan_at(first.viewpoint).arrived
