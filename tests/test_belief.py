"""Scenarios of the position and pose beliefs; each docstring says what is expected."""

import numpy as np
import pytest

from saccade.services.belief.pose import GoalView, LatentLikeness
from saccade.services.belief.position import PositionFilter, behind, beyond_nearest, evidence_of
from saccade.shared.bus.messages import Percept
from saccade.shared.config import BeliefConfig
from saccade.shared.model.generative_model import LATENT
from saccade.shared.world.geometry import INTRINSICS_PX, direction, look_at, project, spherical, viewing_grid
from saccade.shared.world.task import start_pose

TRUE = np.array([0.12, -0.08, 0.07])
CONFIG = BeliefConfig(particles=3000)


def percept(camera, center=TRUE, *, presence=0.99, noise=None, latent=None, std=0.04) -> Percept:
    pixel, _ = project(center, camera, INTRINSICS_PX)
    distance = np.linalg.norm(center - camera[:3, 3])
    noise = np.zeros(3) if noise is None else noise
    latent = np.zeros(LATENT) if latent is None else latent
    return Percept(run="r", episode=0, step=0, object="mug", presence=presence, pixel=pixel + noise[:2], pixel_std=4.0,
                   scale=0.4 / distance * np.exp(noise[2]), log_scale_std=std,
                   latent_mean=latent.astype(np.float32), latent_std=np.full(LATENT, 0.1, np.float32),
                   intrinsics_px=np.array(INTRINSICS_PX), world_from_camera=camera)


def cameras(count=8):
    return [look_at(TRUE + 0.5 * direction(a, 0.7), TRUE) for a in np.linspace(0, 2.0, count)]


def test_views_from_several_sides_find_the_object():
    """Noisy percepts from an arc: the mean comes within 2 cm and the true position within 3 deviations."""
    rng = np.random.default_rng(0)
    position = PositionFilter(CONFIG, rng)
    before = np.trace(position.moments()[1])
    for camera in cameras():
        position.seen(percept(camera, noise=rng.normal(0, [4, 4, 0.04])), rng)
    mean, covariance = position.moments()
    assert np.linalg.norm(mean - TRUE) < 0.02
    assert (mean - TRUE) @ np.linalg.inv(covariance) @ (mean - TRUE) < 3 ** 2 * 3
    assert np.trace(covariance) < before / 100
    assert position.presence > 0.95


def test_one_view_knows_the_direction_better_than_the_range():
    """A single percept with an uncertain scale: the cloud is an ellipsoid along the ray."""
    rng, camera = np.random.default_rng(0), start_pose()
    position = PositionFilter(CONFIG, rng)
    position.seen(percept(camera, std=0.15), rng)
    covariance = position.moments()[1]
    ray = (TRUE - camera[:3, 3]) / np.linalg.norm(TRUE - camera[:3, 3])
    across = np.cross(ray, [0, 0, 1.0])
    across /= np.linalg.norm(across)
    assert ray @ covariance @ ray > 4 * (across @ covariance @ across)


def test_not_seeing_removes_what_was_in_view_and_nothing_else():
    """Looking at one half of the table without seeing the object: the mass moves to the other half."""
    rng = np.random.default_rng(0)
    position = PositionFilter(CONFIG, rng)
    camera = look_at((0.3, 0.3, 0.6), (0.25, 0.25, 0.0))
    pixels, _ = project(position.particles, camera, INTRINSICS_PX)
    in_view = ((pixels > 60) & (pixels < 420)).all(1)
    share = position.weights[in_view].sum()
    for _ in range(4):
        position.missed(position.visible(camera, np.array(INTRINSICS_PX), []), rng)
    pixels, _ = project(position.particles, camera, INTRINSICS_PX)
    left = position.weights[((pixels > 60) & (pixels < 420)).all(1)].sum()
    assert share > 0.03
    assert left < share / 5
    assert position.presence < 0.5


def test_what_another_object_hides_keeps_its_weight():
    """A box is seen in front: particles behind it stay, those before it and beside it are hidden from nothing."""
    camera = look_at((0.5, 0.0, 0.1), (0.0, 0.0, 0.1))
    box = evidence_of(percept(camera, np.array([0.2, 0.0, 0.1])))
    points = np.array([[-0.1, 0.0, 0.1], [0.35, 0.0, 0.1], [-0.1, 0.3, 0.1]])
    assert behind(points, camera[:3, 3], [(box, 0.1)]).tolist() == [True, False, False]


def test_the_papers_cut_off_is_the_nearest_objects_range():
    """As written in the paper: whatever is farther than the nearest object seen is not looked for, hidden or not."""
    camera = look_at((0.5, 0.0, 0.1), (0.0, 0.0, 0.1))
    box = evidence_of(percept(camera, np.array([0.2, 0.0, 0.1])))
    points = np.array([[-0.1, 0.0, 0.1], [0.35, 0.0, 0.1], [-0.1, 0.3, 0.1]])
    assert beyond_nearest(points, camera[:3, 3], [(box, 0.1)]).tolist() == [True, False, True]


