"""Render and compare: the pose of every object from its mesh, as an engineer would estimate it today.

It is of the kind of MegaPose and FoundationPose, without their learned parts. A detector finds the objects; it is
Saccade's own (`SceneCCN.find`), as those systems also take one. Each crop is compared with templates, which are renders
of the mesh from directions all around. The best ones are refined: the mesh is rendered from directions and ranges
nearby, and what resembles the crop most is kept.

`--set services.perception=saccade.services.perception.templates`; it needs the meshes and OpenGL.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray

from saccade.services.perception.core import SERVICE, Perception, SceneCCN
from saccade.services.perception.seen import Seen
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.model.weights import ObjectCard, Weights
from saccade.shared.render.objects import load_mesh
from saccade.shared.render.world import World
from saccade.shared.world.geometry import (
    REFERENCE_RANGE_M,
    direction,
    fibonacci_hemisphere,
    look_at,
    pixel_rays,
    pose,
    wrap,
)
from saccade.shared.world.windows import CROP_PX, upright

__all__ = ["SERVICE", "TemplateMatcher", "build"]

TEMPLATES = 400  # of each object, on the upper hemisphere
COARSE_PX = 32  # side of crops and templates when all are compared
HYPOTHESES = 5  # how many of the best templates are refined a little; the best of these is refined further
STEPS_RAD = (0.08, 0.04, 0.02)  # of the refinement
STEP_LOG_RANGE = 0.5  # of the refinement, as a share of the step in radians
BESIDE = 0.1  # weight of a pixel that the mask says shows something else, which may hide the object
WORTH_A_LOOK = 0.3  # an object with a smaller presence gets no pose


@dataclass(frozen=True)
class View:
    """How an object is seen: from which direction (rad, in its own frame) and range, and how much this differs from
    the crop (mean squared difference of the pixels)."""

    azimuth: float
    elevation: float
    range_m: float
    difference: float = np.inf


class TemplateMatcher:
    """Estimates the poses of K objects of a set. Raises SaccadeError if a mesh or OpenGL is missing."""

    def __init__(self, weights: Weights, objects: str, names: tuple[str, ...], passes: int):
        if weights.architecture != "default":
            raise SaccadeError(f"weights {weights.folder} are of the architecture {weights.architecture!r}: to render "
                               "and compare, the detector of the default architecture is needed")
        self.names, self.detector = names, SceneCCN(weights, names, passes)
        self.world = World(tuple(load_mesh(objects, name) for name in names), size_px=CROP_PX)
        self.world.show_table(False)
        self.azimuth, self.elevation = fibonacci_hemisphere(TEMPLATES)
        self.templates = [self._templates(card) for card in self.detector.cards]

    def _templates(self, card: ObjectCard) -> NDArray[np.float32]:
        """The renders of an object from all directions, small and flat [N, 3 * 32 * 32]."""
        renders = np.stack([self._render(card, View(a, e, REFERENCE_RANGE_M), REFERENCE_RANGE_M)
                            for a, e in zip(self.azimuth, self.elevation, strict=True)])
        return _coarse(renders)

    def _render(self, card: ObjectCard, view: View, crop_range_m: float) -> NDArray[np.float32]:
        """A view of the object on black [3, 64, 64], in a crop that covers the object's crop side at `crop_range_m`."""
        focal = CROP_PX * crop_range_m / card.crop_side_m
        self.world.set_intrinsics((focal, focal, CROP_PX / 2, CROP_PX / 2))
        self.world.place({card.name: (np.zeros(3), 0.0)})
        camera = look_at(view.range_m * direction(view.azimuth, view.elevation), np.zeros(3))
        return self.world.render(camera).transpose(2, 0, 1).astype(np.float32) / 255.0

    def see(self, rgb: NDArray[np.uint8], intrinsics_px: ArrayLike, up: ArrayLike,
            depth_m: NDArray[np.float32] | None = None, *, alone: bool = False) -> Seen:
        """Infers all objects from an image [H, W, 3]. `up` [3] is the direction of up in the camera's frame. The depth
        is not used."""
        found = self.detector.find(rgb, intrinsics_px, up)
        window, kinds = found.window, (*range(len(self.names)), *found.kinds)
        with torch.inference_mode():
            crops, masks = (x.numpy() for x in found.cropper.cut(window))
        range_m = REFERENCE_RANGE_M / window.scales
        views = [self._estimate(k, crops[row], masks[row], range_m[row]) if found.presence[row] > WORTH_A_LOOK
                 else View(0.0, 0.0, range_m[row]) for row, k in enumerate(kinds)]
        rays = pixel_rays(window.pixels, intrinsics_px)
        seen_from = np.stack([look_at(direction(v.azimuth, v.elevation), np.zeros(3))[:3, :3].T for v in views])
        ranges = np.array([view.range_m for view in views])
        nothing = np.zeros((len(kinds), 0), dtype=np.float32)
        difference = np.array([v.difference if np.isfinite(v.difference) else 0.0 for v in views]) * 3 * CROP_PX ** 2
        return Seen(found.presence, window.pixels, found.side_px * found.deviation[:, :2].mean(1),
                    REFERENCE_RANGE_M / ranges, found.deviation[:, 2], nothing, nothing, difference, found.mask_bits,
                    pose(upright(rays, up) @ seen_from, rays * ranges[:, None]), kinds=found.kinds)

    def _estimate(self, k: int, crop: NDArray[np.float32], mask: NDArray[np.float32], range_m: float) -> View:
        """The view that resembles a crop [3, 64, 64] of object number `k` most, where the mask [1, 64, 64] shows it."""
        card, templates = self.detector.cards[k], self.templates[k]
        masked, weight = crop * mask, BESIDE + (1 - BESIDE) * mask

        def compared(view: View) -> View:
            difference = weight * (self._render(card, view, range_m) - masked) ** 2
            return replace(view, difference=float(difference.mean()))

        weighted = _coarse(np.repeat(weight, 3, axis=0)[None])[0]
        score = templates ** 2 @ weighted - 2 * templates @ (weighted * _coarse(masked[None])[0])
        best = np.argsort(score)[:HYPOTHESES]
        views = [compared(View(float(self.azimuth[n]), float(self.elevation[n]), range_m)) for n in best]
        first, *finer = STEPS_RAD
        view = min((_refined(view, first, compared) for view in views), key=lambda v: v.difference)
        for step in finer:
            view = _refined(view, step, compared)
        return view


