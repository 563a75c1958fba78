"""Makes the landmarks of an object from its mesh: renders it from all around, and keeps what local features find."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from saccade.services.perception.landmark_fit import FEATURES, LandmarkFit
from saccade.services.perception.local_features import LocalFeatures
from saccade.shared.model.landmarks import PER_VIEW, VIEWS, Landmarks, packed
from saccade.shared.render.mesh import Mesh
from saccade.shared.render.world import World
from saccade.shared.world.geometry import fibonacci_sphere, look_at, pixel_rays, unit

SIDE_PX = 192  # of a view
RANGE = 4.0  # of the camera, in half diagonals of the object, between these ranges (m)
NEAREST_M, FARTHEST_M = 0.2, 2.0
FILLED = 0.92  # of the view: the ball around the object
BORDER_PX = 2  # so far from the outline the depth is that of the surface
BEHIND = 0.5  # grey
TRIED, SMALL_PX, NOISE = 15, 80, 0.02  # pictures in which landmarks are looked for again, their sides, and their noise


def landmarks_from(mesh: Mesh, features: LocalFeatures, count: int = VIEWS) -> Landmarks:
    """The landmarks of a mesh in `count` views. Raises SaccadeError if OpenGL does not work."""
    world = World((mesh,), size_px=SIDE_PX)
    world.show_table(False)
    radius = float(np.linalg.norm(mesh.size_m)) / 2
    range_m = float(np.clip(RANGE * radius, max(NEAREST_M, 1.5 * radius), max(FARTHEST_M, 1.5 * radius)))
    focal = FILLED * SIDE_PX / 2 * np.sqrt((range_m / radius) ** 2 - 1)
    intrinsics = (focal, focal, SIDE_PX / 2, SIDE_PX / 2)
    world.set_intrinsics(intrinsics)
    world.place({mesh.name: (np.zeros(3), 0.0)})
    cameras = [look_at(range_m * towards, np.zeros(3)) for towards in fibonacci_sphere(count)]
    landmarks = packed([_view(world, mesh.name, camera, intrinsics, features) for camera in cameras])
    usual = _found_again(world, LandmarkFit(landmarks), focal, range_m, features)
    world.close()
    return replace(landmarks, usual=usual)


def _found_again(world: World, fit: LandmarkFit, focal: float, range_m: float, features: LocalFeatures) -> float:
    """How many landmarks are found again, in the median of pictures from between the views that are as small and as
    noisy as those of a real object some way off."""
    rng, counts = np.random.default_rng(0), []
    for towards in unit(rng.normal(size=(TRIED, 3))):
        image = torch.from_numpy(world.render(look_at(range_m * towards, np.zeros(3))).copy()).permute(2, 0, 1)[None]
        small = F.interpolate(image.float() / 255.0, size=(SMALL_PX, SMALL_PX), mode="area")
        noise = torch.from_numpy(rng.normal(scale=NOISE, size=small.shape)).float()
        large = F.interpolate((small + noise).clamp(0, 1), size=(SIDE_PX, SIDE_PX), mode="bicubic")
        fitted = fit(features(large.clamp(0, 1), FEATURES)[0], focal, SIDE_PX)
        counts.append(0 if fitted is None else fitted.inliers)
    return float(np.median(counts))


def _view(world: World, name: str, camera: NDArray[np.float64], intrinsics: tuple[float, ...],
          features: LocalFeatures) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """The places [N, 3] (m, in the object's frame) and the descriptors [N, 64] of a view, the surest first."""
    mask = world.render_masks(camera)[name]
    image = np.where(mask[..., None], world.render(camera) / 255.0, BEHIND).astype(np.float32)
    depth = world.render_depth(camera)
    found = features(torch.from_numpy(image).permute(2, 0, 1)[None], 4 * PER_VIEW)[0]
    pixels = found.pixels.double().numpy()
    inside = _inside(mask)[tuple(pixels.astype(int).T[::-1])]
    pixels = pixels[inside]
    rays = pixel_rays(pixels, intrinsics)
    ranges = depth[tuple(pixels.astype(int).T[::-1])] / -rays[:, 2]
    places = (rays * ranges[:, None]) @ camera[:3, :3].T + camera[:3, 3]
    return places, found.descriptors.numpy()[inside]


def _inside(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The pixels of a mask that are not near its border."""
    inside = np.pad(mask, BORDER_PX)
    for axis in (0, 1):
        for shift in range(-BORDER_PX, BORDER_PX + 1):
            inside = inside & np.roll(np.pad(mask, BORDER_PX), shift, axis)
    return inside[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX]
