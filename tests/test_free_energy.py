"""Expected free energy: the batched terms against plain loops, and what each term prefers."""

import numpy as np
import pytest

from saccade.services.planner.free_energy import (
    ACROSS_STD_M,
    ALONG_SHARE,
    FARTHEST_M,
    HALF_VIEW_TANGENT,
    bilinear,
    expected_free_energy,
    information_gain,
    look_at_cost,
    pose_cost,
    scale_cost,
)
from saccade.services.planner.goal import Preference, aim
from saccade.shared.bus.messages import Belief
from saccade.shared.world.geometry import (
    GRID_AZIMUTHS,
    GRID_ELEVATIONS,
    INTRINSICS_PX,
    direction,
    look_at,
    project,
    rotation_angle,
    viewing_grid,
)


def belief(mean=(0.1, -0.05, 0.08), deviation=0.02, posterior=None, presence=0.9, seed=0) -> Belief:
    rng = np.random.default_rng(seed)
    cloud = (np.array(mean) + rng.normal(0, deviation, (512, 3))).astype(np.float32)
    return Belief(run="r", episode=0, step=0, object="mug", presence=presence, world_from_camera=np.eye(4),
                  mean_m=np.array(mean), covariance_m2=np.eye(3) * deviation ** 2, particles_m=cloud, views=1,
                  goal_log_posterior=posterior)


def candidates(count=300, seed=1):
    rng = np.random.default_rng(seed)
    return rng.uniform([-0.5, -0.5, 0.1], [0.5, 0.5, 0.6], (count, 3)), rng.uniform(-0.3, 0.3, (count, 3))


PREFERENCE = Preference("mug", 0.3, 0.025, np.array([240.0, 230.0]), np.array(INTRINSICS_PX), 0.9)


def peaked(azimuth, elevation):
    rows, columns = viewing_grid()
    here = direction(*np.meshgrid(columns, rows))
    log = 40 * (here @ direction(azimuth, elevation))
    return (log - np.log(np.exp(log).sum())).astype(np.float32)


def seen_slowly(eye, gaze, point):
    forward = (gaze - eye) / np.linalg.norm(gaze - eye)
    ahead = (point - eye) @ forward
    across = np.linalg.norm((point - eye) - ahead * forward)
    return 0.1 < ahead < FARTHEST_M and across < HALF_VIEW_TANGENT * ahead


def test_terms_equal_a_plain_loop_over_candidates():
    eyes, gazes = candidates()
    b = belief(posterior=peaked(1.0, 0.6))
    terms = expected_free_energy(eyes, gazes, {"mug": b}, PREFERENCE, 1.0)
    for n, (eye, gaze) in enumerate(zip(eyes, gazes, strict=True)):
        offset = gaze - b.mean_m
        assert terms.position[n] == pytest.approx(
            0.5 * offset @ np.linalg.inv(b.covariance_m2 + np.eye(3) * 4e-4) @ offset)
        assert terms.scale[n] == pytest.approx(0.5 * ((np.linalg.norm(eye - gaze) - 0.3) / 0.025) ** 2)
        gain = 0.0
        if seen_slowly(eye, gaze, b.mean_m):
            distance = np.linalg.norm(b.mean_m - eye)
            ray = (b.mean_m - eye) / distance
            precision = ((np.eye(3) - np.outer(ray, ray)) / ACROSS_STD_M ** 2
                         + np.outer(ray, ray) / (ALONG_SHARE * distance + 0.01) ** 2)
            prior = b.covariance_m2 + np.eye(3) * 1e-6
            gain = 0.5 * np.log(np.linalg.det(prior) / np.linalg.det(np.linalg.inv(np.linalg.inv(prior) + precision)))
        assert terms.information[n] == pytest.approx(-gain, abs=1e-9)
    assert np.allclose(terms.total, terms.position + terms.scale + terms.pose + terms.information)


