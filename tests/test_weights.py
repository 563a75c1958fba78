"""Weights: what is written is read back; anything missing, damaged or of another shape is one clear line."""

import json

import numpy as np
import pytest
import torch

from saccade.services.perception.networks import Identity
from saccade.shared.config import WEIGHTS
from saccade.shared.errors import SaccadeError
from saccade.shared.model.generative_model import CCN, Transition
from saccade.shared.model.latent import PREFIX, LatentTransition
from saccade.shared.model.weights import MANIFEST, ObjectCard, Weights, write_weights

SHIPPED = [WEIGHTS / name for name in ("pantry", "ycb")]


@pytest.fixture
def folder(tmp_path):
    torch.manual_seed(0)
    write_weights(tmp_path, {"mug": {f"ccn.{k}": v for k, v in CCN().state_dict().items()}},
                  (ObjectCard("mug", np.array([0.08, 0.08, 0.1]), 0.16),), {"commit": "none"})
    return tmp_path


def test_weights_come_back_in_half_precision(folder):
    torch.manual_seed(0)
    original = CCN().transition
    weights = Weights(folder)
    read = weights.fill(Transition(), "mug", "ccn.transition.")
    for a, b in zip(original.parameters(), read.parameters(), strict=True):
        torch.testing.assert_close(a.half().float(), b)
    assert weights.cards_of(("mug",))[0].radius_m == pytest.approx(np.linalg.norm([0.08, 0.08, 0.1]) / 2)


def test_a_changed_byte_is_told(folder):
    path = folder / "mug.safetensors"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(SaccadeError, match="do not match the hash"):
        Weights(folder).state("mug")


def test_missing_manifest_file_and_object_are_told(folder):
    with pytest.raises(SaccadeError, match="no weights"):
        Weights(folder).cards_of(("teapot",))
    (folder / "mug.safetensors").unlink()
    with pytest.raises(SaccadeError, match="missing"):
        Weights(folder).state("mug")
    (folder / MANIFEST).unlink()
    with pytest.raises(SaccadeError, match="saccade train"):
        Weights(folder)


def test_a_transition_of_another_shape_is_told(tmp_path):
    state = {f"{PREFIX}layers.0.weight": np.zeros((4, 11)), f"{PREFIX}layers.0.bias": np.zeros(4)}
    write_weights(tmp_path, {"mug": state}, (ObjectCard("mug", np.ones(3), 0.16),), {})
    with pytest.raises(SaccadeError, match="mug are of another architecture"):
        LatentTransition(Weights(tmp_path), "mug")


@pytest.mark.parametrize("text", ["{", "[]", '{"objects": {"mug": {}}, "sha256": {}}', '{"objects": {}}'])
def test_a_damaged_manifest_is_told(folder, text):
    (folder / MANIFEST).write_text(text)
    with pytest.raises(SaccadeError, match="damaged"):
        Weights(folder)


def test_another_architecture_is_told(folder):
    with pytest.raises(SaccadeError, match="another architecture"):
        Weights(folder).fill(Identity(), "mug", "ccn.encoder.")


@pytest.mark.parametrize("folder", SHIPPED, ids=lambda p: p.name)
def test_shipped_weights_are_whole_small_and_say_where_they_come_from(folder):
    weights = Weights(folder)
    files = [folder / name for name in weights.hashes]
    assert len(files) == len(weights.names) + 1
    for path in files:
        weights.state(path.stem)
    assert sum(path.stat().st_size for path in files) <= 15e6
    facts = json.loads((folder / MANIFEST).read_text())
    for key in ("data", "training", "losses", "commits", "where_trained", "seconds"):
        assert facts[key]
    assert facts["training"]["seed"] is not None
