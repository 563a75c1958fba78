"""When the agent says that it is there: the looks and all views together must say so, and where another side was once
about as likely, the agent looks from there before."""

from __future__ import annotations

import numpy as np
import pytest

from saccade.services.belief.pose import LatentLikeness
from saccade.services.planner.arrival import SAID
from saccade.services.planner.core import build
from saccade.services.planner.declaring import BESIDE, BESIDE_RAD, Evidence, Rivals, fused_here, together
from saccade.shared.bus.messages import Belief, Percept, Plan
from saccade.shared.config import Config
from saccade.shared.world.geometry import INTRINSICS_PX, look_at, unit, viewing_grid, wrap
from saccade.shared.world.symmetry import NONE
from saccade.tests.samples import goal_percept

NAME, CENTER = "soup_can", np.array([0.0, 0.0, 0.05])
STAMP = {"run": "r", "episode": 0}
FRONT, BACK, ASIDE = (look_at(CENTER + 0.4 * unit((x, y, 0.68)), CENTER) for x, y in ((1, 0), (-1, 0), (0, 1)))


def posterior(**sides) -> np.ndarray:
    """Log posterior with these shares at the front and at the back, elevation 0.6; the rest is anywhere."""
    elevation, azimuth = viewing_grid()
    share = np.full((len(elevation), len(azimuth)), (1 - sum(sides.values())) / len(elevation) / len(azimuth))
    for side, towards in (("front", 0.0), ("back", np.pi)):
        apart = np.hypot((elevation[:, None] - 0.6) / 0.1, wrap(azimuth[None] - towards) / 0.1)
        bell = np.exp(-0.5 * apart ** 2)
        share = share + sides.get(side, 0.0) * bell / bell.sum()
    return np.log(share).astype(np.float32)


def belief(step, camera, log_posterior, look) -> Belief:
    return Belief(**STAMP, step=step, object=NAME, presence=1.0, world_from_camera=camera, mean_m=CENTER,
                  covariance_m2=1e-5 * np.eye(3), particles_m=np.tile(CENTER, (16, 1)).astype(np.float32), views=3,
                  goal_log_posterior=log_posterior, goal_range_m=0.4, goal_here=look)


def test_two_sources_of_evidence_must_agree():
    assert together(0.5, 0.7) == pytest.approx(0.7)
    assert Evidence(0.45, 0.9).is_enough
    assert not Evidence(0.66, 0.02).is_enough
    assert not Evidence(0.8, 0.8, rival=True).is_enough
    assert Evidence(0.95, 0.8, rival=True).is_enough
    assert 0 < together(0.0, 1.0) < 1


def test_where_looks_from_both_sides_are_good_the_better_ones_decide():
    assert Evidence(0.86, 0.04, elsewhere=0.75).is_enough
    assert not Evidence(0.75, 0.99, elsewhere=0.86).is_enough
    assert Evidence(0.4, 0.8, elsewhere=0.1).is_enough  # elsewhere was never likely


def test_a_view_that_was_compared_with_the_goal_image_counts_by_what_all_comparisons_leave():
    """The looks count no more, and beside a rival more is asked for."""
    assert Evidence(0.1, 0.85, agreement=0.5).is_enough
    assert not Evidence(0.99, 0.3, agreement=0.5).is_enough
    assert not Evidence(0.99, 0.99, agreement=0.3).is_enough
    assert not Evidence(0.99, 0.7, rival=True, agreement=0.5).is_enough
    assert not Evidence(0.1, 0.95, rival=True, agreement=0.5).is_enough
    assert Evidence(0.1, 0.95, rival=True, elsewhere=0.9, agreement=0.8).is_enough


