"""Networks that know no object by name: what is made of their outputs, with outputs that are right by construction."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from saccade.services.perception.comparer import Compared, Comparison
from saccade.services.perception.likeness import UNIT, Cohort
from saccade.services.perception.local_features import LocalFeatures
from saccade.services.perception.matching import best_matches, further_matches, unclaimed
from saccade.services.perception.open_world import Match, OpenWorld, Placed, Things, _worth_a_look, rolled
from saccade.services.perception.proposer import STRIDE, Proposer, places, propose
from saccade.services.perception.view_encoder import VECTOR, ViewEncoder
from saccade.shared.model.bank import FILLED, bank_of, compressed
from saccade.shared.render.groceries import grocery
from saccade.shared.world.geometry import (
    INTRINSICS_PX,
    REFERENCE_RANGE_M,
    direction,
    look_at,
    pose,
    project,
    rotation_angle,
    rotation_xyz,
    unit,
)
from saccade.shared.world.windows import Window
from saccade.training.open.banks import bank_from
from saccade.training.open.comparer import turn_between
from saccade.training.open.table_crops import circle_of

UP = (0.0, 1.0, 0.0)
STRANGERS = Cohort(F.normalize(torch.randn(60, VECTOR, generator=torch.Generator().manual_seed(1)), dim=1))


@pytest.fixture(scope="module")
def mesh():
    return grocery(np.random.default_rng(5), "grocery")


@pytest.fixture(scope="module")
def bank(mesh, small_banks):
    torch.manual_seed(0)
    return bank_from(mesh, ViewEncoder().eval(), LocalFeatures(), count=120)


def outputs(bank, camera_from_object, shift=(0.0, 0.0), log_ratio=0.0, roll=0.0, same=4.0):
    """What a perfect comparer says of the nearest view, and the number of this."""
    towards = unit(-camera_from_object[:3, :3].T @ camera_from_object[:3, 3])
    view = int(np.argmax(bank.directions @ towards))
    turn = turn_between(bank.directions[view], towards)
    raw = torch.tensor([[same, *shift, log_ratio, *turn, roll, -3.0, -3.0, -3.0, -3.0]], dtype=torch.float32)
    return view, Compared(raw)


def window_of(mesh, camera_from_object, up, shift=(0.0, 0.0), log_ratio=0.0):
    """The window of a crop that is off by so much."""
    points = mesh.vertices_m @ camera_from_object[:3, :3].T + camera_from_object[:3, 3]
    rotation, half = circle_of(points, unit(camera_from_object[:3, 3]), np.asarray(up))
    half = half / FILLED / np.exp(log_ratio)
    ray = rotation @ unit(np.array([-shift[0] * half, shift[1] * half, -1.0]))
    fx, fy, cx, cy = INTRINSICS_PX
    pixel = np.array([[cx - fx * ray[0] / ray[2], cy + fy * ray[1] / ray[2]]])
    return Window(pixel, np.ones(1), np.array([2 * REFERENCE_RANGE_M * half]))


def things_of(window, roll=0.0):
    """One thing, whose crop was rolled by an angle."""
    crops = torch.zeros(1, 4, 64, 64), torch.zeros(1, 3, 192, 192)
    return Things(*crops, window, torch.zeros(1, 4, 4), np.array([roll]))


@pytest.mark.parametrize("off", [((0.0, 0.0), 0.0), ((0.15, -0.1), 0.1), ((-0.2, 0.05), -0.15)])
@pytest.mark.parametrize("aside", [(0.0, 0.0), (0.12, -0.08)])
@pytest.mark.parametrize("roll", [0.0, np.pi / 2, -np.pi / 4])
def test_from_right_outputs_follow_pixel_range_and_rotation(mesh, bank, off, aside, roll):
    world_from_object = pose(rotation_xyz((0.0, 0.0, 0.7)), (0.1, 0.05, 0.06))
    eye = world_from_object[:3, 3] + 0.6 * direction(0.4, 0.5)
    camera = look_at(eye, world_from_object[:3, 3] + (*aside, 0.0))
    camera_from_object = np.linalg.inv(camera) @ world_from_object
    up = camera[2, :3]
    # In a crop that is rolled, the comparer sees the shift turned, and the view rolled.
    cos, sin = np.cos(roll), np.sin(roll)
    turned = (cos * off[0][0] - sin * off[0][1], sin * off[0][0] + cos * off[0][1])
    view, compared = outputs(bank, camera_from_object, turned, off[1], roll)
    things = things_of(window_of(mesh, camera_from_object, up, *off), roll)
    placed = Placed(bank, Match(0, 0.9, view, 0, None), compared, things, INTRINSICS_PX, up)
    pixel, _ = project(world_from_object[:3, 3], camera, INTRINSICS_PX)
    assert placed.pixel == pytest.approx(pixel, abs=6.0)
    assert placed.range_m == pytest.approx(np.linalg.norm(camera_from_object[:3, 3]), rel=0.06)
    modes = placed.modes(torch.tensor(bank.directions @ bank.directions[view], dtype=torch.float32), [(view, 0)], 20.0)
    assert float(rotation_angle(modes.rotations[0], camera_from_object[:3, :3])) < 0.06
    assert np.exp(modes.log_probability).sum() == pytest.approx(1.0)
    assert modes.log_probability.argmax() == 0


def test_a_crop_is_rolled_by_the_angle_that_is_told():
    crop = torch.zeros(1, 1, 64, 64)
    crop[0, 0, 28:36, 48:56] = 1.0  # to the right of the middle
    turned = rolled(crop, torch.tensor([np.pi / 2], dtype=torch.float32))
    v, u = (float(x.double().mean()) for x in torch.nonzero(turned[0, 0] > 0.5, as_tuple=True))
    assert (u, v) == pytest.approx((31.5, 51.5), abs=0.6)  # below it


def test_two_views_that_cannot_be_told_apart_are_two_modes(bank):
    one, other = 0, int(np.argmin(bank.directions @ bank.directions[0]))
    raw = torch.zeros(2, 11)
    raw[:, 0], raw[:, 7:] = 2.0, -3.0
    window = Window(np.array([[240.0, 240.0]]), np.ones(1), np.array([0.15]))
    placed = Placed(bank, Match(0, 0.9, one, 0, None), Compared(raw), things_of(window), INTRINSICS_PX, UP)
    towards = torch.tensor(bank.directions @ bank.directions[[one, other]].T, dtype=torch.float32).max(1).values
    modes = placed.modes(towards, [(one, 0), (other, 1)], 30.0)
    assert np.exp(modes.log_probability[:2]) == pytest.approx(0.5, abs=0.12)
    assert float(rotation_angle(modes.rotations[0], modes.rotations[1])) > 2.0


def voted(circles, height=200, width=240):
    """Foreground and votes as they should be for discs (u, v, radius), the later ones in front."""
    place = places(height, width)
    foreground, votes = torch.full(place.shape[1:], -5.0), torch.zeros(3, *place.shape[1:])
    for u, v, radius in circles:
        inside = ((place - torch.tensor([u, v])[:, None, None]) ** 2).sum(0) < radius ** 2
        foreground[inside] = 5.0
        votes[0][inside], votes[1][inside] = u - place[0][inside], v - place[1][inside]
        votes[2][inside] = float(np.log(radius))
    return foreground, votes


def test_every_thing_is_proposed_once_at_its_place_also_half_hidden():
    circles = [(60.0, 60.0, 30.0), (95.0, 70.0, 28.0), (190.0, 140.0, 45.0), (180.0, 30.0, 12.0)]
    found = propose(*voted(circles))
    assert len(found) == len(circles)
    for u, v, radius in circles:
        off = (found.center - torch.tensor([u, v])).norm(dim=1)
        assert float(off.min()) < STRIDE / 2
        assert float(found.radius[off.argmin()]) == pytest.approx(radius, rel=0.05)
    assert ((found.masks > 0.5).sum(0) <= 1).all()


def test_where_nothing_votes_nothing_is_proposed():
    assert len(propose(*voted([]))) == 0
    assert len(propose(*voted([(100.0, 100.0, 5.0)]))) == 0  # a speck


@pytest.mark.parametrize("shape", [(480, 480), (300, 640), (97, 63)])
def test_any_size_is_seen_and_an_empty_picture_shows_nothing(bank, shape):
    torch.manual_seed(1)
    model = OpenWorld(Proposer(), ViewEncoder(), Comparison(), LocalFeatures(), [bank, bank], STRANGERS)
    seen = model.see(np.zeros((*shape, 3), dtype=np.uint8), INTRINSICS_PX, UP)
    assert seen.presence.shape == (2,)
    assert len(seen.modes) == 2
    assert np.isfinite(seen.pixel).all()
    assert seen.latent_mean.shape == (2, 0)


def test_a_crop_and_a_view_that_are_looked_at_once_compare_as_side_by_side():
    """The first layer that sees both is linear, so that it may take them one after the other."""
    torch.manual_seed(3)
    comparison, seen, known = Comparison().eval(), torch.rand(3, 4, 64, 64), torch.rand(3, 4, 64, 64)
    with torch.inference_mode():
        apart = comparison.halves(comparison.of_seen(seen), comparison.of_known(known))
        assert apart.numpy() == pytest.approx(comparison(seen, known).numpy(), abs=1e-4)
        assert apart.numpy() != pytest.approx(comparison(seen, known.flip(0)).numpy(), abs=1e-3)


def test_where_images_follow_one_another_a_thing_is_only_what_it_is_like():
    """Its likest two, and what is nearly as like as the first, if that is like something."""
    like = np.array([[0.5, 0.1], [0.45, 0.2], [0.42, 0.14], [0.1, 0.15]])  # of 4 objects and 2 things
    assert _worth_a_look(like).T.tolist() == [[True, True, True, False], [False, True, False, True]]
    assert _worth_a_look(like[:1]).all()


def test_a_thing_is_one_object_or_none():
    """The probabilities of all objects in one thing sum to less than 1."""
    matches = best_matches([(k, 0, 0) for k in range(3)], np.array([3.0, 2.0, -4.0]), {})
    presence = [match.presence for match in matches.values()]
    assert sum(presence) < 1.0
    assert presence[0] == pytest.approx(np.exp(3) / (1 + np.exp(3) + np.exp(2) + np.exp(-4)))


def test_one_more_of_an_object_is_what_is_as_like_it_and_no_other_object():
    """Things 0 and 2 are alike and like object 0, thing 1 is object 1, thing 3 is like nothing, and the last thing is
    the whole image: only thing 2 may be one more, and it is if the odds say so."""
    like = np.array([[0.9, 0.1, 0.85, 0.2, 0.9], [0.1, 0.8, 0.2, 0.2, 0.5]])
    matches = {0: Match(0, 0.99, 0, 0, None), 1: Match(1, 0.98, 0, 0, None)}
    assert unclaimed(like, matches, whole=True) == [(0, 2)]
    assert [(k, match.thing) for k, match in further_matches([(0, 2, 0)], np.array([9.0]), {})] == [(0, 2)]
    assert further_matches([(0, 2, 0)], np.array([0.9]), {}) == []
    absent = {0: Match(0, 0.2, 0, 0, None), 1: Match(1, 0.98, 0, 0, None)}
    assert unclaimed(like, absent, whole=True) == []


def test_a_similarity_counts_by_what_is_usual_for_the_crop_and_for_the_view():
    """A view that is like everything counts less than one that is like this crop alone, at the same similarity."""
    crop = F.normalize(torch.tensor([[1.0, 1.0, 0.0, 0.0]]), dim=1)
    plain, special = torch.eye(4)[0], torch.eye(4)[1]
    strangers = F.normalize(plain + 0.3 * torch.randn(40, 4, generator=torch.Generator().manual_seed(3)), dim=1)
    cohort = Cohort(strangers)
    views = torch.stack([plain, special])
    similar = crop @ views.T
    assert float(similar[0, 0]) == pytest.approx(float(similar[0, 1]))
    normalised = cohort.normalised(similar, cohort.likest(crop), cohort.likest(views))
    assert float(normalised[0, 1]) > float(normalised[0, 0]) + UNIT
    # Where every similarity is smaller by the same, as in a blurred crop, nothing changes by the crop's half.
    mean, std = cohort.likest(crop)
    shifted = cohort.normalised(similar - 0.2, (mean - 0.2, std), cohort.likest(views))
    by_view = UNIT / 2 * 0.2 / cohort.likest(views)[1].T
    assert (normalised - shifted).numpy() == pytest.approx(by_view.numpy(), abs=1e-6)


def test_a_bank_is_small_and_reads_as_it_was_written(bank):
    arrays = bank.arrays()
    again = bank_of("grocery", arrays)
    assert again.pictures == bank.pictures
    assert again.vectors == pytest.approx(bank.vectors, abs=1e-3)
    assert again.circles_m == pytest.approx(bank.circles_m, abs=1e-6)
    assert again.image(3).shape == (64, 64, 4)
    assert bank.vectors.shape == (120, VECTOR)
    own = {key: array for key, array in arrays.items() if "landmark" not in key}
    assert sum(array.nbytes for array in own.values()) < 120 * 2_500


@pytest.mark.parametrize("change", [
    {"lengths": np.array([10 ** 9], dtype=np.uint32)}, {"circles_m": np.zeros((3, 3))},
    {"vectors": np.full((120, VECTOR), np.nan, dtype=np.float16)}, {"pictures": np.zeros(5)}])
def test_a_damaged_bank_is_refused(bank, change):
    with pytest.raises(ValueError, match="its "):
        bank_of("grocery", bank.arrays() | change)


def test_pictures_of_another_size_are_no_bank():
    with pytest.raises(ValueError, match="shape"):
        compressed(np.zeros((2, 32, 32, 4), dtype=np.uint8))
