"""Reads the checkpoints of a training run. A part of a run is what one process trains."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from safetensors import safe_open
from safetensors.torch import load_file
from torch import Tensor, from_numpy

from saccade.shared.errors import SaccadeError
from saccade.shared.model.weights import Weights
from saccade.training.settings import WHOLE, TrainingConfig

CHECKPOINT = "checkpoint.safetensors"


def read_checkpoint(path: Path) -> tuple[dict, dict[str, Tensor]]:
    """The facts (such as the step) and the tensors of a checkpoint. Raises SaccadeError if it is damaged."""
    facts = _facts(path)
    with _whole(path):
        return facts, load_file(path)


def _facts(path: Path) -> dict:
    with _whole(path), safe_open(path, "pt") as file:
        return json.loads(file.metadata()["facts"])


@contextmanager
def _whole(path: Path) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # safetensors raises its own class for every kind of damage
        raise SaccadeError(f"checkpoint {path} is damaged ({error}): remove it to train this part anew") from error


def step_of(path: Path) -> int:
    """The step of a checkpoint, 0 if there is none. Raises SaccadeError if it is damaged."""
    return int(_facts(path)["step"]) if path.is_file() else 0


def model_of(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tensors of the networks in a checkpoint, without those of the optimiser."""
    return {k.removeprefix("model."): v for k, v in tensors.items() if k.startswith("model.")}


def finished(run_dir: Path, config: TrainingConfig, part: str) -> tuple[dict, dict[str, Tensor]]:
    """The facts and the networks' tensors of a finished part. Raises SaccadeError if the part is not finished."""
    path = run_dir / part / CHECKPOINT
    if not path.is_file():
        raise SaccadeError(f"{path} is missing: that part is not trained yet")
    facts, tensors = read_checkpoint(path)
    if facts["step"] != config.steps(part):
        raise SaccadeError(f"{part} is at step {facts['step']} of {config.steps(part)}: finish the training first")
    return facts, model_of(tensors)


def ccn_of(run_dir: Path, config: TrainingConfig, name: str) -> tuple[dict, dict[str, Tensor]]:
    """The facts and the tensors of an object's finished CCN, from this run or from the weights in `config.ccns`.

    Raises SaccadeError if there is no such CCN, or if the weights have another architecture.
    """
    if config.ccns is None:
        return finished(run_dir, config, name)
    return _in_weights(config, config.ccns, name, name, "ccns")


def extraction_before(config: TrainingConfig, part: str) -> dict[str, Tensor] | None:
    """The tensors of the networks that phase 2, of an object or of all, goes on from (`config.begin_with`), or None.

    Raises SaccadeError if there are no such networks, or if the weights have another architecture or other objects.
    """
    if config.begin_with is None:
        return None
    if part not in WHOLE:
        return _in_weights(config, config.begin_with, config.object_of(part), part, "begin_with")[1]
    held = Weights(Path(config.begin_with)).names
    if held != config.names:
        raise SaccadeError(f"weights {config.begin_with} are of {', '.join(held)}, not of {', '.join(config.names)} in "
                           "this order: name others (begin_with)")
    return _in_weights(config, config.begin_with, config.names[0], part, "begin_with")[1]


def _in_weights(config: TrainingConfig, folder: str, name: str, part: str, setting: str) -> \
        tuple[dict, dict[str, Tensor]]:
    weights = Weights(Path(folder))
    if weights.architecture != config.architecture:
        raise SaccadeError(f"weights {weights.folder} are of the architecture {weights.architecture!r}, not "
                           f"{config.architecture!r}: name others ({setting})")
    weights.cards_of((name,))
    told = weights.manifest
    facts = {"commit": told.get("commits", {}).get(part, "unknown"), "losses": told.get("losses", {}).get(part, {})}
    return facts, {key: from_numpy(array) for key, array in weights.state(part).items()}
