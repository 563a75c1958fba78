"""Whether an image shows the goal's object as the goal image does, and what the belief makes of it."""

import numpy as np
import pytest
import torch

from saccade.services.belief.looks import WITHIN_RAD, Looks
from saccade.services.perception.colours import unlike
from saccade.services.perception.core import SceneCCN
from saccade.services.perception.local_features import LocalFeatures
from saccade.services.perception.same_view import FEWEST, SameView, following, roll_of
from saccade.shared.config import WEIGHTS
from saccade.shared.model.weights import Weights
from saccade.shared.render.objects import load_mesh
from saccade.shared.render.world import World
from saccade.shared.world.geometry import INTRINSICS_PX, direction, look_at, viewing_grid, wrap
from saccade.shared.world.symmetry import NONE

NAMES, CENTER = ("soup_can", "rice_box"), np.array([0.05, -0.05, 0.06])


def pairs(count=60):
    """Places in two crops, the second a little larger, turned and shifted, as in two views from about one direction."""
    there = np.random.default_rng(0).uniform(0.2, 0.8, (count, 2))
    return there, (there - 0.5) @ np.array([[1.05, 0.06], [-0.06, 1.0]]) + (0.53, 0.48)


def test_pairs_of_one_direction_follow_from_one_map_and_others_do_not():
    there, here = pairs()
    count, affine = following(there, here)
    assert count == len(there)
    assert roll_of(affine) == pytest.approx(0.06, abs=0.01)
    half = np.where(np.arange(len(there))[:, None] % 2, here, here[::-1])
    assert len(there) // 2 <= following(there, half)[0] < 0.7 * len(there)
    assert following(there, 1.0 - there[::-1])[0] < 0.3 * len(there)
    assert following(there[:FEWEST - 1], here[:FEWEST - 1])[0] == 0


@pytest.fixture(scope="module")
def scene():
    world = World(tuple(load_mesh("pantry", name) for name in NAMES))
    model = SceneCCN(Weights(WEIGHTS / "pantry"), NAMES)
    yield world, model
    world.close()


def without_up(seen):
    """What is known of a goal image."""
    rgb, intrinsics_px, _, what = seen
    return rgb, intrinsics_px, what


def views(scene):
    """Looks at the rice box from a direction and a range, and says how well the view agrees with the goal image."""
    world, model = scene
    world.place({"rice_box": (CENTER, 0.0)}, (120, 90, 60))

    def see(azimuth, elevation, range_m, aside_m=0.0):
        camera = look_at(CENTER + range_m * direction(azimuth, elevation), CENTER + np.array([0, 0, aside_m]))
        rgb, up = world.render(camera), camera[2, :3]
        return rgb, INTRINSICS_PX, up, model.see(rgb, INTRINSICS_PX, up)

    same = SameView(LocalFeatures(), model.sides_m, *without_up(see(0.4, 0.6, 0.4)))
    return lambda *at: same(NAMES.index("rice_box"), *see(*at)), same, see


def test_a_view_from_the_goals_direction_agrees_more_than_those_from_elsewhere(scene):
    agreement, *_ = views(scene)
    here = agreement(0.45, 0.63, 0.42).share
    assert here > 0.5
    assert all(agreement(0.4 + turned, 0.6, 0.4).share < here - 0.2 for turned in (0.8, 2.0, np.pi))


def test_what_cannot_be_the_goals_view_is_not_compared(scene):
    """An object that is larger, elsewhere in the image, or not in the goal image."""
    agreement, same, see = views(scene)
    assert agreement(0.4, 0.6, 0.8) is None
    assert agreement(0.4, 0.6, 0.4, 0.15) is None
    assert same(NAMES.index("soup_can"), *see(0.4, 0.6, 0.4)) is None


def at(azimuth, elevation=0.6):
    return CENTER + 0.4 * direction(azimuth, elevation)


def ratio_at(looks, azimuth, elevation=0.6) -> float:
    rows, columns = viewing_grid()
    row, column = np.abs(rows - elevation).argmin(), np.abs(wrap(columns - azimuth)).argmin()
    return float(looks.log_ratio(CENTER)[row, column])


def test_a_comparison_counts_for_its_own_direction_and_says_nothing_of_others():
    looks = Looks(NONE)
    assert looks.log_ratio(CENTER) is None
    looks.take(at(1.0), CENTER, 0.8, 1.0)
    looks.take(at(-2.0), CENTER, 0.1, 1.0)
    assert ratio_at(looks, 1.0) > 4
    assert ratio_at(looks, -2.0) < -2
    assert abs(ratio_at(looks, 1.0 + 4 * WITHIN_RAD)) < 0.1
    looks.take(at(1.01), CENTER, 0.1, 1.0)  # the last from one direction counts
    assert ratio_at(looks, 1.0) < -2


