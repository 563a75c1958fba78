"""Trained weights: a folder of safetensors files in half precision, with a manifest that is verified on loading.

`manifest.json` says how the weights were made (data, seed, steps, losses, commit, where they were trained) and which
architecture they have (the default one if it names none). It also holds the measures of each object and the SHA-256 of
every file. Weights of the architecture "open" hold a bank for each object; the networks, which know no object, are in
the folder beside them that `networks` names.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from saccade.shared.config import WEIGHTS, Config, set_folder
from saccade.shared.errors import SaccadeError, is_text, told
from saccade.shared.files import MIB, parse_json, read_bytes, read_text, replace_all, writing
from saccade.shared.model.landmarks import FORM

if TYPE_CHECKING:
    from torch import nn

Architecture = Literal["default", "paper", "posecnn", "lexa", "open"]
OPEN = "open"  # architecture that needs no training for an object
WITH_LATENTS = ("default", "paper")  # architectures with a CCN for each object

MANIFEST = "manifest.json"
BANK = ".bank"  # ending of the names of files with banks, before their type
MAX_FILE_BYTES, MAX_MANIFEST_BYTES, MAX_HEADER_BYTES = 64 * MIB, 1 * MIB, 1 * MIB
MAX_SIDE_M, MAX_NAME = 10.0, 256
_NEED = "get them again or train anew"


@dataclass(frozen=True)
class ObjectCard:
    """What the agent knows of an object besides its networks: the size of its box [3] and the side of its crop, in
    metres."""

    name: str
    size_m: NDArray[np.float64]
    crop_side_m: float

    @property
    def radius_m(self) -> float:
        """Half the diagonal of the box, in metres."""
        return float(np.linalg.norm(self.size_m)) / 2


class Weights:
    """The weights in a folder. Raises SaccadeError if the manifest is missing or damaged, or names an unknown
    architecture."""

    def __init__(self, folder: Path):
        self.folder = folder
        path = folder / MANIFEST
        if not os.path.isfile(path):
            raise SaccadeError(f"weights {path} are missing: train them with `saccade train`, or name another folder")
        text = read_text(path, "weights manifest", _NEED, MAX_MANIFEST_BYTES)
        try:
            self.manifest = parse_json(text)
            self.cards = tuple(_card(name, card) for name, card in self.manifest["objects"].items())
            self.hashes: dict[str, str] = {_file_name(name): digest for name, digest in self.manifest["sha256"].items()}
            self.architecture: Architecture = self.manifest.get("architecture", "default")
            self.calibration: dict[str, float] = {
                name: _positive(value, name) for name, value in self.manifest.get("calibration", {}).items()}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise SaccadeError(f"weights manifest {path} is damaged ({error}): get it again or train anew") from error
        if self.architecture not in get_args(Architecture):
            raise SaccadeError(f"weights manifest {path} names an unknown architecture {told(self.architecture)}: "
                               "get a newer version of the program, or train anew")

    @property
    def networks(self) -> Weights:
        """The weights of the networks that all objects share. Raises SaccadeError if they are missing or damaged."""
        name = self.manifest.get("networks")
        if not isinstance(name, str):
            raise SaccadeError(f"weights manifest {self.folder / MANIFEST} names no networks: {_NEED}")
        beside = self.folder.parent / _file_name(name)
        shared = Weights(beside if beside.is_dir() else WEIGHTS / name)  # an own set's lie with the program
        if shared.architecture != self.architecture:
            raise SaccadeError(f"weights {shared.folder} are of the architecture {shared.architecture!r}, and those in "
                               f"{self.folder} need {self.architecture!r}: {_NEED}")
        return shared

    @property
    def basis(self) -> str:
        """What says which networks these are: a hash of the hashes of their files, and of that of the local features
        which banks hold and of the form in which they do."""
        others = f"{self.manifest.get('local_features', '')} {FORM}"
        return hashlib.sha256("".join([*sorted(self.hashes.values()), others]).encode()).hexdigest()

    @property
    def names(self) -> tuple[str, ...]:
        """The objects that these weights know."""
        return tuple(card.name for card in self.cards)

    def cards_of(self, names: tuple[str, ...]) -> tuple[ObjectCard, ...]:
        """Returns the cards in the order of `names`. Raises SaccadeError if an object has no weights."""
        known = {card.name: card for card in self.cards}
        for name in names:
            if name not in known:
                raise SaccadeError(f"object {name!r} has no weights in {self.folder}: train it with `saccade train`")
        return tuple(known[name] for name in names)

    def calibrated(self, names: tuple[str, ...], what: str, otherwise: float) -> NDArray[np.float64]:
        """Returns the calibration `what` of these objects [K]. An object without it gets `otherwise`."""
        return np.array([self.calibration.get(f"{name}.{what}", otherwise) for name in names])

    def state(self, stem: str, prefix: str = "") -> dict[str, NDArray[np.float32]]:
        """Returns the arrays of `<stem>.safetensors` whose names begin with `prefix`, by their names without it.

        The hash of the file is checked first. Raises SaccadeError if the file is missing or damaged, or if its hash is
        wrong.
        """
        with self._file(stem) as data:
            return {key.removeprefix(prefix): array for key, array in _arrays(data).items() if key.startswith(prefix)}

    def bank(self, name: str) -> dict[str, NDArray[Any]]:
        """Returns the arrays of an object's bank as they are in its file. Raises SaccadeError like `state`."""
        with self._file(f"{name}{BANK}") as data:
            _require_short_header(data)
            return dict(load(data))

    @contextmanager
    def _file(self, stem: str) -> Iterator[bytes]:
        """Reads a file and checks its hash. Whatever is wrong with its arrays within the context is a SaccadeError."""
        path = self.folder / f"{stem}.safetensors"
        if not os.path.isfile(path):
            raise SaccadeError(f"weights {path} are missing: {_NEED}")
        data = read_bytes(path, "weights", _NEED, MAX_FILE_BYTES)
        if hashlib.sha256(data).hexdigest() != self.hashes.get(path.name):
            raise SaccadeError(f"weights {path} do not match the hash in {MANIFEST}: get them again or train anew")
        try:
            yield data
        except (SafetensorError, ValueError, KeyError, TypeError) as error:  # even if the hash is right
            raise SaccadeError(f"weights {path} are damaged ({error}): {_NEED}") from error

    def fill(self, module: nn.Module, stem: str, prefix: str = "") -> nn.Module:
        """Loads `state(stem, prefix)` into a PyTorch module and returns the module in evaluation mode. Raises
        SaccadeError like `state`, and if the arrays do not fit the module."""
        import torch  # here, because belief and planner only need cards and arrays

        try:
            module.load_state_dict({key: torch.from_numpy(array) for key, array in self.state(stem, prefix).items()})
        except RuntimeError as error:
            raise SaccadeError(f"weights {self.folder / stem} are of another architecture: train anew") from error
        return module.eval()


