"""Looks: light, surfaces and the camera's faults, from a name or a file; the flat look changes nothing."""

import numpy as np
import pytest
from PIL import Image

from saccade.app.bench.bench import prepare
from saccade.services.simulator.core import Looks, build
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.render.look import FLAT, LOOKS, Look, load_look, random_look
from saccade.shared.render.objects import load_mesh
from saccade.shared.render.surfaces import SURFACES, surface
from saccade.shared.render.world import World
from saccade.shared.world.geometry import look_at

NAMES = sorted(path.stem for path in LOOKS.glob("*.toml"))
CAMERA = look_at(np.array([0.45, 0.05, 0.3]), np.array([0.0, 0.0, 0.1]))
WHOLE = """
exposure = 0.9
white_balance = [1.1, 1.0, 0.9]
noise_sigma = 2
blur_sigma_px = 0.5
ambient = 0.5
object_specular = 0.3
table_texture = "table top.png"
table_texture_m = 0.4
background = [10, 20, 30]

[[lights]]
direction = [1, 0, -1]
diffuse = 0.4
specular = 0.2
shadow = false

[[lights]]
direction = [0, 0, -1]
"""


@pytest.fixture(scope="module")
def world():
    meshes = tuple(load_mesh("pantry", name) for name in ("soup_can", "rice_box"))
    with_two = World(meshes)
    yield with_two
    with_two.close()


def seen(world, look):
    world.set_look(look)
    world.place({name: ((0.0, 0.15 * n, mesh.size_m[2] / 2), 0.3)
                 for n, (name, mesh) in enumerate(world.meshes.items())}, (60, 120, 90))
    return look.seen(world.render(CAMERA), np.random.default_rng(0))


def test_after_any_look_the_flat_one_is_as_it_was(world):
    flat = seen(world, FLAT)
    for name in (*NAMES, "flat"):
        look = load_look(name)
        assert np.array_equal(seen(world, look), flat) == (name == "flat"), name
        assert np.array_equal(seen(world, look), seen(world, look)), name
    assert np.array_equal(seen(world, FLAT), flat)


def test_a_lamp_casts_a_shadow_and_without_it_there_is_none(world):
    lamp = load_look("lamp")
    without = lamp.model_copy(update={"lights": tuple(light.model_copy(update={"shadow": False})
                                                      for light in lamp.lights)})
    darker = seen(world, without).astype(int) - seen(world, lamp)
    assert (darker.min(axis=-1) > 10).mean() > 0.01  # a part of the table
    assert (darker == 0).all(axis=-1).mean() > 0.4


def test_what_the_camera_does_to_an_image():
    image = np.full((40, 40, 3), 100, np.uint8)
    image[20:] = 200
    rng = np.random.default_rng(0)
    assert Look(exposure=0.5).seen(image, rng)[0, 0].tolist() == [50, 50, 50]
    assert Look(white_balance=(1.2, 1.0, 0.5), exposure=2.0).seen(image, rng)[0, 0].tolist() == [240, 200, 100]
    assert Look(exposure=4.0).seen(image, rng).max() == 255
    noisy = Look(noise_sigma=10).seen(image, rng)[:20].astype(float)
    assert noisy.std() == pytest.approx(10, rel=0.1)
    assert noisy.mean() == pytest.approx(100, abs=1)
    blurred = Look(blur_sigma_px=2).seen(image, rng)
    assert blurred[19, 0, 0] > 130
    assert blurred[0, 0, 0] == 100
    assert blurred.astype(float).mean() == pytest.approx(150, abs=0.5)
    assert FLAT.seen(image, rng) is image


def test_a_file_of_ones_own_with_all_keys(world, tmp_path):
    (tmp_path / "mine.toml").write_text(WHOLE)
    Image.fromarray(np.tile(np.array([[[250, 0, 0]], [[0, 0, 250]]], np.uint8), (4, 8, 1))).save(
        tmp_path / "table top.png")
    look = load_look(str(tmp_path / "mine.toml"))
    assert look.exposure == 0.9
    assert [light.shadow for light in look.lights] == [False, True]
    assert look.table_texture.shape == (512, 512, 3)
    image = seen(world, look)
    behind = image[seen(world, FLAT).max(axis=-1) == 0].mean(axis=0)
    assert behind == pytest.approx([10 * 0.9 * 1.1, 20 * 0.9, 30 * 0.9 * 0.9], abs=2)
    reds, blues = (image[..., channel].astype(int) - image[..., 2 - channel] > 60 for channel in (0, 2))
    assert reds.mean() > 0.1
    assert blues.mean() > 0.1


@pytest.mark.parametrize(("text", "words"), [
    ("exposure = -1", "key 'exposure'"), ("exposure = 'x'", "key 'exposure'"), ("lihgts = []", "key 'lihgts'"),
    ("[[lights]]\ndirection = [0, 0, 0]", r"key 'lights.0.direction'.*must not be \[0, 0, 0\]"),
    ("[[lights]]\ndiffuse = 1", "key 'lights.0.direction'"), ("noise_sigma = nan", "key 'noise_sigma'"),
    ("table_texture = 'none.png'", "table_texture .*none.png"), ("background = [1, 2]", "key 'background'"),
    ("table_texture = [1, 2, 3]", "key 'table_texture'"), ("exposure = ", "is no TOML"),
    ("lights = [" + ", ".join(["{direction = [0, 0, -1]}"] * 7) + "]", "key 'lights'"), ("table_texture_m = 0", "_m")])
def test_what_is_wrong_in_a_file_is_one_line(tmp_path, text, words):
    (tmp_path / "bad.toml").write_text(text)
    with pytest.raises(SaccadeError, match=words) as caught:
        load_look(str(tmp_path / "bad.toml"))
    assert "\n" not in str(caught.value)


def test_an_unknown_look_names_those_there_are():
    with pytest.raises(SaccadeError, match=r"'dusk' is unknown: choose from bright, dim, flat, .*random.*wood"):
        load_look("dusk")


def test_random_looks_are_drawn_from_the_seed_and_differ():
    first, again, other = (random_look(np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert first.exposure == again.exposure != other.exposure
    config = Config().with_values({"simulator.look": "random", "seed": 3})
    looks = Looks(config)
    scene, goal = looks.of(4)
    assert scene is goal  # without a look of its own the goal image has that of its scene
    assert Looks(config).of(4)[0].exposure == scene.exposure != looks.of(5)[0].exposure
    scene, goal = Looks(config.with_values({"simulator.goal_look": "random"})).of(4)
    assert scene.exposure != goal.exposure


def test_the_goal_image_can_have_another_look():
    images = {}
    for name in (None, "dim"):
        simulator = build(Config().with_values({"simulator.goal_look": name, "scene.names": ["soup_can"]}))
        images[name] = {output.topic.name: output.message for output in simulator.begin("r", 0)}
        simulator.world.close()
    assert images["dim"]["goal"].rgb.mean() < 0.7 * images[None]["goal"].rgb.mean()
    assert np.array_equal(images["dim"]["frame"].rgb, images[None]["frame"].rgb)


def test_the_suite_of_looks_draws_a_look_for_each_scene_and_another_for_its_goal(tmp_path):
    plan = prepare("sceneccn", Config(), tmp_path / "r.json", suite="looks")
    assert len(plan.scenes) == 100
    assert (plan.config.simulator.look, plan.config.simulator.goal_look) == ("random", "random")


def test_surfaces_repeat_at_their_borders():
    for name in SURFACES:
        image = surface(name).astype(float)
        assert image.shape == (512, 512, 3)
        assert image.std() > 3
        assert np.array_equal(surface(name), surface(name))
