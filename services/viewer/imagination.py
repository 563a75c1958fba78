"""What the agent's networks see and draw: crops, their reconstructions, and the planned view.

The planned view is drawn object by object with the generative model (paper, section 3.2), and each drawing is placed
where the object would appear according to its belief.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from saccade.services.viewer.artists import ARTISTS
from saccade.services.viewer.layout import VIEW_PX
from saccade.shared.bus.messages import Belief, Frame, Percept
from saccade.shared.errors import SaccadeError
from saccade.shared.model.weights import Weights
from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX, REFERENCE_RANGE_M, project
from saccade.shared.world.windows import CROP_PX, Window

Image = NDArray[np.uint8]

DARK = 24  # of 255: a pixel of a drawn crop that is darker than this counts as background


def ring_of(window: Window, intrinsics_px: ArrayLike, up: ArrayLike) -> NDArray[np.float64]:
    """The frame of a window's only crop in the image: its corners [5, 2] in pixels, the first one repeated.

    `up` [3] is the direction of up in the camera's frame.
    """
    corners = window.pixels_of(2, intrinsics_px, up)[0]
    middle, reach = corners.mean((0, 1)), 2.0  # factor from the centres of 2x2 cells to the corners of the crop
    return middle + reach * (corners.reshape(4, 2)[[0, 1, 3, 2, 0]] - middle)


class Imagination:
    """What draws a run's objects.

    Raises SaccadeError if an object has no weights, if they do not match the manifest, or if they draw nothing.
    """

    def __init__(self, weights: Weights, names: tuple[str, ...]) -> None:
        self.cards = {card.name: card for card in weights.cards_of(names)}
        if weights.architecture not in ARTISTS:
            raise SaccadeError(f"networks of the architecture {weights.architecture!r} draw nothing")
        self._artists = {name: ARTISTS[weights.architecture](weights, self.cards[name]) for name in names}

    def window(self, percepts: list[Percept]) -> Window:
        """The crop windows of these percepts."""
        return Window(np.array([p.pixel for p in percepts]), np.array([p.scale for p in percepts]),
                      np.array([self.cards[p.object].crop_side_m for p in percepts]))

    def frame_of(self, percept: Percept) -> NDArray[np.float64]:
        """The frame of a percept's crop in the image: its corners [5, 2] in pixels, the first one repeated."""
        return ring_of(self.window([percept]), percept.intrinsics_px, percept.world_from_camera[2, :3])

    def crops(self, frame: Frame, percepts: list[Percept]) -> Image:
        """The crops that the networks see [K, 64, 64, 3], for K percepts. They are black outside the image."""
        up = frame.world_from_camera[2, :3]
        pixels = self.window(percepts).pixels_of(CROP_PX, frame.intrinsics_px, up)
        column, row = np.floor(pixels).astype(np.int64).transpose(3, 0, 1, 2)
        height, width = frame.rgb.shape[:2]
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        return np.where(inside[..., None], frame.rgb[row.clip(0, height - 1), column.clip(0, width - 1)], np.uint8(0))

    def reconstructions(self, percepts: list[Percept]) -> Image:
        """How the networks imagine what K percepts see [K, 64, 64, 3]."""
        drawn = [self._artists[percept.object].as_seen(percept) for percept in percepts]
        return np.array(drawn, np.uint8).reshape(-1, CROP_PX, CROP_PX, 3)

    def planned_view(self, viewpoint: NDArray[np.float64], beliefs: list[Belief], seen: dict[str, Percept]) -> Image:
        """How the objects of these beliefs would look from `viewpoint` [4, 4]: an image [240, 240, 3].

        `seen` holds, for each object, the last percept that saw it. An object without one is left out.
        """
        view = np.zeros((VIEW_PX, VIEW_PX, 3), np.uint8)
        scale = VIEW_PX / IMAGE_SIZE_PX
        intrinsics = np.array(INTRINSICS_PX) * scale
        center, depth = project(np.array([b.mean_m for b in beliefs]).reshape(-1, 3), viewpoint, intrinsics)
        order = [k for k in np.argsort(-depth) if depth[k] > 0 and beliefs[k].object in seen]  # the nearest last
        for k in order:
            drawn = self._artists[beliefs[k].object].moved(viewpoint, beliefs[k], seen[beliefs[k].object])
            away = np.linalg.norm(beliefs[k].mean_m - viewpoint[:3, 3])
            window = Window(center[k:k + 1], np.array([REFERENCE_RANGE_M / away]), np.array([drawn.side_m]))
            ring = ring_of(window, intrinsics, viewpoint[2, :3]).clip(0, VIEW_PX)
            (left, top), (right, bottom) = np.floor(ring.min(0)).astype(int), np.ceil(ring.max(0)).astype(int)
            grid = np.stack(np.meshgrid(np.arange(left, right), np.arange(top, bottom)), axis=-1)
            at = window.crop_of(grid.reshape(-1, 2) + 0.5, intrinsics, viewpoint[2, :3])[0].reshape(grid.shape)
            at = drawn.place(at)
            inside = np.asarray((np.abs(at) < 1).all(axis=-1))  # false for NaN: behind the crop's camera
            column, row = (np.where(inside[..., None], at + 1, 0) / 2 * CROP_PX).astype(np.int64).transpose(2, 0, 1)
            crop = drawn.crop[row, column]
            shown = inside & (crop.max(axis=-1) > DARK)
            view[top:bottom, left:right][shown] = crop[shown]
        return view
