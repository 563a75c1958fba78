"""Symmetry about the up axis: how it is found, told, judged, believed and used."""

from __future__ import annotations

import numpy as np
import pytest

from saccade.app.objects.symmetry import symmetry_of
from saccade.services.belief.turn import TURNS, turn_probability
from saccade.services.evaluator.core import result_of
from saccade.services.planner.goal_views import Side, nearest_eye
from saccade.services.planner.oracle import Oracle
from saccade.services.planner.place import PaperGround
from saccade.services.simulator.core import Simulator
from saccade.services.simulator.scenes import Placed, Scene
from saccade.shared.errors import SaccadeError
from saccade.shared.model.object_card import CARD, symmetries, symmetry_in
from saccade.shared.world.geometry import direction, look_at, spherical, viewing_grid, wrap
from saccade.shared.world.symmetry import (
    CONTINUOUS,
    NONE,
    symmetry_from,
    symmetry_value,
    turned_about,
    turns_of,
)
from saccade.shared.world.task import Episode, Spheres, equal_goals, nearest_goal, spheres_around, success
from saccade.tests.fakes.shapes import TEXTURE_PX, box, can, labelled, mug
from saccade.tests.test_turn import CENTER, TURN, camera_at, goal_view, seen

NOTHING = Spheres(np.zeros((0, 3)), np.zeros(0))


def grain():
    """A texture as irregular as a scan's, without anything on it that one could name."""
    return np.random.default_rng(0).integers(150, 200, (TEXTURE_PX, TEXTURE_PX, 3), dtype=np.uint8)


@pytest.mark.parametrize(("mesh", "expected"), [
    (can(grain()), CONTINUOUS), (can(labelled(0.3)), NONE), (can(labelled(0.1, 0.6)), 2),
    (can(sides=6), 6), (box((0.08, 0.08, 0.14)), 4), (box((0.08, 0.08, 0.14), labelled(0.05)), NONE), (mug(), NONE),
], ids=["grain", "label", "two labels", "six sides", "square", "labelled box", "mug"])
def test_the_symmetry_of_an_object_is_found_by_looking_at_it_from_around(mesh, expected):
    assert symmetry_of(mesh) == expected


@pytest.mark.parametrize("scale", [0.1, 30.0])
def test_it_is_found_whatever_the_size(scale):
    """Of a thimble and of a barrel. If the camera did not see the label, they would look the same from all around."""
    assert symmetry_of(can(labelled(0.3), radius_m=0.035 * scale, height_m=0.11 * scale)) == NONE


@pytest.mark.parametrize(("said", "symmetry"), [("none", NONE), ("continuous", CONTINUOUS), (4, 4), ("4", 4)])
def test_a_symmetry_is_told_in_a_word_or_a_number(said, symmetry):
    assert symmetry_from(said) == symmetry
    assert symmetry_from(symmetry_value(symmetry)) == symmetry


@pytest.mark.parametrize("said", ["round", "", 0, 1, -2, 121, 2.0, True, None, [4], "9" * 5000, "²"])
def test_what_is_no_symmetry_is_refused(said):
    with pytest.raises(ValueError, match=r'write "none", "continuous", or a number from 2 to 120'):
        symmetry_from(said)


def test_a_card_tells_it_and_only_sets_of_ones_own_have_cards(tmp_path, monkeypatch):
    monkeypatch.setenv("SACCADE_OBJECTS", str(tmp_path))
    (tmp_path / "my" / "tea").mkdir(parents=True)
    assert symmetries("my", ["tea"]) == {"tea": NONE}  # there is no card
    card = tmp_path / "my" / "tea" / CARD
    card.write_text('name = "tea"\nsymmetry = "continuous"\n')
    assert symmetries("my", ["tea"]) == {"tea": CONTINUOUS}
    assert symmetries("pantry", ["soup_can"]) == {"soup_can": NONE}
    card.write_text("symmetry = 1.5\n")
    with pytest.raises(SaccadeError, match=r"object card .*object.toml: symmetry is 1.5: write"):
        symmetry_in(card.parent)
    card.write_text("symmetry = \n")
    with pytest.raises(SaccadeError, match=r"object card .*object.toml is not TOML"):
        symmetry_in(card.parent)