def test_information_about_a_lost_object_grows_with_the_share_of_particles_in_view():
    lost = belief(mean=(0.0, 0.0, 0.1), deviation=0.15)
    eye = np.array([[0.45, 0.0, 0.5], [0.45, 0.0, 0.5]])
    gaze = np.array([[0.0, 0.0, 0.1], [0.45, 0.45, 0.5]])  # towards the cloud, and away from it
    towards, away = information_gain(eye, gaze, lost)
    shares = [np.mean([seen_slowly(e, g, p) for p in lost.particles_m]) for e, g in zip(eye, gaze, strict=True)]
    assert shares[0] > 0.3 > shares[1]
    assert towards > away


def test_look_at_prefers_the_believed_position_and_scale_the_goals_range():
    b = belief()
    assert np.argmin(look_at_cost(np.array([b.mean_m, b.mean_m + 0.1]), b)) == 0
    gaze = np.repeat(b.mean_m[None], 3, axis=0)
    eyes = b.mean_m + np.array([[0.2], [0.3], [0.4]]) * direction(0.3, 0.5)
    assert np.argmin(scale_cost(eyes, gaze, PREFERENCE)) == 1


@pytest.mark.parametrize(("azimuth", "elevation"), [(3.1, 0.5), (-3.1, 0.5), (0.0, 1.5), (1.0, 0.03)])
def test_pose_prefers_the_posteriors_peak_also_across_the_seam_and_at_the_pole(azimuth, elevation):
    b = belief(posterior=peaked(azimuth, elevation))
    ring = np.array([(azimuth + d, elevation) for d in (0.0, 0.5, -0.5, np.pi)])
    cost = pose_cost(b.mean_m + 0.3 * direction(ring[:, 0], ring[:, 1]), b)
    assert np.argmin(cost) == 0
    assert cost[0] < 1.0


def test_bilinear_is_exact_at_the_cells_and_wraps():
    grid = np.random.default_rng(0).normal(size=(GRID_ELEVATIONS, GRID_AZIMUTHS))
    rows, columns = viewing_grid()
    a, e = np.meshgrid(columns, rows)
    assert np.allclose(bilinear(grid, a.ravel(), e.ravel()), grid.ravel())
    seam = bilinear(grid, np.array([np.pi, -np.pi]), np.array([rows[3]] * 2))
    assert np.allclose(seam, (grid[3, 0] + grid[3, -1]) / 2)


def test_aim_sees_the_target_at_the_pixel_without_roll():
    rng = np.random.default_rng(0)
    for _ in range(100):
        target = rng.uniform(-0.2, 0.2, 3)
        position = target + 0.4 * direction(rng.uniform(0, 6), rng.uniform(0, 1.4))
        pixel = rng.uniform(150, 330, 2)
        camera = aim(position, target, pixel, INTRINSICS_PX)
        assert np.allclose(project(target, camera, INTRINSICS_PX)[0], pixel, atol=1e-6)
        assert abs(camera[2, 0]) < 1e-9
        assert np.allclose(camera[:3, :3] @ camera[:3, :3].T, np.eye(3))


def test_aim_from_right_above_is_turned_no_more_than_it_must_be():
    """No camera without roll sees the target there; the clipped solution would be turned by a quarter."""
    position, pixel = 0.34 * direction(3.0, 1.54), (INTRINSICS_PX[2] + 30.0, INTRINSICS_PX[3])
    camera = aim(position, np.zeros(3), pixel, INTRINSICS_PX)
    assert np.allclose(project(np.zeros(3), camera, INTRINSICS_PX)[0], pixel, atol=1e-6)
    assert rotation_angle(camera[:3, :3], look_at(position, np.zeros(3))[:3, :3]) < 0.1


def test_aim_at_the_principal_point_is_look_at():
    camera = aim((0.4, 0.1, 0.3), (0.0, 0.0, 0.1), INTRINSICS_PX[2:], INTRINSICS_PX)
    assert np.allclose(camera, look_at((0.4, 0.1, 0.3), (0.0, 0.0, 0.1)))
