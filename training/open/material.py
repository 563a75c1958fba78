"""What the networks that know no names are trained on: views of many objects, and rendered tables."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from saccade.training.open.composer import CropMaker
from saccade.training.open.table_crops import TableCrops
from saccade.training.open.tiles import Tiles


@dataclass(frozen=True)
class Material:
    """The tiles of all objects; `real` are the numbers of the scanned ones, `made` those of groceries made by code,
    `held_numbers` those of scanned objects that are not trained on. `composed` and `tables` make crops to train on,
    `held_out` those to evaluate on."""

    tiles: list[Tiles]
    real: NDArray[np.int64]
    made: NDArray[np.int64]
    held_numbers: NDArray[np.int64]
    composed: CropMaker
    tables: TableCrops
    held_out: TableCrops

    def drawn(self, rng: np.random.Generator, real: float) -> int:
        """The number of an object to train on, a scanned one with the probability `real`."""
        known = self.real[~np.isin(self.real, self.held_numbers)]
        return int(rng.choice(known if rng.random() < real or not len(self.made) else self.made))