# --- success and errors

GOAL = look_at(CENTER + 0.3 * direction(0.4, 0.6), CENTER)


@pytest.mark.parametrize(("symmetry", "turn", "reached"), [
    (NONE, np.pi, False), (2, np.pi, True), (2, np.pi / 2, False), (4, np.pi / 2, True), (4, 0.7, False),
    (CONTINUOUS, 0.123, True), (CONTINUOUS, 2.9, True)])
def test_any_view_that_looks_like_the_goal_is_the_goal(symmetry, turn, reached):
    camera = turned_about(CENTER, GOAL, [turn])[0]
    goal = nearest_goal(camera, equal_goals(GOAL, CENTER, symmetry, NOTHING))
    assert success(camera, goal) is reached


def test_seen_from_above_the_goals_image_may_be_turned_in_itself():
    """Straight above, all equal goals are at one place, and only their rotations differ."""
    above = look_at(CENTER + np.array([0.0, 0.0, 0.4]), CENTER)
    camera = turned_about(CENTER, above, [np.pi / 2])[0]
    assert not success(camera, nearest_goal(camera, equal_goals(above, CENTER, 2, NOTHING)))
    assert success(camera, nearest_goal(camera, equal_goals(above, CENTER, 4, NOTHING)))


def test_without_symmetry_the_goal_is_the_very_pose():
    episode = Episode(GOAL, NOTHING)
    assert episode.goal.tobytes() == GOAL.tobytes()
    assert len(equal_goals(GOAL, CENTER, NONE, NOTHING)) == 1


def test_a_view_that_another_object_hides_the_camera_from_is_no_goal():
    opposite = turned_about(CENTER, GOAL, [np.pi])[0]
    blocking = spheres_around([opposite[:3, 3]], [[0.1, 0.1, 0.1]])
    assert len(equal_goals(GOAL, CENTER, 2, NOTHING)) == 2
    assert len(equal_goals(GOAL, CENTER, 2, blocking)) == 1
    assert len(equal_goals(GOAL, CENTER, 4, NOTHING)) == 4


class Blind:
    """A world that renders nothing, with one object."""

    intrinsics_px = np.ones(4)

    def __init__(self, mesh):
        self.meshes, self.look = {mesh.name: mesh}, None

    def set_look(self, look):
        self.look = look

    def place(self, *_):
        pass

    def render(self, _camera):
        return np.zeros((4, 4, 3), dtype=np.uint8)


@pytest.mark.parametrize("symmetry", [NONE, 2, 4, CONTINUOUS])
def test_an_episode_is_judged_up_to_the_symmetry_of_its_target(symmetry):
    """The goal is on the far side. The oracle is told the nearest view that looks the same, and the result has the
    errors to that one."""
    from dataclasses import replace

    mesh = replace(can(), symmetry=symmetry)
    center = np.array([0.0, 0.0, 0.055])
    goal = look_at(center + 0.35 * direction(np.pi, 0.7), center)
    simulator = Simulator(Blind(mesh), [Scene("s", "can", (9, 9, 9), (Placed("can", center, 0.0),), goal)])
    first = {o.topic.name: o.message for o in simulator.begin("r", 0)}
    truth, oracle = first["truth"], Oracle()
    while not truth.done:
        action = oracle.step({"truth": truth, "goal": first["goal"]})[0].message
        truth = {o.topic.name: o.message for o in simulator.step({"action": action})}["truth"]
    result = result_of(truth)
    assert result.success
    assert result.azimuth_error_rad < 0.25
    assert (result.steps < 9) == (symmetry != NONE)  # half of the way around takes longer
    azimuth = spherical(truth.world_from_camera[:3, 3], center)[0]
    assert (abs(wrap(azimuth - np.pi)) < 0.3) == (symmetry == NONE)