def _arrays(data: bytes) -> dict[str, NDArray[np.float32]]:
    """Returns the arrays of a safetensors file in single precision. Raises ValueError, or what safetensors raises, if
    it is not valid."""
    _require_short_header(data)
    arrays = {}
    for key, array in load(data).items():
        if array.dtype.kind != "f":
            raise ValueError(f"array {told(key)} is of {array.dtype}, not of floating-point numbers")
        with np.errstate(over="ignore"):
            arrays[key] = array.astype(np.float32)
        if not np.isfinite(arrays[key]).all():
            raise ValueError(f"array {told(key)} has numbers that are not finite")
    return arrays


def _require_short_header(data: bytes) -> None:
    if int.from_bytes(data[:8], "little") > MAX_HEADER_BYTES:
        raise ValueError("its header is longer than any of ours")


def _card(name: str, card: Any) -> ObjectCard:
    size = card["size_m"]
    if not isinstance(size, list) or len(size) != 3:
        raise ValueError(f"size_m of {told(name)} is not three numbers")
    return ObjectCard(_file_name(name), np.array([_positive(side, f"size_m of {name}", MAX_SIDE_M) for side in size]),
                      _positive(card["crop_side_m"], f"crop_side_m of {name}", MAX_SIDE_M))


def _positive(value: Any, what: str, most: float = math.inf) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0 < value <= most or value == math.inf:
        raise ValueError(f"{told(what)} is {told(value)}, not a number above 0 and at most {most:g}")
    return float(value)


