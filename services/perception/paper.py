"""The paper's own networks (appendix C). They are used if the manifest of the weights says "architecture": "paper".

Each object has its own networks: a mask network, a spatial transformer network on the masked image, and an identity
network and a CCN on the crop. The crop is an affine cut of the masked image, with one scale for all objects, as in the
paper.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from saccade.services.perception.seen import Seen, bits
from saccade.shared.model.generative_model import Stacked, conv_stack, decoder_of, encoder_of
from saccade.shared.model.weights import Weights
from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX, REFERENCE_RANGE_M
from saccade.shared.world.windows import CROP_PX

MASK_PX, WHERE_PX = 64, 32  # sides of the images that the mask network and the spatial transformer network see
CANVAS_PX = 120  # the number of samples per crop pixel is the image's side divided by this, rounded, at least 1
MEDIAN_PX = 5  # side of the median filter on the mask
START = (1 / 1.0 - 0.2) / 3.8  # h of scale 1: an untrained spatial transformer cuts out the whole image
CROP_SIDE_M = REFERENCE_RANGE_M * IMAGE_SIZE_PX / INTRINSICS_PX[0]  # the width that the image covers at 0.40 m
# Standard deviations of a percept if the manifest gives none. They are the same for all objects, as in the paper.
PIXEL_STD, LOG_SCALE_STD = 20.0, 0.15


def median_pool(image: Tensor, side: int) -> Tensor:
    """Median filter of images [B, 1, H, W], over side x side pixels. The image is mirrored at its border."""
    around = F.pad(image, [side // 2] * 4, mode="reflect")
    return F.unfold(around, side).median(dim=1).values.view(image.shape)


def spatial_transform(image: Tensor, center: Tensor, scale: Tensor) -> Tensor:
    """Cuts squares out of images [B, C, H, H] and returns crops [B, C, 64, 64]. They are black outside the image.

    `center` [B, 2] is the centre of each square, with the image in [-1, 1]; `scale` [B] is its side in image widths.
    """
    factor = max(1, round(image.shape[-1] / CANVAS_PX))
    fine = factor * CROP_PX
    axis = (torch.arange(fine, device=image.device) + 0.5) / fine * 2 - 1
    x, y = (center[:, n, None] + scale[:, None] * axis for n in (0, 1))
    grid = torch.stack([x[:, None].expand(-1, fine, -1), y[:, :, None].expand(-1, -1, fine)], dim=-1)
    return F.avg_pool2d(F.grid_sample(image, grid, align_corners=False), factor)


class MaskNetwork(nn.Module):
    """The mask network alpha: image [B, 3, H, H] -> probability that each pixel shows the object [B, 1, H, H]."""

    def __init__(self):
        super().__init__()
        self.convolutions = nn.Sequential(
            nn.Conv2d(3, 16, 1), nn.LeakyReLU(), nn.Conv2d(16, 32, 3, padding=1), nn.LeakyReLU(),
            nn.Conv2d(32, 64, 3, padding=1), nn.LeakyReLU(), nn.Conv2d(64, 1, 3, padding=1))

    def forward(self, image: Tensor) -> Tensor:
        small = F.interpolate(image, size=(MASK_PX, MASK_PX), mode="area")
        mask = median_pool(self.convolutions(small).float(), MEDIAN_PX).sigmoid()
        return F.interpolate(mask, size=image.shape[-2:], mode="bilinear", align_corners=False)


class SpatialTransformer(nn.Module):
    """The spatial transformer network: masked image [B, 3, H, H] -> centre [B, 2] and scale [B] of the object.

    The image covers [-1, 1]; the scale is 0.40 m / range.
    """

    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Flatten(), nn.Linear(3 * WHERE_PX ** 2, 256), nn.LeakyReLU(), nn.Linear(256, 128), nn.LeakyReLU(),
            nn.Linear(128, 64), nn.LeakyReLU(), nn.Linear(64, 3), nn.ELU())
        last = self.layers[-2]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            last.bias.copy_(torch.tensor([0.0, 0.0, START]))

    def forward(self, masked: Tensor) -> tuple[Tensor, Tensor]:
        small = F.interpolate(masked, size=(WHERE_PX, WHERE_PX), mode="area")
        center, h = self.layers(small).float().split([2, 1], dim=-1)
        # The ELU can reach below the pole of the formula. h is clipped at 0, but its gradient is kept, so that it can
        # grow again.
        h = h + (h.clamp(min=0.0) - h).detach()
        return center, 1 / (3.8 * h.squeeze(-1) + 0.2)


class PaperExtraction(nn.Module):
    """The networks of one object that phase 2 of the training trains: mask, spatial transformer and identity.

    Image [B, 3, H, H] -> mask [B, 1, H, H], centre [B, 2] (the image covers [-1, 1]), scale [B], masked crop with its
    mask [B, 4, 64, 64], presence logit [B].
    """

    def __init__(self):
        super().__init__()
        self.mask, self.transformer = MaskNetwork(), SpatialTransformer()
        self.identity = nn.Sequential(conv_stack(3, 1), nn.Linear(256, 1))

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        mask = self.mask(image)
        center, scale = self.transformer(image * mask)
        crop = spatial_transform(torch.cat([image * mask, mask], dim=1), center, scale)
        return mask, center, scale, crop, self.identity(crop[:, :3]).float().squeeze(-1)


class PaperSceneCCN:
    """The paper's networks of K objects, evaluated together; with `one_by_one` in a slow loop, for comparison.

    Raises SaccadeError if the weights lack an object, are damaged, or have another architecture.
    """

    def __init__(self, weights: Weights, names: tuple[str, ...], *, one_by_one: bool = False):
        self.cards = weights.cards_of(names)
        extraction = Stacked([weights.fill(PaperExtraction(), f"{name}.extraction") for name in names])
        encoder = Stacked([weights.fill(encoder_of("paper"), name, "ccn.encoder.") for name in names])
        decoder = Stacked([weights.fill(decoder_of("paper"), name, "ccn.decoder.") for name in names])
        networks = (extraction, encoder, decoder)
        self.extraction, self.encoder, self.decoder = (n.one_by_one if one_by_one else n for n in networks)
        self.pixel_std = weights.calibrated(names, "pixel_std", PIXEL_STD)
        self.log_scale_std = weights.calibrated(names, "log_scale_std", LOG_SCALE_STD)

    @torch.inference_mode()
    def see(self, rgb: NDArray[np.uint8], intrinsics_px: ArrayLike, up: ArrayLike,
            depth_m: NDArray[np.float32] | None = None, *, alone: bool = False) -> Seen:
        """Infers all objects from an image [H, H, 3]. The paper's crops use neither intrinsics, `up` nor depth."""
        image = torch.from_numpy(np.array(rgb)).permute(2, 0, 1).float() / 255.0
        everyone = image.expand(len(self.cards), 1, -1, -1, -1)
        whole, center, scale, crops, logit = (x[:, 0] for x in self.extraction(everyone))
        mean, std = (x[:, 0] for x in self.encoder(crops[:, None, :3]))
        masked, mask = crops[:, :3], crops[:, 3:]
        error = ((self.decoder(mean[:, None])[:, 0] * mask - masked) ** 2).sum((1, 2, 3))
        pixel = (center.double().numpy() + 1) / 2 * rgb.shape[1]
        seen_in = bits((F.adaptive_avg_pool2d(whole[:, 0], MASK_PX) > 0.5).numpy())
        return Seen(logit.sigmoid().double().numpy(), pixel, self.pixel_std, scale.double().numpy(), self.log_scale_std,
                    mean.numpy(), std.numpy(), error.double().numpy(), seen_in)
