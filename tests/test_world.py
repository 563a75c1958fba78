"""What MuJoCo renders against independent geometry: projected vertices, and rays cast on the triangles with NumPy."""

from __future__ import annotations

import ctypes.util

import numpy as np
import pytest

from saccade.shared.errors import SaccadeError
from saccade.shared.render.mesh import Mesh
from saccade.shared.render.objects import load_mesh, names_of, ycb_folder
from saccade.shared.render.opengl import choose_backend
from saccade.shared.render.world import FAR_M, World
from saccade.shared.world.geometry import INTRINSICS_PX, look_at, pixel_rays, project

TABLE_RGB = (37, 201, 118)
CAMERAS = (look_at([0.45, 0.05, 0.4], [0.0, 0.0, 0.05]), look_at([-0.25, 0.5, 0.2], [0.0, 0.0, 0.08]),
           look_at([0.02, -0.03, 0.6], [0.0, 0.0, 0.0]))


@pytest.fixture(scope="module", params=["pantry", "ycb"])
def world(request):
    """Two objects of a set, turned, on a coloured table."""
    if request.param == "ycb" and not ycb_folder().is_dir():
        pytest.skip(f"no YCB scans in {ycb_folder()}: set SACCADE_YCB to their folder")
    meshes = tuple(load_mesh(request.param, name) for name in names_of(request.param)[1:3])
    world = World(meshes)
    for_mesh = zip(meshes, ((-0.08, 0.06), (0.07, -0.05)), (0.7, -1.9), strict=True)
    world.place({m.name: ((x, y, m.size_m[2] / 2), yaw) for m, (x, y), yaw in for_mesh}, TABLE_RGB)
    yield world
    world.close()


def triangles_of(world: World) -> np.ndarray:
    """World coordinates [F, 3, 3] of all placed triangles."""
    parts = []
    for name, (center, yaw) in world.poses.items():
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        mesh = world.meshes[name]
        parts.append((mesh.vertices_m.astype(np.float64) @ turn.T + center)[mesh.faces])
    return np.concatenate(parts)


