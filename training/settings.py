"""What a training run is: typed, saved with the run, the same for every process that takes part."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from saccade.shared.config import Section, checked
from saccade.shared.errors import SaccadeError
from saccade.shared.model.weights import Architecture

EXTRACTION = "extraction"
# What holds for the paper's networks unless told otherwise: its batches and rates (appendix C), but fewer steps: its
# 5,000 epochs of 450 views are 15,000 and 25,000.
PAPER = {"steps_ccn": 5_000, "steps_extraction": 6_000, "batch_ccn": 150, "batch_extraction": 100,
         "rate_ccn": 5e-4, "rate_extraction": 1e-4}


class TrainingConfig(Section):
    """`names`: objects that the networks shall know. `steps_*`: optimisation steps of the two phases. `crops`: what the
    CCNs see, views as wrong as the detector's crops or, for comparison, as they were rendered.

    `architecture` "paper": the paper's own networks, trained as it says; some settings then have other defaults.
    `kl_extraction`: weight of the two KL terms in its phase 2, once they count; `guide_extraction`: weight at the start
    of the error of centre and scale themselves, which the paper leaves to the crop's error alone: with it fewer steps
    find the object. `ccns`: a folder of weights of these objects whose CCNs are taken as they are, so that phase 2
    alone is trained. None of the four is written where the architecture is "default".
    """

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
    crops: Literal["as_detected", "clean"] = "as_detected"
    architecture: Architecture = "default"
    kl_extraction: float = Field(1.0, ge=0)
    guide_extraction: float = Field(300.0, ge=0)
    ccns: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _defaults(cls, given: Any) -> Any:
        return {**PAPER, **given} if isinstance(given, dict) and given.get("architecture") == "paper" else given

    @model_serializer(mode="wrap")
    def _tree(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        tree = handler(self)
        if self.architecture == "default":
            del tree["architecture"], tree["kl_extraction"], tree["guide_extraction"], tree["ccns"]
        return tree

    @property
    def parts(self) -> tuple[str, ...]:
        """The networks that are trained: one process each."""
        if self.architecture == "paper":
            return (*(() if self.ccns else self.names), *(f"{name}.{EXTRACTION}" for name in self.names))
        return (EXTRACTION, *self.names)

    def is_extraction(self, part: str) -> bool:
        """Whether a part is of phase 2."""
        return part.rpartition(".")[2] == EXTRACTION

    def needs(self, part: str) -> str | None:
        """The part that has to be finished before this one begins: the paper freezes an object's CCN in phase 2."""
        name = self.object_of(part)
        return name if name != part and not self.ccns else None

    def object_of(self, part: str) -> str:
        """The object of a part of the paper's: NAME or NAME.extraction."""
        return part.removesuffix(f".{EXTRACTION}")

    def steps(self, part: str) -> int:
        """Steps of one part."""
        return self.steps_extraction if self.is_extraction(part) else self.steps_ccn


def settings_from(values: dict[str, Any]) -> TrainingConfig:
    """The settings with these values. Raises SaccadeError that names the key."""
    return checked(TrainingConfig, values, "training setting {} (see training/settings.py)")


def load_settings(run_dir: Path) -> TrainingConfig:
    """The configuration saved in a run's folder."""
    path = run_dir / "training.json"
    if not path.is_file():
        raise SaccadeError(f"{path} is missing: not the folder of a training run")
    return TrainingConfig.model_validate_json(path.read_text())
