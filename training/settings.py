"""What a training run is: typed, saved with the run, the same for every process that takes part."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from shared.config import Section
from shared.errors import SaccadeError

EXTRACTION = "extraction"


class TrainingConfig(Section):
    """`names`: objects that the networks shall know. `steps_*`: optimisation steps of the two phases."""

    objects: Literal["pantry", "ycb"] = "pantry"
    names: tuple[str, ...]
    seed: int = Field(0, ge=0)
    views: int = Field(500, ge=20, le=5000)
    steps_ccn: int = Field(7_000, ge=1)
    steps_extraction: int = Field(5_000, ge=1)
    batch_ccn: int = Field(32, ge=4)
    batch_extraction: int = Field(24, ge=1)
    rate_ccn: float = Field(1e-3, gt=0)
    rate_extraction: float = Field(2e-3, gt=0)
    checkpoint_every: int = Field(500, ge=1)
    device: Literal["auto", "cpu", "cuda"] = "auto"

    @property
    def parts(self) -> tuple[str, ...]:
        """The networks that are trained, each independently of the others."""
        return (EXTRACTION, *self.names)

    def steps(self, part: str) -> int:
        """Steps of one part."""
        return self.steps_extraction if part == EXTRACTION else self.steps_ccn


def load_settings(run_dir: Path) -> TrainingConfig:
    """The configuration saved in a run's folder."""
    path = run_dir / "training.json"
    if not path.is_file():
        raise SaccadeError(f"{path} is missing: not the folder of a training run")
    return TrainingConfig.model_validate_json(path.read_text())
