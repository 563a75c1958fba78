"""Perception with the shipped pantry weights on rendered images, against the truth of the renderer."""

import numpy as np
import pytest
import torch

from saccade.services.perception.core import SceneCCN
from saccade.services.perception.cropping import Cropper
from saccade.shared.config import WEIGHTS
from saccade.shared.model.weights import Weights
from saccade.shared.render.objects import load_mesh, names_of
from saccade.shared.render.world import World
from saccade.shared.world.geometry import INTRINSICS_PX, direction, look_at, project
from saccade.shared.world.windows import Window

NAMES = names_of("pantry")


@pytest.fixture(scope="module")
def model():
    return SceneCCN(Weights(WEIGHTS / "pantry"), NAMES)


@pytest.fixture(scope="module")
def world():
    world = World(tuple(load_mesh("pantry", name) for name in NAMES))
    yield world
    world.close()


def stand(world, name, x, y):
    return np.array([x, y, world.meshes[name].size_m[2] / 2])


@pytest.mark.parametrize("name", NAMES)
def test_an_object_alone_is_found_where_it_is(model, world, name):
    """From 12 places, turned at random: seen, others not; in the median within 12 px and 12 % of the range."""
    rng = np.random.default_rng(NAMES.index(name))
    index, pixels, ranges, presences, others = NAMES.index(name), [], [], [], []
    for _ in range(12):
        center = stand(world, name, *rng.uniform(-0.2, 0.2, 2))
        distance = rng.uniform(0.3, 0.7)
        world.place({name: (center, rng.uniform(0, 2 * np.pi))}, rng.integers(0, 256, 3))
        eye = center + distance * direction(rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 1.3))
        camera = look_at(eye, center + rng.normal(0, 0.04, 3))
        seen = model.see(world.render(camera), INTRINSICS_PX, camera[2, :3])
        pixels.append(np.linalg.norm(seen.pixel[index] - project(center, camera, INTRINSICS_PX)[0]))
        ranges.append(abs(np.log(0.4 / seen.scale[index] / distance)))
        presences.append(seen.presence[index])
        others.append(np.delete(seen.presence, index).max())
    assert np.median(pixels) < 12
    assert np.median(ranges) < 0.12
    assert np.mean(np.array(presences) > 0.6) >= 10 / 12
    assert np.mean(np.array(others) > 0.6) <= 2 / 12


def test_an_empty_table_holds_nothing(model, world):
    world.place({}, (120, 60, 200))
    seen = model.see(world.render(look_at((0.4, 0.0, 0.4), (0, 0, 0))), INTRINSICS_PX, (0.0, 0.7, 0.7))
    assert seen.presence.max() < 0.6


def test_a_black_image_holds_nothing(model):
    seen = model.see(np.zeros((480, 480, 3), np.uint8), INTRINSICS_PX, (0.0, 1.0, 0.0))
    assert seen.presence.max() < 0.6
    assert np.isfinite(seen.latent_mean).all()


def test_the_same_image_gives_the_same_bytes(model, world):
    world.place({NAMES[0]: (stand(world, NAMES[0], 0, 0), 0.4)}, (90, 90, 90))
    camera = look_at((0.4, 0.1, 0.4), (0, 0, 0.05))
    image = world.render(camera)
    first, second = (model.see(image, INTRINSICS_PX, camera[2, :3]) for _ in range(2))
    assert first.latent_mean.tobytes() == second.latent_mean.tobytes()
    assert first.pixel.tobytes() == second.pixel.tobytes()


def test_objects_together_are_seen_as_one_by_one(world):
    """Evaluating all networks in one batch gives what each gives alone."""
    weights = Weights(WEIGHTS / "pantry")
    places = [(-0.2, -0.2), (0.2, 0.2), (-0.2, 0.2), (0.2, -0.2), (0.0, 0.0)]
    world.place({n: (stand(world, n, *p), 0.3) for n, p in zip(NAMES, places, strict=True)}, (60, 160, 90))
    camera = look_at((0.45, 0.0, 0.5), (0, 0, 0))
    image = world.render(camera)
    together = SceneCCN(weights, NAMES).see(image, INTRINSICS_PX, camera[2, :3])
    for k, name in enumerate(NAMES):
        alone = SceneCCN(weights, (name,)).see(image, INTRINSICS_PX, camera[2, :3])
        assert np.allclose(alone.latent_mean[0], together.latent_mean[k], atol=1e-4)
        assert np.allclose(alone.pixel[0], together.pixel[k], atol=1e-2)


def test_a_crop_off_the_axis_looks_as_one_on_it(world):
    """The spatial transformer undoes the shear of the image's edge: the object, seen from one place, gives the same
    crop wherever the camera looks."""
    name = NAMES[1]
    center = stand(world, name, 0.0, 0.0)
    world.place({name: (center, 0.5)}, (0, 0, 0))
    eye, crops = center + 0.6 * direction(0.4, 0.7), []
    for target in (center, center + np.array([0.05, -0.14, 0.04])):
        camera = look_at(eye, target)
        image = torch.from_numpy(world.render(camera)).permute(2, 0, 1).float() / 255
        cropper = Cropper(image, torch.ones(1, 60, 60), INTRINSICS_PX, camera[2, :3])
        pixel, _ = project(center, camera, INTRINSICS_PX)
        assert target is center or np.linalg.norm(pixel - INTRINSICS_PX[2:]) > 100
        crops.append(cropper.cut(Window(pixel[None], np.array([0.4 / 0.6]), np.array([0.25]))))
    within = ((crops[0][1] == 1) & (crops[1][1] == 1)).float()  # inside both images
    assert float(within.mean()) > 0.6
    assert float(((crops[0][0] - crops[1][0]).abs() * within).mean()) < 0.02


def test_a_correction_brings_the_window_to_the_object():
    """Moving a window by the offset it was wrong by lands on the true pixel and scale."""
    camera = look_at((0.5, 0.0, 0.4), (0.0, 0.0, 0.05))
    cropper = Cropper(torch.zeros(3, 480, 480), torch.zeros(1, 60, 60), INTRINSICS_PX, camera[2, :3])
    window = Window(np.array([[300.0, 200.0]]), np.array([0.7]), np.array([0.2]))
    moved = cropper.corrected(window, np.array([[0.05, -0.03, 0.1]]))
    back = cropper.corrected(Window(moved.pixels, window.scales, window.sides_m), np.array([[-0.05, 0.03, 0.0]]))
    assert np.allclose(back.pixels, window.pixels, atol=0.5)
    assert moved.pixels[0, 0] > 300
    assert moved.pixels[0, 1] < 200
    assert moved.scales[0] == pytest.approx(0.7 * np.exp(0.1))