def _refined(view: View, step_rad: float, compared) -> View:
    """The best of a view and its neighbours at one step in azimuth, elevation and range."""
    turn = step_rad / max(float(np.cos(view.elevation)), 0.2)
    zoom = float(np.exp(STEP_LOG_RANGE * step_rad))
    around = [replace(view, azimuth=float(wrap(view.azimuth + sign * turn))) for sign in (-1, 1)]
    around += [replace(view, elevation=float(np.clip(view.elevation + sign * step_rad, 0.0, np.pi / 2 - 1e-3)))
               for sign in (-1, 1)]
    around += [replace(view, range_m=view.range_m * zoom ** sign) for sign in (-1, 1)]
    return min([view, *map(compared, around)], key=lambda v: v.difference)


def _coarse(images: NDArray[np.float32]) -> NDArray[np.float32]:
    """Images [N, 3, 64, 64] as small, flat ones [N, 3 * 32 * 32]."""
    small = F.avg_pool2d(torch.from_numpy(images), CROP_PX // COARSE_PX)
    return small.flatten(1).numpy()


def build(config: Config) -> Perception:
    """Creates the core from a run's configuration. Raises SaccadeError if the weights or the meshes do not serve its
    objects."""
    weights = Weights(config.weights)
    return Perception(lambda names: TemplateMatcher(weights, config.scene.objects, names, config.perception.passes),
                      config.names)
