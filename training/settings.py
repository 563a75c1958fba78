"""The settings of a training run. They are typed, saved with the run, and the same for every process of the run."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from saccade.shared.config import MAX_FILE_BYTES, Section, checked
from saccade.shared.errors import SaccadeError
from saccade.shared.files import parse_json, read_text
from saccade.shared.model.weights import Architecture

EXTRACTION = "extraction"  # name of a part
WHOLE = ("posecnn", "lexa")  # architectures of one part, which has the same name
# Default settings for the paper's networks. Batches and rates are the paper's (appendix C), but there are fewer steps:
# the paper's 5,000 epochs of 450 views are 15,000 and 25,000 steps.
PAPER = {"steps_ccn": 5_000, "steps_extraction": 6_600, "batch_ccn": 150, "batch_extraction": 100,
         "rate_ccn": 5e-4, "rate_extraction": 1.5e-3}

# The defaults of PoseCNN. It has one network for all objects, which counts as phase 2.
POSECNN = {"steps_extraction": 8_000, "batch_extraction": 16, "rate_extraction": 1e-3}
# The defaults of LEXA: a batch is pieces of 16 images.
LEXA = {"steps_extraction": 9_000, "batch_extraction": 18, "rate_extraction": 1e-3, "live_every": 12,
        "checkpoint_every": 1_000}
# The defaults of the networks that know no object by name. The proposer counts as phase 2, the two others as phase 1.
OPEN = {"views": 400, "steps_ccn": 6_000, "steps_extraction": 4_000, "batch_ccn": 80, "batch_extraction": 16,
        "rate_ccn": 1.2e-3, "rate_extraction": 1.5e-3}
OPEN_PARTS = ("proposer", "encoder", "comparer")
DEFAULTS: dict[str, dict[str, Any]] = {"paper": PAPER, "posecnn": POSECNN, "lexa": LEXA, "open": OPEN}
OF_OTHERS = ("architecture", "kl_extraction", "guide_extraction", "ccns", "begin_with", "symmetric", "live_every",
             "networks", "scans", "held_out", "groceries", "tables")


class TrainingConfig(Section):
    """The settings of a training run.

    `names` are the objects that the networks learn. `steps_*` are the optimisation steps of the two phases. `crops`
    says what the CCNs are trained on: crops that are as wrong as the detector's, or, for comparison, clean views.

    With `architecture` "paper" the paper's own networks are trained as the paper describes; some settings then have
    other defaults. Four settings belong to this architecture. `kl_extraction` is the weight of the two KL terms in
    phase 2, once they count. `guide_extraction` is the weight, at the start, of the errors of centre and scale
    themselves. The paper uses only the error of the crop; with the guide fewer steps are needed to find the object.
    `ccns` is a folder of weights whose CCNs of these objects are used unchanged, so that only phase 2 is trained.
    `begin_with` is a folder of weights, and phase 2 goes on from its networks (PoseCNN too).

    With "posecnn" there is one network. `symmetric` are the objects whose rotation has the loss for symmetric objects.

    With "lexa" an episode of 100 steps is lived through every `live_every` steps of learning.

    With "open" there are three networks that know no object, and a bank of views for each object of the set. They are
    trained on the set's objects, on the meshes in the folders `scans` (each in a folder of its own), but for those that
    are `held_out` to evaluate on, on `groceries` made by code, and on rendered `tables`. With `networks`, a folder of
    weights beside the new ones, its networks are used unchanged, and only the banks are made.

    If the architecture is "default", the settings that only others have are not saved.
    """

    objects: str = "pantry"
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
    guide_extraction: float = Field(1000.0, ge=0)
    ccns: str | None = None
    begin_with: str | None = None
    symmetric: tuple[str, ...] = ()
    live_every: int = Field(20, ge=1)
    networks: str | None = None
    scans: tuple[str, ...] = ()
    held_out: tuple[str, ...] = ()
    groceries: int = Field(800, ge=0, le=10_000)
    tables: int = Field(6_000, ge=1, le=100_000)

    @model_validator(mode="before")
    @classmethod
    def _defaults(cls, given: Any) -> Any:
        return {**DEFAULTS.get(str(given.get("architecture")), {}), **given} if isinstance(given, dict) else given

    @model_serializer(mode="wrap")
    def _tree(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        tree = handler(self)
        if self.architecture == "default":
            for name in OF_OTHERS:
                del tree[name]
        return tree

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts of the run. Each part is trained by one process."""
        if self.architecture == "paper":
            return (*(() if self.ccns else self.names), *(f"{name}.{EXTRACTION}" for name in self.names))
        if self.architecture in WHOLE:
            return (self.architecture,)
        if self.architecture == "open":
            return () if self.networks else OPEN_PARTS
        return (EXTRACTION, *self.names)

    def is_extraction(self, part: str) -> bool:
        """Whether a part belongs to phase 2."""
        return part.rpartition(".")[2] in (EXTRACTION, OPEN_PARTS[0], *WHOLE)

    def needs(self, part: str) -> str | None:
        """The part that must be finished before this one begins, or None.

        The paper's phase 2 needs the finished CCN of its object, and the comparer needs the encoder.
        """
        if self.architecture == "open":
            return "encoder" if part == "comparer" else None
        name = self.object_of(part)
        return name if name != part and not self.ccns else None

    def object_of(self, part: str) -> str:
        """The object of a part of the paper's networks, which is called NAME or NAME.extraction."""
        return part.removesuffix(f".{EXTRACTION}")

    def steps(self, part: str) -> int:
        """The number of optimisation steps of a part."""
        return self.steps_extraction if self.is_extraction(part) else self.steps_ccn


def settings_from(values: dict[str, Any]) -> TrainingConfig:
    """Creates the settings from values. Raises SaccadeError, with the name of the key, if one is not valid."""
    return checked(TrainingConfig, values, "training setting {} (see training/settings.py)")


def load_settings(run_dir: Path) -> TrainingConfig:
    """Reads the settings of a run from its folder. Raises SaccadeError if there are none."""
    path = run_dir / "training.json"
    if not os.path.isfile(path):
        raise SaccadeError(f"{path} is missing: not the folder of a training run")
    need = "name another folder, or remove this one to train anew"
    text = read_text(path, "training settings", need, MAX_FILE_BYTES)
    try:
        tree = parse_json(text)
    except ValueError as error:
        raise SaccadeError(f"training settings {path} are damaged ({error}): {need}") from error
    return checked(TrainingConfig, tree, f"training setting {{}} in {path}")
