"""Folders of images, pose files and what a refusal says: for the tests of the camera."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from saccade.shared.errors import SaccadeError
from saccade.shared.render.objects import load_mesh, names_of
from saccade.shared.render.world import World
from saccade.shared.world.geometry import direction, look_at

HERE = look_at([0.4, 0.1, 0.3], [0.0, 0.0, 0.05])
THERE = look_at([0.2, 0.4, 0.5], [0.0, 0.0, 0.05])
LENS_PX = (560.0, 560.0, 240.0, 240.0)  # wider than the one of the training
ON_TABLE = {"coffee_can": (0.14, 0.10), "cereal_box": (-0.14, 0.08), "squeeze_bottle": (0.02, -0.16)}


def folder_of(folder, names, size=(64, 48)):
    """Images whose every pixel is their number, in the order of `names`."""
    folder.mkdir(exist_ok=True)
    for k, name in enumerate(names):
        Image.new("RGB", size, (k, k, k)).save(folder / name)
    return folder


def line(world_from_camera=HERE, **key):
    return json.dumps({**key, "world_from_camera": np.asarray(world_from_camera).tolist()})


def tum(time_s, world_from_camera):
    numbers = [*world_from_camera[:3, 3], *Rotation.from_matrix(world_from_camera[:3, :3]).as_quat()]
    return " ".join(f"{x:.9f}" for x in (time_s, *numbers))


def written(path, *lines):
    path.write_text("\n".join(lines) + "\n")
    return path


def complaint(make, *arguments, **more):
    with pytest.raises(SaccadeError) as caught:
        make(*arguments, **more)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def dots(pixels, size):
    """White squares of 7x7 pixels, smooth to a part of a pixel, at `pixels` on black."""
    u, v = np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5
    image = np.zeros((size[1], size[0]))
    for x, y in pixels:
        image += np.clip(4 - np.abs(u - x), 0, 1) * np.clip(4 - np.abs(v - y), 0, 1)[:, None]
    return np.repeat((255 * image).round().astype(np.uint8)[..., None], 3, axis=2)


def centroid(image, near):
    """The centre of the light within 16 pixels of a pixel."""
    u, v = np.meshgrid(np.arange(480) + 0.5, np.arange(480) + 0.5)
    light = image[..., 0] * ((np.abs(u - near[0]) < 16) & (np.abs(v - near[1]) < 16))
    return np.array([(u * light).sum(), (v * light).sum()]) / light.sum()


def film(video, poses, views, rate_hz=10.0):
    """An MJPEG of the pantry objects in ON_TABLE, once around the table with a lens of LENS_PX, and its poses."""
    cv2 = pytest.importorskip("cv2")
    meshes = tuple(load_mesh("pantry", name) for name in names_of("pantry"))
    world = World(meshes, intrinsics_px=LENS_PX)
    world.place({mesh.name: ((*ON_TABLE[mesh.name], mesh.size_m[2] / 2), 0.7) for mesh in meshes
                 if mesh.name in ON_TABLE}, table_rgb=(120, 110, 100))
    eyes = 0.62 * direction(np.linspace(0, 2 * np.pi, views, endpoint=False), 0.75)
    path = look_at(eyes, np.array([0.0, 0.0, 0.05]))
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), rate_hz, (480, 480))
    for world_from_camera in path:
        writer.write(np.ascontiguousarray(world.render(world_from_camera)[..., ::-1]))
    writer.release()
    world.close()
    written(poses, *(line(world_from_camera, index=k) for k, world_from_camera in enumerate(path)))
    return {name: np.array([*xy, load_mesh("pantry", name).size_m[2] / 2]) for name, xy in ON_TABLE.items()}