def test_from_right_above_how_well_the_view_agrees_decides():
    """There the azimuth says little, and with it what all views leave. Beside a rival more is asked for."""
    assert Evidence(0.1, 0.3, agreement=0.5, above=True).is_enough
    assert not Evidence(0.9, 0.99, agreement=0.3, above=True).is_enough
    assert not Evidence(0.9, 0.99, rival=True, agreement=0.5, above=True).is_enough
    assert Evidence(0.1, 0.3, rival=True, agreement=0.75, above=True).is_enough
    assert Evidence(0.66, 0.02, above=True).probability == Evidence(0.66, 0.02).probability  # it was not compared


def test_where_other_views_were_compared_one_that_cannot_be_needs_more():
    assert Evidence(0.39, 0.8).is_enough
    assert not Evidence(0.39, 0.8, compared=True).is_enough
    assert Evidence(0.9, 0.9, compared=True).is_enough


def test_a_view_that_agrees_in_part_is_not_given_up():
    """The goal's may be beside it. Another side agrees less."""
    assert Evidence(0.5, 0.3, agreement=0.35).is_beside
    assert not Evidence(0.5, 0.3, agreement=0.15).is_beside
    assert not Evidence(0.5, 0.3).is_beside


def test_where_the_target_is_hidden_all_views_must_be_sure():
    """The goal image shows the target alone, so that from its view another object may be in front of it."""
    assert Evidence(0.0, 0.95).is_enough
    assert not Evidence(0.0, 0.8).is_enough
    assert not Evidence(0.0, 0.95, rival=True).is_enough
    assert not Evidence(0.01, 0.95).is_enough  # it is seen, and looks otherwise


def test_what_all_views_say_of_a_direction():
    said = belief(0, FRONT, posterior(front=0.7, back=0.2), 0.0)
    assert fused_here(said, FRONT, NONE) == pytest.approx(0.7, abs=0.07)
    assert fused_here(said, BACK, NONE) == pytest.approx(0.2, abs=0.04)
    assert fused_here(said, BACK, 2) == pytest.approx(0.9, abs=0.07)  # both sides look the same


def test_a_direction_that_was_once_likely_stays_a_rival_until_it_was_looked_from():
    rivals = Rivals()
    rivals.take(belief(0, ASIDE, posterior(front=0.5, back=0.4), 0.0))
    rivals.take(belief(1, FRONT, posterior(front=0.98, back=0.01), 0.0))
    rival = rivals.beside(FRONT, CENTER)
    assert rival @ unit(BACK[:3, 3] - CENTER) > 0.98
    assert rivals.elsewhere(FRONT, CENTER) == 0.0
    rivals.looked(BACK, CENTER, 0.4)
    assert (rivals.elsewhere(FRONT, CENTER), rivals.elsewhere(BACK, CENTER)) == (0.4, 0.0)
    rivals.take(belief(2, FRONT, posterior(front=0.5, back=0.4), 0.0))
    assert rivals.beside(FRONT, CENTER) is None
    alone = Rivals()
    alone.take(belief(0, ASIDE, posterior(front=0.8, back=0.05), 0.0))
    assert alone.beside(FRONT, CENTER) is None


def test_the_planner_looks_from_the_rival_side_and_comes_back_to_say_that_it_is_there():
    """The looks from the front leave a doubt, and those from the back say that it is not there."""
    planner = build(Config().with_values({"scene.names": [NAME], "planner.candidates": 30}))
    planner.begin("r", 0)
    both, front = posterior(front=0.5, back=0.45), posterior(front=0.9, back=0.05)
    step = 0

    def plan_at(camera, log_posterior, look):
        nonlocal step
        said = belief(step, camera, log_posterior, look)
        inputs = {"belief": {NAME: said}, "goal_percept": {NAME: goal_percept(NAME)}}
        plan, _ = (output.message for output in planner.step(inputs))
        step += 1
        return plan

    plan_at(ASIDE, both, 0.0)
    first = plan_at(ASIDE, front, 0.0)
    doubted = plan_at(first.viewpoint, front, 0.7)
    assert not doubted.arrived
    assert unit(doubted.viewpoint[:3, 3] - CENTER) @ unit(BACK[:3, 3] - CENTER) > 0.9
    again = plan_at(doubted.viewpoint, front, 0.05)
    assert not again.arrived
    assert unit(again.viewpoint[:3, 3] - CENTER) @ unit(FRONT[:3, 3] - CENTER) > 0.9
    assert plan_at(again.viewpoint, front, 0.7).arrived


