"""A map from pictures without poses: the objects' places and the cameras' motion, by the objects' sizes alone."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from saccade.app.look.relative_map import LEAST_COMMON, map_of
from saccade.shared.render.objects import load_mesh, names_of
from saccade.shared.render.world import World
from saccade.shared.world.geometry import INTRINSICS_PX, direction, look_at, rotation_angle
from saccade.tests.front_door import call

PLACES = {"a": np.array([0.1, 0.0, 0.05]), "b": np.array([-0.1, 0.1, 0.07]), "c": np.array([0.0, -0.15, 0.04]),
          "d": np.array([0.2, 0.2, 0.05])}
CAMERAS = [look_at(0.6 * direction(azimuth, 0.8), np.zeros(3)) for azimuth in (0.0, 0.7, 2.0)]


def seen_from(camera, names="abcd", rng=None, places=PLACES) -> dict:
    """Where objects are in a camera's axes; with `rng` their ranges are wrong by 3 %."""
    local = {name: (places[name] - camera[:3, 3]) @ camera[:3, :3] for name in names}
    return {name: place * (1.0 if rng is None else 1 + rng.normal(0, 0.03)) for name, place in local.items()}


def apart_m(found, true_camera, places=PLACES) -> float:
    """The largest error of a map, whose axes are those of the true camera."""
    return max(float(np.linalg.norm(place - seen_from(true_camera, name, places=places)[name]))
               for name, place in found.places.items())


def test_exact_pictures_give_an_exact_map_and_the_cameras_motion():
    found = map_of([seen_from(camera) for camera in CAMERAS])
    assert apart_m(found, CAMERAS[0]) < 1e-9
    for k, camera in found.cameras.items():
        np.testing.assert_allclose(camera, np.linalg.inv(CAMERAS[0]) @ CAMERAS[k], atol=1e-9)
    assert found.apart_m == pytest.approx(0, abs=1e-9)


def test_it_says_how_far_the_pictures_disagree():
    rng = np.random.default_rng(0)
    found = map_of([seen_from(camera, rng=rng) for camera in CAMERAS])
    assert 0.005 < found.apart_m < 0.03
    assert apart_m(found, CAMERAS[0]) < 0.04
    assert "4 objects by 3 of 3 pictures" in found.worth(3)
    assert "nothing checks it" in found.worth(3)


def test_a_picture_that_cannot_be_placed_is_left_out_and_said():
    moved = {"a": PLACES["b"], "b": PLACES["c"], "c": PLACES["a"] + 0.2, "d": PLACES["d"]}
    line = {name: np.array([x, 0.0, 0.05]) for name, x in zip("abc", (-0.1, 0.0, 0.1), strict=True)}
    found = map_of([seen_from(CAMERAS[0], "abc"), seen_from(CAMERAS[1], "ab"),
                    seen_from(CAMERAS[2], "abc", places=moved)])
    assert list(found.cameras) == [0]
    assert found.why_not[1] == f"it has 2 objects in common with the map, and {LEAST_COMMON} are needed"
    assert "did something move?" in found.why_not[2]
    on_line = map_of([seen_from(camera, "abc", places=line) for camera in CAMERAS[:2]])
    assert "one line" in on_line.why_not[1]
    assert (map_of([{}, {}]).places, map_of([{}]).why_not) == ({}, {0: "it shows no known object"})


def test_a_picture_that_shares_nothing_with_the_first_is_placed_by_another():
    extra = PLACES | {"e": np.array([0.3, 0.0, 0.05]), "f": np.array([0.3, 0.2, 0.1])}
    pictures = [seen_from(CAMERAS[0], "abc"), seen_from(CAMERAS[2], "def", places=extra),
                seen_from(CAMERAS[1], "abcdef", places=extra)]
    found = map_of(pictures)
    assert sorted(found.places) == sorted(extra)
    np.testing.assert_allclose(found.cameras[1], np.linalg.inv(CAMERAS[0]) @ CAMERAS[2], atol=1e-9)


def test_rendered_pictures_of_which_nothing_is_known_give_a_map(monkeypatch, capsys, tmp_path):
    """The pictures' cameras are 0.6 and 1.4 rad apart; four objects stand on the table."""
    names = names_of("pantry")[:4]
    meshes = tuple(load_mesh("pantry", name) for name in names)
    world = World(meshes)
    at = dict(zip(names, ((0.12, 0.02), (-0.12, 0.08), (0.0, -0.16), (0.02, 0.18)), strict=True))
    places = {mesh.name: np.array([*at[mesh.name], mesh.size_m[2] / 2]) for mesh in meshes}
    world.place({name: (place, 0.4) for name, place in places.items()})
    cameras = [look_at(0.62 * direction(azimuth, 0.75), (0.0, 0.0, 0.05)) for azimuth in (0.2, 0.8, -0.4)]
    files = []
    for k, camera in enumerate(cameras):
        files.append(tmp_path / f"{k}.png")
        Image.fromarray(world.render(camera)).save(files[-1])
    world.close()
    intrinsics = ",".join(f"{x:g}" for x in INTRINSICS_PX)
    code, out, _ = call(monkeypatch, capsys, "see", *files, "--agent", "sceneccn", "--intrinsics", intrinsics, "--map",
                        tmp_path / "map.json")
    assert code == 0
    assert "map: 4 objects by 3 of 3 pictures" in out.replace("\n", " ")
    told = json.loads((tmp_path / "map.json").read_text())
    for name, place in told["objects"].items():
        assert np.linalg.norm(place - (places[name] - cameras[0][:3, 3]) @ cameras[0][:3, :3]) < 0.05
    for k, file in enumerate(files):
        camera, true = np.array(told["cameras"][str(file)]), np.linalg.inv(cameras[0]) @ cameras[k]
        assert np.linalg.norm(camera[:3, 3] - true[:3, 3]) < 0.08
        assert rotation_angle(camera[:3, :3], true[:3, :3]) < 0.15
