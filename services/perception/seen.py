"""What perception infers from one image, with any of the two architectures of the networks."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

MOST = 6  # of a kind in one image
LIKELY = 0.5  # chosen: of the presence of the likeliest one of a kind


def bits(masks: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Packs masks [K, M, M] row by row into bytes [K, M, B]."""
    return np.packbits(masks, axis=-1)


@dataclass(frozen=True)
class Modes:
    """How an object may be turned: rotations camera_from_object [M, 3, 3], the likeliest first, their log probabilities
    [M], and the standard deviation of each (rad) [M]."""

    rotations: NDArray[np.float64]
    log_probability: NDArray[np.float64]
    deviation_rad: NDArray[np.float64]


@dataclass(frozen=True)
class Seen:
    """What the networks inferred about K objects from one image. `Percept` describes the fields and their units.

    Row k is of object k. Rows after the first K are further ones of the objects `kinds`.
    """

    presence: NDArray[np.float64]  # [K]
    pixel: NDArray[np.float64]  # [K, 2]
    pixel_std: NDArray[np.float64]  # [K]
    scale: NDArray[np.float64]  # [K]
    log_scale_std: NDArray[np.float64]  # [K]
    latent_mean: NDArray[np.float32]  # [K, L]
    latent_std: NDArray[np.float32]  # [K, L]
    reconstruction_error: NDArray[np.float64]  # [K]
    mask_bits: NDArray[np.uint8]  # [K, M, B], see `bits`
    camera_from_object: NDArray[np.float64] | None = None  # [K, 4, 4], of networks that estimate poses
    modes: list[Modes] = field(default_factory=list)  # K, of networks that infer more than one pose
    kinds: tuple[int, ...] = ()  # of the rows after the first K

    def rows_of(self, k: int) -> list[int]:
        """The rows of all that may be object k, the likeliest first."""
        first = len(self.presence) - len(self.kinds)
        rows = [k, *(first + n for n, kind in enumerate(self.kinds) if kind == k)]
        return sorted(rows, key=lambda row: -self.presence[row])

    def goal_row(self, k: int, middle_px: NDArray[np.float64]) -> int:
        """The row of object k that a goal image is of: of those that are likely the one nearest to its middle [2]."""
        rows = self.rows_of(k)
        likely = [row for row in rows if self.presence[row] >= LIKELY * self.presence[rows[0]]]
        return min(likely, key=lambda row: float(np.linalg.norm(self.pixel[row] - middle_px)))