def said_at(until: str, steps: int) -> list[Plan]:
    """The plans of a camera that goes to every viewpoint, and whose every view is like the goal's."""
    planner = build(Config().with_values({"scene.names": [NAME], "planner.candidates": 30, "simulator.until": until}))
    planner.begin("r", 0)
    plans, camera = [], ASIDE
    for step in range(steps):
        said = belief(step, camera, posterior(front=0.9), 0.97)
        plan, _ = (output.message for output in planner.step(
            {"belief": {NAME: said}, "goal_percept": {NAME: goal_percept(NAME)}}))
        plans.append(plan)
        camera = plan.viewpoint
    return plans


def test_an_episode_that_goes_on_where_it_ends_at_the_goal_says_that_it_is_elsewhere():
    """The agent looks from all around the view, from above first, and once it is through, from farther away. Where
    an episode ends by its word, it stays."""
    plans = said_at("reached", 40)
    told = [k for k, plan in enumerate(plans) if plan.arrived]
    assert told[:SAID - 1] == list(range(told[0], told[0] + SAID - 1))
    front = unit(FRONT[:3, 3] - CENTER)
    first = told[SAID - 2] + 1
    ring = [unit(plan.viewpoint[:3, 3] - CENTER) for plan in plans[first:first + BESIDE]]
    assert [float(np.arccos(towards @ front)) for towards in ring] == pytest.approx([BESIDE_RAD] * BESIDE, abs=0.1)
    assert ring[0][2] == max(towards[2] for towards in ring)
    back = unit(plans[first + BESIDE].viewpoint[:3, 3] - CENTER)
    assert float(np.arccos(min(1.0, back @ front))) < 0.1
    assert max(float(np.arccos(unit(p.viewpoint[:3, 3] - CENTER) @ front)) for p in plans[first + BESIDE:]) > 0.5
    plans = said_at("declared", 20)
    assert all(plan.arrived for plan in plans[told[0]:])


class Still:
    """A transition that moves nothing: all directions look alike."""

    def __call__(self, latent, displacement):
        moved = np.broadcast_to(latent, (len(displacement), len(latent))).astype(np.float32)
        return moved, np.full_like(moved, 0.3)


@pytest.mark.parametrize(("apart", "counts"), [(0.0, False), (0.05, False), (0.2, True)])
def test_a_view_that_is_unlike_the_goal_counts_against_its_own_direction_alone(apart, counts):
    """And one that is like it says nothing against others, which may look the same."""
    latent = np.zeros(8, np.float32)
    shown = Percept(**STAMP, step=0, object=NAME, presence=1.0, pixel=np.array([240.0, 240.0]), pixel_std=2.0,
                    scale=1.0, log_scale_std=0.05, latent_mean=latent, latent_std=np.full(8, 0.05, np.float32),
                    intrinsics_px=np.array(INTRINSICS_PX), world_from_camera=np.eye(4))
    seen = Percept(**{**vars(shown), "latent_mean": latent + np.float32(apart), "world_from_camera": FRONT})
    share = np.exp(LatentLikeness(Still(), shown).of(seen, CENTER))
    _, azimuth = viewing_grid()
    row = share[np.argmin(np.abs(viewing_grid()[0] - 0.6))]
    here, there = row[np.argmin(np.abs(azimuth))], row[np.argmin(np.abs(wrap(azimuth - np.pi)))]
    assert (here < 0.3 * there) == counts
    assert counts or here == pytest.approx(there, rel=1e-3)
