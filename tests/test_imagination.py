"""How networks that know objects by their views imagine them: the drawing lies where the object would be seen."""

import numpy as np
import pytest
import torch

from saccade.app.look.see import artist_of, drawing_of
from saccade.services.perception.local_features import LocalFeatures
from saccade.services.perception.view_encoder import ViewEncoder
from saccade.services.viewer.imagination import Imagination
from saccade.services.viewer.layout import VIEW_PX
from saccade.shared.bus.messages import Belief, Percept
from saccade.shared.errors import SaccadeError
from saccade.shared.model.weights import ObjectCard, Weights, write_weights
from saccade.shared.render.groceries import grocery
from saccade.shared.render.views import crop_side_m
from saccade.shared.render.world import World
from saccade.shared.world.geometry import (
    IMAGE_SIZE_PX,
    INTRINSICS_PX,
    direction,
    look_at,
    project,
    rotation_xyz,
)
from saccade.training.open.banks import bank_from

CENTER_M = np.array([0.05, -0.03, 0.06])


@pytest.fixture(scope="module")
def mesh():
    return grocery(np.random.default_rng(5), "grocery")


@pytest.fixture(scope="module")
def weights(mesh, tmp_path_factory, small_banks):
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("weights") / "own"
    card = ObjectCard(mesh.name, mesh.size_m, crop_side_m(mesh.size_m))
    bank = bank_from(mesh, ViewEncoder().eval(), LocalFeatures(), count=100)
    write_weights(folder, {}, (card,), {"architecture": "open", "networks": "open"}, {mesh.name: bank.arrays()})
    return Weights(folder)


def sample(message, **values):
    """A message of which only what is told matters."""
    made = object.__new__(message)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.7), (np.pi / 2, 0.0, 0.3), (0.4, 1.2, 0.0)])
def test_a_planned_view_shows_an_object_where_it_would_be_seen_standing_and_lying(mesh, weights, turn):
    world_from_object = rotation_xyz(turn)
    before = look_at(CENTER_M + 0.5 * direction(0.2, 0.5), CENTER_M)
    pixel, _ = project(CENTER_M, before, INTRINSICS_PX)
    seen = sample(Percept, object=mesh.name, world_from_camera=before, pixel=pixel, intrinsics_px=INTRINSICS_PX,
                  rotations=(before[:3, :3].T @ world_from_object)[None], camera_from_object=None)
    belief = sample(Belief, object=mesh.name, mean_m=CENTER_M)
    viewpoint = look_at(CENTER_M + 0.45 * direction(1.4, 0.8), CENTER_M + np.array([0.04, 0.02, 0.0]))
    drawn = Imagination(weights, (mesh.name,)).planned_view(viewpoint, [belief], {mesh.name: seen}).max(-1) > 24
    world = World((mesh,), size_px=VIEW_PX, intrinsics_px=np.array(INTRINSICS_PX) * VIEW_PX / IMAGE_SIZE_PX)
    world.show_table(False)
    world.place({mesh.name: (CENTER_M, world_from_object)})
    there = world.render_masks(viewpoint)[mesh.name]
    world.close()
    assert (drawn & there).sum() / (drawn | there).sum() > 0.8


def test_what_is_seen_is_the_view_from_the_likeliest_direction(mesh, weights):
    """And a photograph's drawing is the same picture."""
    towards = direction(0.9, 0.3)
    camera = look_at(CENTER_M + 0.5 * towards, CENTER_M)
    pixel, _ = project(CENTER_M, camera, INTRINSICS_PX)
    percept = sample(Percept, object=mesh.name, world_from_camera=camera, pixel=pixel, intrinsics_px=INTRINSICS_PX,
                     rotations=None, camera_from_object=np.vstack([np.hstack([camera[:3, :3].T, np.zeros((3, 1))]),
                                                                   [0, 0, 0, 1]]))
    shown = Imagination(weights, (mesh.name,)).reconstructions([percept])
    artist = artist_of(weights, mesh.name)
    assert np.array_equal(shown[0], drawing_of(artist, np.zeros(0, np.float32), towards))
    assert not np.array_equal(shown[0], drawing_of(artist, np.zeros(0, np.float32), -towards))
    assert drawing_of(artist, np.zeros(0, np.float32), None) is None


def test_a_damaged_bank_is_named(mesh, weights, tmp_path):
    card = weights.cards[0]
    arrays = {**weights.bank(mesh.name), "lengths": np.array([3], dtype=np.uint32)}
    write_weights(tmp_path / "own", {}, (card,), {"architecture": "open", "networks": "open"}, {mesh.name: arrays})
    with pytest.raises(SaccadeError, match=r"bank of grocery in .*own is damaged"):
        Imagination(Weights(tmp_path / "own"), (mesh.name,))