def _file_name(name: str) -> str:
    if not name or len(name) > MAX_NAME or not is_text(name) or "/" in name or "\\" in name:
        raise ValueError(f"{told(name)} cannot be the name of a file")
    return name


def weights_in_use(config: Config) -> Weights:
    """The weights that a configuration names. Raises SaccadeError if they are missing or damaged."""
    objects, is_open = told(config.scene.objects), config.perception.architecture == OPEN
    if config.perception.weights is not None:
        return Weights(config.weights)
    if set_folder(config.scene.objects) is None:
        return _built_in(config)
    learn = f"`saccade objects learn --set {config.scene.objects}`"
    if not (config.weights / MANIFEST).is_file():
        raise SaccadeError(f"object set {objects} is not learnt: {learn}" if is_open else
                           f"object set {objects} is one of your own, and this agent's networks know none such: add "
                           "`--agent open`")
    weights = Weights(config.weights)
    if is_open and weights.manifest.get("networks_sha256") != weights.networks.basis:
        raise SaccadeError(f"object set {objects} was learnt with other networks than these: {learn}")
    lacking = [name for name in config.scene.names or () if name not in weights.names]
    if is_open and lacking:
        raise SaccadeError(f"object {told(lacking[0])} of the set {objects} is not learnt: {learn}")
    return weights


def _built_in(config: Config) -> Weights:
    """The weights that come with a built-in set. Where they are missing, the line says how they are trained."""
    if not (config.weights / MANIFEST).is_file():
        raise SaccadeError(f"weights {config.weights / MANIFEST} are missing: train them with `saccade train --objects "
                           f"{config.scene.objects} --architecture {config.perception.architecture}`, or name others "
                           "with --weights")
    return Weights(config.weights)


def bank_file(name: str) -> str:
    """The name of the file with an object's bank."""
    return f"{name}{BANK}.safetensors"


def write_weights(folder: Path, states: Mapping[str, Mapping[str, ArrayLike]], cards: tuple[ObjectCard, ...],
                  facts: dict[str, Any], banks: Mapping[str, dict[str, NDArray[Any]]] | None = None,
                  kept: Mapping[str, str] | None = None) -> dict[str, str]:
    """Writes the states in half precision, the banks as they are, and the manifest with their hashes. `kept` are the
    hashes of files that belong to the weights and stay as they are. Returns all hashes, by file.

    Raises SaccadeError if this fails; weights that were there before then stay as they were.
    """
    files = {f"{stem}.safetensors": save({key: np.asarray(value).astype(np.float16, order="C")
                                          for key, value in state.items()}) for stem, state in states.items()}
    files |= {bank_file(name): save({key: np.ascontiguousarray(array) for key, array in arrays.items()})
              for name, arrays in (banks or {}).items()}  # safetensors writes an array's memory as it lies
    hashes = {**(kept or {}), **{name: hashlib.sha256(data).hexdigest() for name, data in files.items()}}
    objects = {card.name: {"size_m": [round(float(x), 6) for x in card.size_m], "crop_side_m": card.crop_side_m}
               for card in cards}
    manifest = {**facts, "objects": objects, "sha256": hashes}
    files[MANIFEST] = (json.dumps(manifest, indent=2) + "\n").encode()
    with writing(folder, "weights"):
        folder.mkdir(parents=True, exist_ok=True)
        replace_all(folder, files)
    return hashes
