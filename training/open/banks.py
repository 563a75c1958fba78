"""Makes the bank of an object from its mesh: some seconds, and nothing is trained."""

from __future__ import annotations

import numpy as np
import torch

from saccade.services.perception.view_encoder import ViewEncoder
from saccade.shared.model.bank import VIEWS, Bank, compressed
from saccade.shared.render.mesh import Mesh
from saccade.shared.render.views import crop_side_m
from saccade.training.open.composer import CropMaker
from saccade.training.open.tiles import Tiles, tiles_of

AT_A_TIME = 50


def bank_from(mesh: Mesh, encoder: ViewEncoder, count: int = VIEWS) -> Bank:
    """The bank of a mesh with `count` views. Raises SaccadeError if OpenGL does not work."""
    return bank_of_tiles(tiles_of(mesh, count), mesh, encoder)


@torch.inference_mode()
def bank_of_tiles(tiles: Tiles, mesh: Mesh, encoder: ViewEncoder) -> Bank:
    """The bank of a mesh, from its views."""
    count, maker = len(tiles.images), CropMaker([tiles], torch.device("cpu"))
    parts = np.array_split(np.arange(count), -(-count // AT_A_TIME))
    views = torch.cat([maker.known(np.zeros(len(part), dtype=np.int64), part) for part in parts])
    images = (views.permute(0, 2, 3, 1) * 255).round().byte().numpy()
    half_m = crop_side_m(mesh.size_m) / 2
    kept = compressed(images)
    return Bank(mesh.name, tiles.circles * half_m, encoded(encoder, kept), kept)


@torch.inference_mode()
def encoded(encoder: ViewEncoder, pictures: tuple[bytes, ...]) -> np.ndarray:
    """The vectors [V, D] of pictures as they are kept: what is lost with the compression is lost for both."""
    bank = Bank("", np.ones((len(pictures), 3)), np.zeros((len(pictures), 1), dtype=np.float32), pictures)
    images = torch.from_numpy(np.stack([bank.image(view) for view in range(len(pictures))]))
    views = images.permute(0, 3, 1, 2).float() / 255.0
    return torch.cat([encoder(part) for part in views.split(AT_A_TIME)]).numpy()
