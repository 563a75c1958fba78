"""How likely an object is on the table that no image has shown, or that is shown for the first time."""

import numpy as np
import pytest

from saccade.services.belief.position import WORKSPACE_M, PositionFilter, evidence_of
from saccade.services.belief.unseen import ALWAYS_OVERLOOKED, Unseen
from saccade.shared.config import BeliefConfig
from saccade.shared.world.geometry import INTRINSICS_PX, direction, look_at
from saccade.tests.test_belief import TRUE, percept

K = np.array(INTRINSICS_PX)
FROM_ABOVE = look_at((0.05, 0.0, 1.6), (0.0, 0.0, 0.0))  # shows the whole table


def filter_of(presence=0.5) -> PositionFilter:
    return PositionFilter(BeliefConfig(particles=500), np.random.default_rng(0), presence=presence)


def look(position: PositionFilter, camera, others=()) -> None:
    """Takes an image that does not show the object."""
    position.missed(position.visible(camera, K, list(others)), np.random.default_rng(1))
    position.not_found(camera, K, list(others))


def test_an_object_is_nearly_ruled_out_once_the_whole_table_was_seen():
    position = filter_of()
    for _ in range(3):
        look(position, FROM_ABOVE)
    assert position.presence == pytest.approx(ALWAYS_OVERLOOKED / (1 + ALWAYS_OVERLOOKED), abs=0.01)


def test_the_same_view_again_and_again_rules_out_only_what_it_shows():
    """Half of the table is seen, then never anything else: the other half keeps the object possible."""
    position, camera = filter_of(), look_at((0.6, 0.0, 0.4), (0.25, 0.0, 0.0))
    for _ in range(3):
        look(position, camera)
    after = position.presence
    for _ in range(30):
        look(position, camera)
    assert 0.2 < after < 0.45
    assert position.presence == pytest.approx(after, abs=0.01)


def test_what_may_be_hidden_is_not_ruled_out():
    """A large thing before the camera hides most of the table: the presence hardly falls."""
    near, camera = filter_of(), look_at((0.7, 0.0, 0.3), (0.0, 0.0, 0.05))
    hiding = evidence_of(percept(camera, np.array([0.45, 0.0, 0.2])))
    free = filter_of()
    look(near, camera, [(hiding, 0.2)])
    look(free, camera)
    assert near.presence > free.presence + 0.1


def test_what_is_likely_before_any_image_stays_likelier():
    positions = [filter_of(prior) for prior in (0.5, 0.9)]
    for position in positions:
        look(position, look_at((0.6, 0.0, 0.4), (0.25, 0.0, 0.0)))
    odds = [position.presence / (1 - position.presence) for position in positions]
    assert odds[1] / odds[0] == pytest.approx(9.0)


def test_a_first_sight_counts_more_where_nobody_had_looked():
    """Two objects are seen for the first time, with one presence: one where three images had shown nothing, the other
    where no image had looked."""
    known, new = filter_of(), filter_of()
    for _ in range(3):
        look(known, FROM_ABOVE)
        look(new, look_at((0.6, 0.4, 0.3), (0.4, 0.4, 0.0)))
    camera = look_at(TRUE + 0.5 * direction(0.3, 0.7), TRUE)
    for position in (known, new):
        position.seen(percept(camera, presence=0.9), np.random.default_rng(2))
    assert known.presence < 0.5 < 0.88 < new.presence
    known.seen(percept(camera, presence=0.99), np.random.default_rng(3))
    assert known.presence > 0.9


def test_places_are_on_the_table_and_add_up():
    unseen = Unseen(WORKSPACE_M)
    assert unseen.prior.sum() == pytest.approx(1.0)
    assert np.abs(unseen.points[:, :2]).max() < 0.5
    assert unseen.log_likelihood == pytest.approx(0.0)