def cast(origin: np.ndarray, rays: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Distance [R] along each ray [R, 3] to the nearest triangle or the table; infinite where it meets neither."""
    edge1, edge2 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    to_origin = origin - triangles[:, 0]
    q = np.cross(to_origin, edge1)
    result = np.empty(len(rays))
    for index, ray in enumerate(rays):
        p = np.cross(ray, edge2)
        determinant = np.einsum("ij,ij->i", edge1, p)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.einsum("ij,ij->i", to_origin, p) / determinant
            v = q @ ray / determinant
            t = np.einsum("ij,ij->i", edge2, q) / determinant
        hit = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 0) & np.isfinite(t)
        table = -origin[2] / ray[2] if ray[2] < 0 else np.inf
        if np.isinf(table) or np.abs((origin + table * ray)[:2]).max() > 0.5:
            table = np.inf
        result[index] = min(t[hit].min(initial=np.inf), table)
    return result


def inner(mask: np.ndarray) -> np.ndarray:
    """The pixels of a mask whose neighbours are in it too: colours are blended along outlines."""
    padded = np.pad(mask, 2)
    return np.logical_and.reduce([padded[2 + y:482 + y, 2 + x:482 + x] for x in (-2, 0, 2) for y in (-2, 0, 2)])


@pytest.mark.parametrize("camera", CAMERAS, ids=["front", "side", "top"])
def test_depth_agrees_with_rays_cast_on_the_triangles(world, camera):
    """Pixel (column, row) is the ray through (column + 0.5, row + 0.5). At an outline a texel's width may differ."""
    rng = np.random.default_rng(3)
    pixels = rng.integers(0, 480, (400, 2))
    local = pixel_rays(pixels + 0.5, INTRINSICS_PX)
    expected = cast(camera[:3, 3], local @ camera[:3, :3].T, triangles_of(world)) * -local[:, 2]
    depth = world.render_depth(camera)[pixels[:, 1], pixels[:, 0]]
    difference = np.abs(depth - np.minimum(expected, FAR_M))
    assert np.median(difference) < 2e-4
    assert (difference < 2e-3).mean() > 0.97


@pytest.mark.parametrize("camera", CAMERAS[:2], ids=["front", "side"])
def test_objects_appear_where_the_intrinsics_say(world, camera):
    """The outermost pixels of an object alone on the table are its outermost projected vertices, to a pixel."""
    poses = world.poses
    try:
        for name, pose in poses.items():
            world.place({name: pose}, TABLE_RGB)
            rows, columns = np.nonzero(world.render_masks(camera)[name])
            pixels, _ = project(triangles_of(world).reshape(-1, 3), camera, INTRINSICS_PX)
            seen = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
            expected = np.concatenate([pixels.min(0), pixels.max(0)])
            assert expected.min() > 0, "the object must lie within the image"
            assert expected.max() < 480
            assert np.abs(seen - expected).max() < 1.0
    finally:
        world.place(poses, TABLE_RGB)


def test_an_object_hides_what_is_behind_it(world):
    masks = world.render_masks(CAMERAS[1])
    assert all(mask.any() for mask in masks.values())
    assert not np.logical_and(*masks.values()).any()


def test_table_and_background_have_exact_colours(world):
    camera = look_at([0.45, 0.05, 0.2], [-0.5, 0.0, 0.2])
    image, depth, masks = world.render(camera), world.render_depth(camera), world.render_masks(camera)
    objects, far = np.logical_or(*masks.values()), depth >= FAR_M - 1e-3
    background, table = inner(far & ~objects), inner(~far & ~objects)
    assert background.sum() > 1000
    assert table.sum() > 1000
    assert (image[background] == 0).all()
    assert (image[table] == TABLE_RGB).all()


def test_shading_is_flat():
    """A plain cube has its texture's colour on every side, from everywhere."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float32)
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6],
                      [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]], dtype=np.int32)
    texture = np.full((16, 16, 3), (200, 90, 30), dtype=np.uint8)
    cube = Mesh("cube", signs * np.float32(0.04), np.full((8, 2), 0.5, np.float32), faces, texture)
    world = World((cube,))
    world.place({"cube": ((0.0, 0.0, 0.04), 0.5)}, (0, 0, 255))
    for camera in CAMERAS:
        image, mask = world.render(camera), world.render_masks(camera)["cube"]
        assert inner(mask).sum() > 500
        assert (image[inner(mask)] == (200, 90, 30)).all()
    world.close()


def test_rendering_is_deterministic(world):
    first = world.render(CAMERAS[0])
    world.render_depth(CAMERAS[1])
    world.render_masks(CAMERAS[2])
    np.testing.assert_array_equal(world.render(CAMERAS[0]), first)


def test_objects_that_are_not_placed_are_not_seen(world):
    poses = world.poses
    world.place({}, TABLE_RGB)
    empty = world.render(CAMERAS[2])
    world.place(poses, TABLE_RGB)
    assert (np.abs(empty.astype(int) - TABLE_RGB).max(-1) <= 1).mean() > 0.99


def test_objects_differ_from_every_side(world):
    """An azimuth that shows nothing could not be told: views 90 degrees apart differ clearly."""
    name, (center, _) = next(iter(world.poses.items()))
    poses = world.poses
    views = []
    for yaw in (0.0, np.pi / 2, np.pi, -np.pi / 2):
        world.place({name: (center, yaw)}, TABLE_RGB)
        views.append(world.render(look_at(np.add(center, (0.3, 0, 0.1)), center)).astype(float))
    world.place(poses, TABLE_RGB)
    for i in range(4):
        for j in range(i):
            assert np.abs(views[i] - views[j]).mean() > 1.0


def test_no_opengl_says_what_to_install(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: None)
    with pytest.raises(SaccadeError, match="install libosmesa6"):
        choose_backend()


@pytest.mark.parametrize(("library", "backend"), [("OSMesa", "osmesa"), ("EGL", "egl"), ("nvidia-eglcore", "egl")])
def test_the_backend_is_the_library_that_is_there(monkeypatch, library, backend):
    monkeypatch.setenv("MUJOCO_GL", "")
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: name if name == library else None)
    assert choose_backend() == backend


def test_the_users_backend_stands(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: None)
    assert choose_backend() == "glfw"
