"""What perception makes of one image, whichever the networks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


def bits(masks: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Masks [K, M, M], their rows packed into bytes [K, M, B]."""
    return np.packbits(masks, axis=-1)


@dataclass(frozen=True)
class Seen:
    """What the networks made of one image, for K objects: see `Percept` for the units."""

    presence: NDArray[np.float64]
    pixel: NDArray[np.float64]
    pixel_std: NDArray[np.float64]
    scale: NDArray[np.float64]
    log_scale_std: NDArray[np.float64]
    latent_mean: NDArray[np.float32]
    latent_std: NDArray[np.float32]
    reconstruction_error: NDArray[np.float64]
    mask_bits: NDArray[np.uint8]
