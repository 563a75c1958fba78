"""What networks say about the objects in a photograph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from saccade.app.look.fitting import Fitted, run_lengths
from saccade.shared.world.images import Size
from saccade.shared.world.photographs import Photograph

SEEN_ABOVE = 0.5  # presence of an object that counts as seen


@dataclass(frozen=True)
class Sight:
    """What the networks say about one object in one photograph.

    `pixel` (u, v) is where its middle is, in pixels of the whole upright photograph. `view_deg` is the azimuth and the
    elevation of the camera around the object, None if the networks do not tell it. `grid` [M, M] are the truth values
    of its mask over the image that the networks took. `drawing` [64, 64, 3] is how they imagine it, None if they cannot
    draw.
    """

    name: str
    presence: float
    pixel: tuple[float, float]
    range_m: float
    view_deg: tuple[float, float] | None
    grid: NDArray[np.bool_]
    drawing: NDArray[np.uint8] | None

    @property
    def is_seen(self) -> bool:
        return self.presence > SEEN_ABOVE


@dataclass(frozen=True)
class Look:
    """A photograph, as networks took it, and what they say about every object, the surest first."""

    photo: Photograph
    fitted: Fitted
    sights: tuple[Sight, ...]

    def mask(self, sight: Sight, size_px: Size) -> NDArray[np.bool_]:
        """The mask [H, W] of an object over the photograph, if it is shown in the size (width, height)."""
        rows, columns = self.fitted.cells(len(sight.grid), size_px)
        mask: NDArray[np.bool_] = sight.grid[rows][:, columns]
        return mask

    def entries(self) -> list[dict[str, Any]]:
        """What the JSON file says about the photograph: one entry for each object."""
        width, height = self.photo.size_px
        found = []
        for sight in self.sights:
            counts = run_lengths(sight.grid, *self.fitted.cells(len(sight.grid), self.photo.size_px))
            azimuth_deg, elevation_deg = sight.view_deg or (None, None)
            found.append({"image": str(self.photo.path), "object": sight.name, "presence": sight.presence,
                          "pixel": list(sight.pixel), "range_m": sight.range_m, "azimuth_deg": azimuth_deg,
                          "elevation_deg": elevation_deg, "mask": {"size": [height, width], "counts": counts}})
        return found
