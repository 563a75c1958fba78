"""Makes the landmarks of an object from its mesh: renders it from all around, and keeps what local features find."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion
from scipy.spatial import cKDTree

from saccade.services.perception.landmark_fit import FEATURES, LandmarkFit
from saccade.services.perception.local_features import LocalFeatures
from saccade.shared.model.landmarks import DESCRIPTOR, MOST, SIDES, Landmarks, coded
from saccade.shared.render.mesh import Mesh
from saccade.shared.render.world import World
from saccade.shared.world.geometry import fibonacci_sphere, look_at, pixel_rays, unit

VIEWS = 160  # from all around, from afar and from near, each as it is and as a small, noisy picture shows it
SIDE_PX = 256  # of a view
SMALL_PX, NOISE = 100, 0.01  # sides of a small picture, and its noise
PER_VIEW = 250  # places in each view: the surest ones
TOGETHER_PX, ALIKE = 2.0, 0.85  # places so near, with descriptors whose product is so large, are one landmark
FACES = 12  # that have about as many landmarks among the first ones
OFTEN = 3  # a landmark is found in so many pictures, or it is not kept
RANGE = 4.0  # of the camera, in half diagonals of the object, between these ranges (m)
NEAREST_M, FARTHEST_M = 0.2, 2.0
FILLED = 0.92  # of the view from afar: the ball around the object
NEAR, NEAR_M = 1.7, 0.06  # half diagonals, or so far from the ball around the object: where a near camera is
NEAR_TANGENT = 0.42  # of half the angle of a near view: about that of the camera
BORDER_PX = 2  # so far from the outline the depth is that of the surface
BEHIND = 0.5  # grey
TRIED, TRIED_PX, TRIED_NOISE = 15, 80, 0.02  # pictures in which landmarks are looked for again, sides, and noise


class Places(NamedTuple):
    """Places [N, 3] (m, in the object's frame) with their descriptors [N, 64], seen by a camera in a direction [3]."""

    points_m: NDArray[np.float64]
    descriptors: NDArray[np.float32]
    towards: NDArray[np.float64]


def landmarks_from(mesh: Mesh, features: LocalFeatures, count: int = VIEWS) -> Landmarks:
    """The landmarks of a mesh in `count` views. Raises SaccadeError if OpenGL does not work."""
    world = World((mesh,), size_px=SIDE_PX)
    world.show_table(False)
    world.place({mesh.name: (np.zeros(3), 0.0)})
    radius = float(np.linalg.norm(mesh.size_m)) / 2
    far_m = float(np.clip(RANGE * radius, max(NEAREST_M, 1.5 * radius), max(FARTHEST_M, 1.5 * radius)))
    far_focal = FILLED * SIDE_PX / 2 * np.sqrt((far_m / radius) ** 2 - 1)
    rng, views = np.random.default_rng(0), []
    for range_m, focal in ((max(NEAR * radius, radius + NEAR_M), SIDE_PX / 2 / NEAR_TANGENT), (far_m, far_focal)):
        intrinsics = (focal, focal, SIDE_PX / 2, SIDE_PX / 2)
        world.set_intrinsics(intrinsics)
        for towards in fibonacci_sphere(count):
            camera = look_at(range_m * towards, np.zeros(3))
            views += _views(world, mesh.name, camera, intrinsics, features, rng)
    landmarks = merged(views, TOGETHER_PX * 2 * radius / (FILLED * SIDE_PX))
    usual = _found_again(world, LandmarkFit(landmarks), far_focal, far_m, features)
    world.close()
    return replace(landmarks, usual=usual)


def _found_again(world: World, fit: LandmarkFit, focal: float, range_m: float, features: LocalFeatures) -> float:
    """How many landmarks are found again, in the median of pictures from between the views that are as small and as
    noisy as those of a real object some way off."""
    rng, counts = np.random.default_rng(0), []
    for towards in unit(rng.normal(size=(TRIED, 3))):
        image = torch.from_numpy(world.render(look_at(range_m * towards, np.zeros(3))).copy()).permute(2, 0, 1)[None]
        small = _small(image.float() / 255.0, TRIED_PX, TRIED_NOISE, rng)
        fitted = fit(features(small, FEATURES)[0], focal, SIDE_PX)
        counts.append(0 if fitted is None else fitted.inliers)
    return float(np.median(counts))


def _small(image: torch.Tensor, side_px: int, noise: float, rng: np.random.Generator) -> torch.Tensor:
    """An image [1, 3, H, H] as a small, noisy picture shows it, enlarged again."""
    small = F.interpolate(image, size=(side_px, side_px), mode="area")
    small = small + torch.from_numpy(rng.normal(scale=noise, size=small.shape)).float()
    return F.interpolate(small.clamp(0, 1), size=image.shape[2:], mode="bicubic").clamp(0, 1)


def _views(world: World, name: str, camera: NDArray[np.float64], intrinsics: tuple[float, ...],
           features: LocalFeatures, rng: np.random.Generator) -> list[Places]:
    """The places in a view as it is, and in a small picture of it, the surest first."""
    mask = world.render_masks(camera)[name]
    image = np.where(mask[..., None], world.render(camera) / 255.0, BEHIND).astype(np.float32)
    depth, inside = world.render_depth(camera), _inside(mask)
    sharp = torch.from_numpy(image).permute(2, 0, 1)[None]
    views = []
    for found in features(torch.cat([sharp, _small(sharp, SMALL_PX, NOISE, rng)]), 4 * PER_VIEW):
        pixels = found.pixels.double().numpy()
        kept = np.flatnonzero(inside[tuple(pixels.astype(int).T[::-1])])[:PER_VIEW]
        pixels = pixels[kept]
        rays = pixel_rays(pixels, intrinsics)
        ranges = depth[tuple(pixels.astype(int).T[::-1])] / -rays[:, 2]
        points = (rays * ranges[:, None]) @ camera[:3, :3].T + camera[:3, 3]
        views.append(Places(points, found.descriptors.numpy()[kept], unit(camera[:3, 3])))
    return views


def merged(views: list[Places], together_m: float) -> Landmarks:
    """The landmarks that are found in several views, each in the middle of its places, with its mean descriptor."""
    points, descriptors = np.concatenate([v.points_m for v in views]), np.concatenate([v.descriptors for v in views])
    of = _groups(points, descriptors, together_m)
    counts = np.bincount(of)
    middle = np.stack([np.bincount(of, column) for column in points.T], 1) / np.maximum(counts, 1)[:, None]
    mean = np.zeros((len(counts), DESCRIPTOR), dtype=np.float32)
    np.add.at(mean, of, descriptors)
    towards = np.stack([view.towards for view in views])
    side = np.repeat((towards @ fibonacci_sphere(SIDES).T).argmax(1), [len(view.points_m) for view in views])
    seen = np.zeros((SIDES, len(counts)), dtype=bool)
    seen[side, of] = True
    kept = np.argsort(-counts, kind="stable")
    kept = kept[counts[kept] >= OFTEN]
    kept = kept[_even(seen[:, kept])][:MOST]
    return Landmarks(middle[kept].astype(np.float32), coded(unit(mean[kept]).astype(np.float32)), seen[:, kept])


def _even(seen: NDArray[np.bool_]) -> NDArray[np.intp]:
    """An order of N landmarks, of which the earlier are the better, so that the first ones lie on all faces of the
    object. `seen` [SIDES, N] says from where they are seen."""
    faces = (fibonacci_sphere(FACES) @ (seen.T @ fibonacci_sphere(SIDES)).T).argmax(0)
    rank = np.zeros(len(faces), dtype=np.intp)
    for face in range(FACES):
        rank[faces == face] = np.arange((faces == face).sum())
    return np.argsort(rank, kind="stable")


def _groups(points_m: NDArray[np.float64], descriptors: NDArray[np.float32], together_m: float) -> NDArray[np.intp]:
    """To which landmark each of N places belongs [N]. Those with the most alike ones around them come first."""
    pairs = cKDTree(points_m).query_pairs(together_m, output_type="ndarray") if len(points_m) else np.zeros((0, 2), int)
    pairs = pairs[(descriptors[pairs[:, 0]] * descriptors[pairs[:, 1]]).sum(1) > ALIKE]
    both = np.concatenate([pairs, pairs[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    counts = np.bincount(both[:, 0], minlength=len(points_m))
    neighbours = np.split(both[:, 1], np.cumsum(counts)[:-1])
    of, groups = np.full(len(points_m), -1), 0
    for place in np.argsort(-counts, kind="stable"):
        if of[place] < 0:
            near = neighbours[place]
            of[near[of[near] < 0]] = groups
            of[place] = groups
            groups += 1
    return of


def _inside(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The pixels of a mask that are not near its border, along rows and columns."""
    cross = np.zeros((2 * BORDER_PX + 1,) * 2, dtype=bool)
    cross[BORDER_PX] = cross[:, BORDER_PX] = True
    return np.asarray(binary_erosion(mask, cross))
