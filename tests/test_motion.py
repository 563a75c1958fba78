"""What happens to an object is noticed, and nothing else: scenarios of percepts with the noise that networks have."""

from __future__ import annotations

import numpy as np
import pytest

from saccade.services.belief.motion import Motion
from saccade.services.belief.pose import GoalView
from saccade.services.belief.position import Evidence, PositionFilter, evidence_of, of_whole
from saccade.shared.bus.messages import Percept
from saccade.shared.config import BeliefConfig
from saccade.shared.world.geometry import INTRINSICS_PX, direction, look_at, project

HERE, THERE = np.array([0.10, -0.05, 0.06]), np.array([-0.02, 0.06, 0.06])
RADIUS_M = 0.05


def percept(center, camera, rng, *, presence=0.99, step=0) -> Percept:
    """An object at `center` [3], with the errors that are told."""
    pixel, _ = project(center, camera, INTRINSICS_PX)
    range_m = np.linalg.norm(center - camera[:3, 3])
    return Percept(run="r", episode=0, step=step, object="mug", presence=presence,
                   pixel=pixel + rng.normal(0.0, 3.0, 2), pixel_std=3.0,
                   scale=0.4 / range_m * np.exp(rng.normal(0.0, 0.03)), log_scale_std=0.03,
                   latent_mean=np.zeros(4, np.float32), latent_std=np.ones(4, np.float32),
                   intrinsics_px=np.array(INTRINSICS_PX), world_from_camera=camera)


def camera_at(step):
    """A camera that goes round the table, 5 cm a step."""
    return look_at(0.5 * direction(0.1 * step, 0.8) + np.array([0.0, 0.0, 0.05]), np.array([0.04, 0.0, 0.05]))


def play(places, *, seed=0, clear=True, presence=0.99, doubt=0.0):
    """The changes that are noticed, as (step, kind), where the object is at places [S] of which None is nowhere; and
    the motion. `doubt` is the presence of what is not seen."""
    rng, motion, noticed = np.random.default_rng(seed), Motion(), []
    for step, place in enumerate(places):
        seen = None if place is None else of_whole(percept(place, camera_at(step), rng), RADIUS_M, [])
        change = motion.step(step, seen, doubt if place is None else presence, np.full(len(motion.accounts), clear))
        if change is not None:
            noticed.append((step, change.kind))
    return noticed, motion


@pytest.mark.parametrize("seed", range(10))
def test_nothing_is_noticed_where_nothing_happens(seed):
    """Forty images from all around, in some of which the object is hidden."""
    places = [HERE if step % 7 else None for step in range(1, 41)]
    assert play(places, seed=seed, clear=False)[0] == []
    assert play([HERE] * 40, seed=seed)[0] == []


@pytest.mark.parametrize("seed", range(10))
def test_an_object_that_is_elsewhere_was_moved(seed):
    """It is noticed within three images, once, and the object is then believed where it is."""
    noticed, motion = play([HERE] * 5 + [THERE] * 12, seed=seed)
    assert [kind for _, kind in noticed] == ["moved"]
    assert noticed[0][0] <= 7
    assert np.linalg.norm(motion.told.place - THERE) < 0.015


def test_an_object_that_was_pushed_over_was_moved():
    """Its centre comes down by some centimetres, and goes aside."""
    noticed, _ = play([HERE] * 5 + [HERE + np.array([0.01, 0.05, -0.025])] * 8)
    assert [kind for _, kind in noticed] == ["moved"]


def test_an_object_that_is_not_seen_where_it_would_be_in_clear_view_is_gone():
    """Where it is hidden, or out of the image, nothing is noticed. Back at its place it is back, elsewhere it was
    moved."""
    taken = [HERE] * 4 + [None] * 8
    noticed, _ = play(taken)
    assert [kind for _, kind in noticed] == ["gone"]
    assert 5 <= noticed[0][0] <= 8
    assert play(taken, clear=False)[0] == []
    assert [kind for _, kind in play([*taken, *[HERE] * 4])[0]] == ["gone", "back"]
    assert [kind for _, kind in play([*taken, *[THERE] * 4])[0]] == ["gone", "moved"]


def test_what_is_overlooked_in_some_views_that_are_alike_is_not_gone():
    """Networks overlook things in several views in a row, and are often in doubt then."""
    assert play([*[HERE] * 4, *[None] * 3, *[HERE] * 4, *[None] * 2, *[HERE] * 4])[0] == []
    assert play([*[HERE] * 4, *[None] * 8, *[HERE] * 4], doubt=0.3)[0] == []


def test_what_was_never_sure_to_be_there_does_not_go():
    """Two weak percepts of something else, and then none."""
    assert play([HERE, HERE, *[None] * 10], presence=0.75)[0] == []
    assert [kind for _, kind in play([HERE, HERE, *[None] * 10])[0]] == ["gone"]