def test_the_papers_covariance_is_fixed():
    covariance = evidence_of(percept(start_pose(), std=0.01), "paper").covariance
    assert np.linalg.eigvalsh(covariance) == pytest.approx([0.020, 0.020, 0.0969])


def test_the_last_view_alone_forgets_the_others():
    seen = goal_view(Turning(1), latent_of(1.0, 0.5), BeliefConfig(pose="last"))
    for camera in cameras():
        seen.seen(percept(camera, latent=latent_of(0.3, 0.7)), TRUE)
    assert len(seen.keyframes) == 1
    assert np.allclose(seen.keyframes[0].eye, cameras()[-1][:3, 3])


def test_a_lost_object_is_found_again():
    """The belief has settled at a wrong place; percepts elsewhere draw it there."""
    rng = np.random.default_rng(0)
    position = PositionFilter(CONFIG, rng)
    for camera in cameras(4):
        position.seen(percept(camera, TRUE + np.array([-0.25, 0.2, 0.0])), rng)
    for camera in cameras(8):
        position.seen(percept(camera), rng)
    assert np.linalg.norm(position.moments()[0] - TRUE) < 0.03


def test_the_filter_leaves_numpys_global_state_alone():
    np.random.seed(7)
    expected = np.random.get_state()[1].copy()
    position = PositionFilter(CONFIG, np.random.default_rng(0))
    position.seen(percept(start_pose()), np.random.default_rng(1))
    assert (np.random.get_state()[1] == expected).all()


class Turning:
    """A transition that is right by construction: the latent is (cos, sin, elevation) of the viewing direction, and
    seen through `folds` every view looks as `folds` others do."""

    def __init__(self, folds: int):
        self.folds = folds

    def __call__(self, latent, displacement):
        angle = np.arctan2(latent[1], latent[0]) + self.folds * displacement[:, 0]
        moved = np.zeros((len(displacement), len(latent)), dtype=np.float32)
        moved[:, 0], moved[:, 1] = np.cos(angle), np.sin(angle)
        moved[:, 2] = latent[2] + displacement[:, 1]
        return moved, np.full_like(moved, 0.15)


def goal_view(transition, latent, config=CONFIG):
    """What is known of a goal image that shows the object with this latent pose, before the first view."""
    goal = percept(start_pose(), latent=latent)
    return GoalView(config, LatentLikeness(transition, goal), goal)


def latent_of(azimuth, elevation, folds=1):
    return np.array([np.cos(folds * azimuth), np.sin(folds * azimuth), elevation, 0, 0, 0, 0, 0])


@pytest.mark.parametrize("goal", [(2.5, 0.6), (-3.1, 1.0), (0.2, 0.1)])
def test_the_goals_direction_is_found_from_other_views(goal):
    """Two views of an object without symmetry: the posterior's peak is within a cell or two of the goal's direction."""
    seen = goal_view(Turning(1), latent_of(*goal))
    assert seen.log_posterior() is None
    for camera in (cameras()[0], cameras()[-1]):
        azimuth, elevation, _ = spherical(camera[:3, 3], TRUE)
        seen.seen(percept(camera, latent=latent_of(azimuth, elevation)), TRUE)
    posterior = seen.log_posterior()
    row, column = np.unravel_index(np.argmax(posterior), posterior.shape)
    rows, columns = viewing_grid()
    assert direction(columns[column], rows[row]) @ direction(*goal) > np.cos(0.14)  # a cell and a half
    assert np.exp(posterior).sum() == pytest.approx(1.0)


def test_a_symmetric_object_keeps_two_modes():
    """Front and back look the same: both directions keep about the same probability."""
    seen = goal_view(Turning(2), latent_of(1.0, 0.5, 2))
    for camera in cameras():
        azimuth, elevation, _ = spherical(camera[:3, 3], TRUE)
        seen.seen(percept(camera, latent=latent_of(azimuth, elevation, 2)), TRUE)
    _, columns = viewing_grid()
    probability = np.exp(seen.log_posterior())
    front = probability[:, np.abs(columns - 1.0) < 0.3].sum()
    back = probability[:, np.abs(columns - 1.0 + np.pi) < 0.3].sum()
    assert front > 0.4
    assert back > 0.4


def test_views_from_the_same_place_count_once():
    seen = goal_view(Turning(1), latent_of(1.0, 0.5))
    for _ in range(5):
        seen.seen(percept(cameras()[0], latent=latent_of(0.0, 0.7)), TRUE)
    assert len(seen.keyframes) == 1
