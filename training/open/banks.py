"""Makes the bank of an object from its mesh: some seconds, and nothing is trained."""

from __future__ import annotations

import functools

import numpy as np
import torch

from saccade.services.perception.local_features import LocalFeatures
from saccade.services.perception.view_encoder import ViewEncoder
from saccade.shared.model.bank import VIEWS, Bank, compressed, picture
from saccade.shared.model.weights import Weights
from saccade.shared.render.mesh import Mesh
from saccade.shared.render.views import crop_side_m
from saccade.training.open.composer import CropMaker
from saccade.training.open.landmarks import landmarks_from
from saccade.training.open.tiles import Tiles, tiles_of

AT_A_TIME = 50


class BankMaker:
    """Makes the banks of objects by the networks in weights, which are read when the first one is made. That raises
    SaccadeError if they are missing or damaged."""

    def __init__(self, networks: Weights):
        self.networks = networks

    def __call__(self, mesh: Mesh) -> Bank:
        """The bank of a mesh."""
        return bank_from(mesh, *self._parts)

    @functools.cached_property
    def _parts(self) -> tuple[ViewEncoder, LocalFeatures]:
        encoder = self.networks.fill(ViewEncoder(), "encoder")
        assert isinstance(encoder, ViewEncoder)  # it is what was filled
        return encoder, LocalFeatures()


def bank_from(mesh: Mesh, encoder: ViewEncoder, features: LocalFeatures, count: int = VIEWS) -> Bank:
    """The bank of a mesh with `count` views. Raises SaccadeError if OpenGL does not work."""
    return bank_of_tiles(tiles_of(mesh, count), mesh, encoder, features)


@torch.inference_mode()
def bank_of_tiles(tiles: Tiles, mesh: Mesh, encoder: ViewEncoder, features: LocalFeatures) -> Bank:
    """The bank of a mesh, from its views."""
    count, maker = len(tiles.images), CropMaker([tiles], torch.device("cpu"))
    parts = np.array_split(np.arange(count), -(-count // AT_A_TIME))
    views = torch.cat([maker.known(np.zeros(len(part), dtype=np.int64), part) for part in parts])
    images = (views.permute(0, 2, 3, 1) * 255).round().byte().numpy()
    half_m = crop_side_m(mesh.size_m) / 2
    kept = compressed(images)
    return Bank(mesh.name, tiles.circles * half_m, encoded(encoder, kept), kept, landmarks_from(mesh, features))


@torch.inference_mode()
def encoded(encoder: ViewEncoder, pictures: tuple[bytes, ...]) -> np.ndarray:
    """The vectors [V, D] of pictures as they are kept: what is lost with the compression is lost for both."""
    images = torch.from_numpy(np.stack([picture(each) for each in pictures]))
    views = images.permute(0, 3, 1, 2).float() / 255.0
    return torch.cat([encoder(part) for part in views.split(AT_A_TIME)]).numpy()