def test_a_view_that_agrees_in_part_speaks_against_its_own_direction_and_for_those_beside_it():
    looks = Looks(NONE)
    looks.take(at(1.0), CENTER, 0.3, 1.0, aside_rad=0.25)
    assert ratio_at(looks, 1.25) > 2 > 0 > ratio_at(looks, 1.0) > ratio_at(looks, 0.95) - 1.0
    assert ratio_at(looks, 1.25) > ratio_at(looks, 0.75) + 2  # it points there
    up = Looks(NONE)
    up.take(at(1.0), CENTER, 0.3, 1.0, above_rad=0.2)
    assert ratio_at(up, 1.0, 0.8) > 2 > ratio_at(up, 1.0, 0.4)


def test_what_a_comparison_says_of_a_symmetric_object_holds_wherever_it_looks_the_same():
    looks = Looks(2)
    looks.take(at(1.0), CENTER, 0.8, 1.0)
    assert ratio_at(looks, 1.0 + np.pi) == pytest.approx(ratio_at(looks, 1.0), abs=0.2)
    assert abs(ratio_at(looks, 1.0 + np.pi / 2)) < 0.1


def test_of_two_sides_that_look_alike_the_one_that_agrees_better_is_the_goals():
    looks = Looks(NONE)
    looks.take(at(1.0 + np.pi), CENTER, 0.52, 1.0)
    alone = ratio_at(looks, 1.0 + np.pi)
    looks.take(at(1.0), CENTER, 0.64, 1.0)
    assert alone > 3
    assert ratio_at(looks, 1.0) > ratio_at(looks, 1.0 + np.pi) + 4


def test_from_above_views_that_are_turned_are_others_though_they_are_from_about_one_place():
    looks = Looks(NONE)
    looks.take(at(1.0, 1.5), CENTER, 0.7, 1.0)
    looks.take(at(1.0 + np.pi, 1.5), CENTER, 0.2, 1.0)
    assert ratio_at(looks, 1.0, 1.5) > 4 > -2 > ratio_at(looks, 1.0 + np.pi, 1.5)


def test_the_view_that_agrees_best_tells_the_goals_range():
    """If it agrees at all: a view from elsewhere says nothing of the range."""
    looks = Looks(NONE)
    looks.take(at(-2.0), CENTER, 0.1, 2.0)
    assert looks.range_m(CENTER) is None
    looks.take(at(1.0), CENTER, 0.8, 1.25)
    assert looks.range_m(CENTER) == pytest.approx(0.5)


def test_a_view_from_beside_points_to_the_goals_direction():
    """But not one that hardly agrees; and what is seen there decides."""
    part, hardly = Looks(NONE), Looks(NONE)
    part.take(at(1.0), CENTER, 0.3, 1.0, aside_rad=-0.3)
    hardly.take(at(1.0), CENTER, 0.1, 1.0, aside_rad=-0.3)
    assert ratio_at(part, 0.7) > 1 > ratio_at(part, 1.0)
    assert abs(ratio_at(hardly, 0.7)) < 1
    part.take(at(0.7), CENTER, 0.05, 1.0)
    assert ratio_at(part, 0.7) < -2.5


@pytest.mark.parametrize("elevation", [1.3, 0.6])
def test_the_images_tell_which_way_around_the_object_the_goals_view_is(scene, elevation):
    """From above things are turned in the image, from the side their surface is shifted."""
    world, model = scene
    world.place({"rice_box": (CENTER, 0.0)}, (120, 90, 60))

    def see(azimuth):
        camera = look_at(CENTER + 0.4 * direction(azimuth, elevation), CENTER)
        rgb = world.render(camera)
        return rgb, INTRINSICS_PX, camera[2, :3], model.see(rgb, INTRINSICS_PX, camera[2, :3])

    same = SameView(LocalFeatures(), model.sides_m, *without_up(see(0.4)))
    for turned in (0.2, -0.2):
        aside_rad = same(NAMES.index("rice_box"), *see(0.4 + turned)).aside_rad
        assert 0.2 < -aside_rad / turned < 1.8


def test_a_label_of_another_colour_is_unlike_in_any_light_and_wherever_the_map_puts_it():
    """The form is the same. Half of the light, or a shift that the map knows, makes nothing unlike."""
    label = torch.zeros(4, 128, 128)
    label[3, 30:98, 30:98] = 1.0
    label[:3, 30:98, 30:98] = torch.tensor([0.8, 0.7, 0.1])[:, None, None]
    other = label.clone()
    label[:3, 50:62, 34:94] = torch.tensor([0.2, 0.5, 0.9])[:, None, None]
    other[:3, 50:62, 34:94] = torch.tensor([0.9, 0.1, 0.1])[:, None, None]
    dim = torch.cat([label[:3] * 0.5, label[3:]])
    shifted = np.eye(3, 2) + np.array([[0, 0], [0, 0], [8 / 128, 0]])
    assert unlike(label, label, np.eye(3, 2)) == pytest.approx(0.0, abs=1e-3)
    assert unlike(label, dim, np.eye(3, 2)) == pytest.approx(0.0, abs=0.01)
    assert unlike(label, label.roll(8, dims=2), shifted) == pytest.approx(0.0, abs=0.01)
    assert unlike(label, other, np.eye(3, 2)) > 0.2
    assert unlike(label, torch.zeros(4, 128, 128), np.eye(3, 2)) == 0.0  # nothing is seen in both
