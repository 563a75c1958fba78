"""Weights that have learnt nothing, in the layout of trained ones."""

from __future__ import annotations

from pathlib import Path

import torch

from saccade.services.perception.networks import Extraction, Identity
from saccade.services.perception.posecnn import PoseNetwork
from saccade.shared.model.generative_model import CCN
from saccade.shared.model.weights import ObjectCard, write_weights
from saccade.shared.render.objects import load_mesh
from saccade.shared.render.views import crop_side_m


def write_random_weights(folder: Path, object_set: str, names: tuple[str, ...], architecture: str = "default") -> None:
    """The same weights at every call with these objects."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        if architecture == "posecnn":
            states = {"posecnn": PoseNetwork(len(names)).state_dict()}
        else:
            states = {"extraction": Extraction(len(names)).state_dict()}
            for name in names:
                states[name] = torch.nn.ModuleDict({"ccn": CCN(), "identity": Identity()}).state_dict()
    sizes = [load_mesh(object_set, name).size_m for name in names]
    cards = tuple(ObjectCard(name, size, crop_side_m(size)) for name, size in zip(names, sizes, strict=True))
    write_weights(folder, states, cards, {"data": "none: random", "architecture": architecture})