# --- beliefs

@pytest.mark.parametrize("symmetry", [2, 3, 4, CONTINUOUS])
def test_a_view_shows_all_turns_after_which_an_object_looks_the_same(symmetry):
    percept = seen(camera_at(0.3))
    probability = turn_probability(percept, symmetry)
    assert probability.sum() == pytest.approx(1.0)
    period = TURNS // symmetry if symmetry else 1
    assert probability == pytest.approx(np.roll(probability, period))
    folded = turn_probability(percept).reshape(-1, period).mean(0)
    assert probability[:period] == pytest.approx(folded, abs=1e-6)


def test_the_belief_shows_all_views_that_look_like_the_goal_and_knows_when_it_is_at_one():
    from saccade.services.belief.pose import GoalView, TurnLikeness
    from saccade.shared.config import BeliefConfig

    goal = seen(camera_at(1.0, 0.6, 0.4), turned=(0.0,))
    known = GoalView(BeliefConfig(), TurnLikeness(goal, 4), goal, 4)
    for azimuth in (0.0, 1.5):
        known.seen(seen(camera_at(azimuth)), CENTER)
    around = np.exp(known.log_posterior()).sum(0)
    columns = viewing_grid()[1]
    for turn in turns_of(4):
        assert around[np.cos(columns - 1.0 - TURN - turn) > np.cos(0.4)].sum() == pytest.approx(0.25, abs=0.02)
    at_one = known.here(seen(camera_at(1.0 + TURN + np.pi / 2)))
    alone = goal_view(1.0, 0.6, turned=(0.0,))
    alone.seen(seen(camera_at(0.0)), CENTER)
    assert at_one == pytest.approx(alone.here(seen(camera_at(1.0 + TURN))), abs=0.02)
    assert at_one > 0.6
    assert known.here(seen(camera_at(1.0 + TURN + np.pi / 4))) < 0.1


# --- plans

def test_the_agent_goes_to_the_nearest_view_that_looks_like_the_goal_and_is_free():
    there, camera = CENTER + 0.3 * direction(np.pi * 0.9, 0.6), camera_at(0.0)
    assert nearest_eye(there, CENTER, NONE, camera, PaperGround(NOTHING)) is there
    near = CENTER + 0.3 * direction(-np.pi * 0.1, 0.6)
    assert nearest_eye(there, CENTER, 2, camera, PaperGround(NOTHING)) == pytest.approx(near)
    assert nearest_eye(there, CENTER, CONTINUOUS, camera, PaperGround(NOTHING)) == pytest.approx(
        CENTER + 0.3 * direction(0.0, 0.6), abs=0.01)
    blocking = Spheres(near[None], np.array([0.12]))
    assert nearest_eye(there, CENTER, 2, camera, PaperGround(blocking)) == pytest.approx(there)


@pytest.mark.parametrize(("symmetry", "most"), [(2, np.pi / 2), (4, np.pi / 4), (CONTINUOUS, 0.0)])
def test_what_is_known_of_one_side_holds_for_the_others(symmetry, most):
    side = Side(CENTER, symmetry, CENTER + direction(2.0, 0.3))
    eyes = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 3))
    turned = side.eyes(eyes)
    before, after = spherical(eyes, CENTER), spherical(turned, CENTER)
    assert np.array(after[1:]) == pytest.approx(np.array(before[1:]))
    assert np.abs(wrap(after[0] - 2.0)).max() <= most + 1e-9
    pose = look_at(eyes[0], CENTER)
    assert side.pose(pose) == pytest.approx(look_at(turned[0], CENTER))
    assert Side(CENTER, NONE, eyes[0]).eyes(eyes) is eyes
