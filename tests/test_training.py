"""Training on a few tiny steps: it learns, resumes exactly, exports what perception loads, and tells bad input."""

import json

import numpy as np
import pytest
import torch
from rich.console import Console

from saccade.services.perception.core import SceneCCN
from saccade.shared.errors import SaccadeError
from saccade.shared.model.weights import Weights
from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX
from saccade.tests.fakes.training import assert_same_checkpoint, interrupt_and_resume
from saccade.training.crops import CropComposer
from saccade.training.dataset import load_views
from saccade.training.frames import FrameComposer
from saccade.training.part import Trainer, pick_device
from saccade.training.precision import reduced_precision
from saccade.training.run import export, start, train
from saccade.training.settings import EXTRACTION, TrainingConfig
from saccade.training.strangers import recoloured
from saccade.training.tasks import CcnTask

NAMES = ("soup_can", "rice_box")
TINY = TrainingConfig(objects="pantry", names=NAMES, views=24, steps_ccn=4, steps_extraction=4, batch_ccn=8,
                      batch_extraction=4, checkpoint_every=2, device="cpu")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A whole tiny run, by processes, as a user would start it."""
    run_dir = tmp_path_factory.mktemp("run")
    with (run_dir / "printed.txt").open("w") as file:
        train(run_dir, TINY, jobs=2, console=Console(file=file, width=20))
    return run_dir


def test_what_is_no_terminal_gets_whole_lines(finished):
    lines = (finished / "printed.txt").read_text().splitlines()
    assert "views soup_can: 96 of 96" in lines  # 24 from each of four ranges
    assert any(line.startswith("soup_can: 4 of 4  ") for line in lines)
    assert len(lines) == len(set(lines))
    assert all(" of " in line for line in lines)


@pytest.mark.parametrize("part", [EXTRACTION, "soup_can"])
def test_an_interrupted_run_goes_on_exactly(finished, tmp_path, part):
    torch.set_num_threads(1)  # as the processes do: more threads add in another order
    (tmp_path / "views").symlink_to(finished / "views")
    start(tmp_path, TINY)
    interrupt_and_resume(tmp_path, part, before_step=3)  # after the checkpoint at 2, before the next
    assert_same_checkpoint(finished, tmp_path, part)


def test_a_run_leaves_losses_pictures_and_weights_that_load(finished, tmp_path):
    for part in TINY.parts:
        lines = (finished / part / "losses.jsonl").read_text().splitlines()
        assert [json.loads(line)["step"] for line in lines] == [2, 4]
        assert (finished / part / "samples.png").stat().st_size > 1000
    export(finished, tmp_path / "weights")
    model = SceneCCN(Weights(tmp_path / "weights"), NAMES)
    seen = model.see(np.zeros((IMAGE_SIZE_PX, IMAGE_SIZE_PX, 3), np.uint8), INTRINSICS_PX, (0.0, 0.0, 1.0))
    assert seen.latent_mean.shape == (len(NAMES) + len(seen.kinds), 8)


def test_the_crops_say_where_the_object_is(finished):
    """Objects lie off the crop's centre by what the label says: labels and pictures belong together."""
    views = [load_views(finished, name) for name in NAMES]
    composer = CropComposer(views[0], views[1:], torch.device("cpu"))
    batch = composer.compose(torch.arange(24), torch.Generator().manual_seed(0), jitter=1.0)
    seen = batch.visible > 0.95
    assert int(seen.sum()) >= 5
    rows = torch.arange(64).float()
    mask = (batch.mask[seen, 0] > 0.5).float()
    centre = (mask.sum(1) * rows).sum(1) / mask.sum((1, 2)) / 64 - 0.5
    clean = (batch.target[seen].sum(1) > 0).float()
    middle = (clean.sum(1) * rows).sum(1) / clean.sum((1, 2)) / 64 - 0.5
    label = batch.correction[seen, 0]
    assert torch.corrcoef(torch.stack([centre - middle, label]))[0, 1] > 0.9


