"""Weights: what is written is read back; anything missing, damaged or of another shape is one clear line."""

import errno
import hashlib
import json
import os
from pathlib import Path

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


def card(**changes):
    return {"size_m": [0.1, 0.1, 0.1], "crop_side_m": 0.2} | changes


def manifest(card_of_mug, name="mug", **more):
    return json.dumps({"objects": {name: card_of_mug}, "sha256": {}} | more)


@pytest.mark.parametrize("text", [
    manifest(card(size_m=["0.1", "0.1", "0.1"])), manifest(card(size_m=[float("nan"), 1, 1])),
    manifest(card(size_m=[0.1, 0.1])), manifest(card(size_m=[-0.1, 0.1, 0.1])), manifest(card(size_m=[1e300, 1, 1])),
    manifest(card(size_m=[[0.1], 0.1, 0.1])), manifest(card(size_m="abc")), manifest(card(size_m=[True, True, True])),
    manifest(card(size_m=[10 ** 400, 1, 1])), manifest(card(crop_side_m=0)), manifest(card(crop_side_m="0.2")),
    manifest(card(crop_side_m=float("inf"))), manifest([1]), manifest(card(), "../mug"), manifest(card(), "x" * 300),
    manifest(card(), "\x1b[31m"), manifest(card(), "\ud800"), manifest(card(), sha256={"/etc/passwd": "0"}),
    manifest(card(), sha256=["ab"]), manifest(card(), calibration={"a": "b"}), "[" * 10 ** 5, '{"a": 1, "a": 2}'])
def test_a_hostile_manifest_is_told(folder, text):
    (folder / MANIFEST).write_text(text)
    with pytest.raises(SaccadeError, match="is damaged") as caught:
        Weights(folder)
    assert str(caught.value).isprintable()


def test_a_manifest_is_a_text_of_some_size(folder):
    (folder / MANIFEST).write_bytes(b'{"\xff"}')
    with pytest.raises(SaccadeError, match="not a text in UTF-8"):
        Weights(folder)
    os.truncate(folder / MANIFEST, 2 ** 40)
    with pytest.raises(SaccadeError, match="is larger than 1 MiB"):
        Weights(folder)
    (folder / MANIFEST).write_text(manifest(card(), architecture=[[["paper"]]]))
    with pytest.raises(SaccadeError, match="unknown architecture"):
        Weights(folder)


def safetensors(header, data=b"", length=None):
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return (len(text) if length is None else length).to_bytes(8, "little") + text + data


def array(dtype="F32", shape=(2,), offsets=(0, 8)):
    return {"dtype": dtype, "shape": list(shape), "data_offsets": list(offsets)}


@pytest.mark.parametrize("data", [
    b"", b"abc", safetensors(b"", length=2 ** 60), safetensors({}, length=2 ** 64 - 1), safetensors(b"{" * 1000),
    safetensors({"a": array(), "b": array(offsets=(4, 12))}, bytes(12)), safetensors({"a": array(offsets=(0, 80))}),
    safetensors({"a": array(shape=(2 ** 40, 2 ** 40))}, bytes(8)), safetensors({"a": array("I64", (1,))}, bytes(8)),
    safetensors({"a": array("F99")}, bytes(8)), safetensors({"a": array("C64", (1,))}, bytes(8)),
    safetensors({"a": array("BF16", (4,))}, bytes(8)), safetensors({"a": array(shape=(3,))}, bytes(8)),
    safetensors({"a": array()}, np.array([np.nan, 1], np.float32).tobytes()),
    safetensors({"a": array("F64", (1,))}, np.array([1e300]).tobytes()), safetensors(b"\0" * 50)])
def test_damaged_weights_with_the_right_hash_are_told(folder, recwarn, data):
    """Whoever damages a file can write its hash, too."""
    (folder / "mug.safetensors").write_bytes(data)
    (folder / MANIFEST).write_text(manifest(card(), sha256={"mug.safetensors": hashlib.sha256(data).hexdigest()}))
    with pytest.raises(SaccadeError, match=r"mug.safetensors are damaged"):
        Weights(folder).state("mug")
    assert not recwarn.list


def test_weights_are_regular_files_of_some_size(folder):
    os.truncate(folder / "mug.safetensors", 2 ** 40)
    with pytest.raises(SaccadeError, match="is larger than 64 MiB"):
        Weights(folder).state("mug")


@pytest.mark.parametrize("changes", [{"layers.0.weight": (128,)}, {"layers.0.bias": (127,)}, {"layers.6.bias": ()},
                                     {"layers.0.weight": (128, 12)}])
def test_a_transition_whose_parts_do_not_fit_is_told(tmp_path, changes):
    """Before a run begins, not at its first step."""
    state = {f"{PREFIX}{key}": value.numpy() for key, value in CCN().transition.state_dict().items()}
    state |= {f"{PREFIX}{key}": np.zeros(shape) for key, shape in changes.items()}
    write_weights(tmp_path, {"mug": state}, (ObjectCard("mug", np.ones(3), 0.16),), {})
    with pytest.raises(SaccadeError, match="mug are of another architecture"):
        LatentTransition(Weights(tmp_path), "mug")


def test_weights_that_cannot_be_written_leave_the_old_ones(folder, monkeypatch):
    written, write = [], Path.write_bytes

    def fills_up(path, data):
        written.append(path.name)
        if len(written) > 1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", fills_up)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(SaccadeError, match="No space left"):
        write_weights(folder, {"mug": {"a": np.zeros(2)}}, (ObjectCard("mug", np.ones(3), 0.2),), {})
    assert len(written) == 2
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