@pytest.mark.parametrize("speed", [0.006, 0.012, 0.02])
def test_an_object_that_drifts_has_a_velocity_until_it_rests(speed):
    """It moves along an arc, and then rests."""
    angle = np.arange(16) * speed / 0.25
    arc = HERE + 0.25 * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], axis=1)
    noticed, motion = play([HERE] * 3 + list(arc))
    assert [kind for _, kind in noticed] == ["drifts"]
    truth = arc[-1] - arc[-2]
    assert np.linalg.norm(motion.velocity_m - truth) < 0.5 * speed + 0.001
    assert np.linalg.norm(motion.told.place - arc[-1]) < 0.015 + 0.75 * speed
    noticed, motion = play([HERE] * 3 + list(arc) + [arc[-1]] * 40)
    assert [kind for _, kind in noticed] == ["drifts", "rests"]
    assert motion.velocity_m is None


def test_an_object_that_turns_back_is_followed():
    """To and fro at 1.5 cm a step: the velocity has the other sign some images after the turn."""
    steps = np.concatenate([np.arange(14), np.arange(14, 2, -1)])
    path = HERE + np.array([0.0, 0.015, 0.0]) * steps[:, None]
    _, motion = play([HERE] * 3 + list(path))
    assert motion.velocity_m[1] < -0.008
    assert np.linalg.norm(motion.told.place - path[-1]) < 0.03


def test_what_is_seen_in_part_says_less_of_where_an_object_is():
    """Beside the border of the image, behind another object, or below the table."""
    rng, camera = np.random.default_rng(0), look_at((0.5, 0.0, 0.4), (0.0, 0.0, 0.05))
    whole = percept(np.array([0.0, 0.0, 0.05]), camera, rng)
    before: Evidence = evidence_of(percept(np.array([0.10, 0.02, 0.12]), camera, rng))

    def spread(seen, others=()):
        return float(np.trace(of_whole(seen, RADIUS_M, list(others)).covariance))

    at_border = percept(np.array([0.0, 0.265, 0.05]), camera, rng)
    below = percept(np.array([-0.05, 0.0, -0.3]), camera, rng)
    assert spread(whole) < np.trace(evidence_of(whole).covariance)
    assert spread(at_border) > 5 * spread(whole)
    assert spread(whole, [(before, RADIUS_M)]) > 5 * spread(whole)
    assert spread(whole, [(evidence_of(percept(np.array([-0.12, 0.02, 0.05]), camera, rng)), RADIUS_M)]) == spread(
        whole)
    assert spread(below) > 5 * spread(whole)


def test_particles_go_with_what_drifts_and_widen_where_it_is_not_seen():
    rng, velocity = np.random.default_rng(0), np.array([0.01, 0.0, 0.0])
    position = PositionFilter(BeliefConfig(particles=3000), rng)
    position.placed(HERE, np.eye(3) * 0.01 ** 2, rng)
    assert np.linalg.norm(position.moments()[0] - HERE) < 0.002
    for _ in range(5):
        position.carried(velocity, True, rng)
    mean, seen = position.moments()
    assert np.linalg.norm(mean - HERE - 5 * velocity) < 0.002
    for _ in range(5):
        position.carried(velocity, False, rng)
    assert np.trace(position.moments()[1]) > 2 * np.trace(seen)
    position.lost(rng)
    assert np.sqrt(np.trace(position.moments()[1])) > 0.2
    assert position.presence < 0.5


class FromTheSide:
    """A likeness that remembers from where each view was seen relative to the object."""

    def of(self, percept: Percept, center) -> np.ndarray:
        return np.log(np.full((18, 72), 1 / (18 * 72)))

    def grid(self, log_probability) -> np.ndarray:
        return log_probability


def test_kept_views_go_with_what_drifts_and_are_forgotten_when_it_is_moved():
    """As if object and camera were one piece. Old ones are dropped, because the object may turn as it drifts."""
    rng = np.random.default_rng(0)
    view = GoalView(BeliefConfig(), FromTheSide(), percept(HERE, camera_at(0), rng))
    view.seen(percept(HERE, camera_at(0), rng, step=0), HERE)
    view.seen(percept(HERE, camera_at(5), rng, step=5), HERE)
    eyes = [keyframe.eye.copy() for keyframe in view.keyframes]
    view.carried(np.array([0.02, 0.0, 0.0]), 6)
    np.testing.assert_allclose([k.eye for k in view.keyframes], np.array(eyes) + np.array([0.02, 0.0, 0.0]))
    np.testing.assert_allclose(view.center, HERE + np.array([0.02, 0.0, 0.0]))
    view.carried(np.array([0.02, 0.0, 0.0]), 10)
    assert [keyframe.percept.step for keyframe in view.keyframes] == [5]
    view.forget()
    assert view.log_posterior() is None