def test_clean_crops_are_the_views_themselves(finished):
    """With crops "clean" what the CCN sees is what it shall draw, and all of it lies within its mask."""
    views = [load_views(finished, name) for name in NAMES]
    clean, disturbed = (CcnTask(TINY.model_copy(update={"crops": crops}), views, NAMES[0], torch.device("cpu"))
                        for crops in ("clean", "as_detected"))
    batch = clean.composer.undisturbed(torch.arange(5))
    assert torch.equal(batch.rgb, batch.target)
    assert float((batch.rgb.sum(1) * (batch.mask[:, 0] == 0)).sum()) < 0.01 * float(batch.rgb.sum())
    assert 0.1 < float(batch.mask.mean()) < 0.7
    assert clean.loss(0)[1]["first"] != disturbed.loss(0)[1]["first"]


def test_the_composed_frames_agree_with_their_labels(finished):
    """Masks lie around the labelled centres, and what is said to be absent has no mask."""
    composer = FrameComposer([load_views(finished, name) for name in NAMES], torch.device("cpu"))
    batch = composer.compose(40, np.random.default_rng(0))
    axis = (torch.arange(60) + 0.5) / 60
    whole = 0
    for b, k in torch.nonzero(batch.visible > 0.95).tolist():
        u, v = batch.center[b, k].tolist()
        mask = batch.mask[b, k]
        if 0.25 < u < 0.75 and 0.25 < v < 0.75 and mask.sum() < 400:
            assert abs(float((mask.sum(0) * axis).sum() / mask.sum()) - u) < 0.08
            assert abs(float((mask.sum(1) * axis).sum() / mask.sum()) - v) < 0.08
            whole += 1
    assert whole >= 5
    assert float(batch.mask[batch.visible == 0].sum()) == 0.0


def test_strangers_are_drawn_but_have_no_label(finished):
    """Every image holds a stranger alone: something is drawn on the table, and no known object is labelled."""
    composer = FrameComposer([load_views(finished, name) for name in NAMES], torch.device("cpu"))
    composer.scenes._chosen = lambda goal_like, rng: [composer.known]
    batch = composer.compose(20, np.random.default_rng(0))
    shades = [len(torch.unique((image[:, ::4, ::4] * 8).round().flatten(1), dim=1).T) for image in batch.image]
    assert np.median(shades) > 10
    assert float(batch.mask.sum()) == float(batch.visible.sum()) == 0.0


def test_a_recoloured_object_is_another(finished):
    """A known object's texture becomes a stranger's only in colours that are clearly not its own."""
    rng, views = np.random.default_rng(0), load_views(finished, NAMES[0])
    for tile in views.tiles[0, ::5] / 255.0:
        rgb, alpha = tile[..., :3] / np.maximum(tile[..., 3:], 1e-3), tile[..., 3:]
        other = recoloured(tile[..., :3], alpha, rng)
        assert (np.abs(other - rgb) * alpha).sum() / (3 * alpha.sum()) > 0.1


def test_another_run_is_not_overwritten(finished):
    with pytest.raises(SaccadeError, match="other settings"):
        start(finished, TINY.model_copy(update={"seed": 1}))


def test_an_unfinished_run_is_not_exported(finished, tmp_path):
    start(tmp_path, TINY)
    with pytest.raises(SaccadeError, match="not trained yet"):
        export(tmp_path, tmp_path / "weights")


def test_damaged_views_and_checkpoints_are_told(finished, tmp_path):
    start(tmp_path, TINY)
    (tmp_path / "views").mkdir()
    (tmp_path / "views" / "soup_can.npz").write_bytes(b"not a zip")
    with pytest.raises(SaccadeError, match="damaged"):
        load_views(tmp_path, "soup_can")
    (tmp_path / "views" / "soup_can.npz").unlink()
    (tmp_path / "views").rmdir()
    (tmp_path / "views").symlink_to(finished / "views")
    (tmp_path / "soup_can").mkdir()
    (tmp_path / "soup_can" / "checkpoint.safetensors").write_bytes(b"\0" * 100)
    with pytest.raises(SaccadeError, match="remove it"):
        Trainer(tmp_path, "soup_can")


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is there")
def test_a_gpu_that_is_not_there_is_told():
    with pytest.raises(SaccadeError, match="--device cpu"):
        pick_device("cuda")


def test_a_processor_learns_in_a_precision_that_it_computes_in():
    """Imitated bfloat16 costs many times what it saves."""
    with reduced_precision(torch.device("cpu")):
        product = torch.ones(2, 2) @ torch.ones(2, 2)
    assert (product.dtype == torch.bfloat16) == torch.ops.mkldnn._is_mkldnn_bf16_supported()
