"""PoseCNN (Xiang et al., 2018) in kind: it estimates the pose of every known object directly from an image.

One network labels pixels, and each cell votes for the direction to the centre of its object and for its range. The
centre is where most votes meet, as in a Hough transform. Features around it give the rotation as a quaternion. The
weights hold one network for all objects; their manifest says "architecture": "posecnn".
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from saccade.services.perception.networks import block
from saccade.services.perception.seen import Seen, bits
from saccade.shared.model.weights import Weights
from saccade.shared.world.geometry import REFERENCE_RANGE_M, pixel_rays, pose, rotation_onto

INPUT_PX = 160  # side of the image that the network sees
LABEL_PX = 80  # side of its map of labels
CELLS = 40  # side of its grid of votes
REGION = 16  # side of the region of features that gives the rotation
CHANNELS = 5  # red, green, blue, depth, and whether there is a depth
DEPTH_M, DEPTH_SPAN_M = 0.5, 0.5  # a depth enters as (depth - 0.5 m) / 0.5 m, at most 2
FEW_CELLS = 3.0  # so many labelled cells make the presence half as sure
MOST_VOTERS = 200  # more cells of one object say nothing new
INLIERS = (0.95, 0.99)  # cosine of the largest angle between a vote and the direction to a centre that it supports
Numbers = TypeVar("Numbers", NDArray[np.float64], Tensor)
_SPAN = (-0.25, 1.25)  # where centres are looked for, in image widths
_CANDIDATES = 61  # per axis
PIXEL_STD, LOG_SCALE_STD = 8.0, 0.08  # of a percept, if the manifest gives none


class PoseNetwork(nn.Module):
    """The network: image [B, 5, 160, 160] -> labels, votes and features.

    Returns label logits [B, K + 1, 80, 80] (0 is the background), votes [B, K, 3, 40, 40] and features [B, 96, 80, 80].
    A vote is the direction (x, y) from the cell to the object's centre in the image, and log(0.40 m / range).
    `quaternions` gives the rotations from the features.
    """

    def __init__(self, count: int):
        super().__init__()
        self.count = count
        self.stem = nn.Sequential(block(CHANNELS, 24, stride=2), block(24, 32))
        self.middle = nn.Sequential(block(32, 64, stride=2), block(64, 64))
        self.deep = nn.Sequential(block(64, 96, stride=2), block(96, 96), block(96, 96, dilation=2),
                                  block(96, 96, dilation=4), block(96, 64))
        self.merge = block(128, 64)
        self.labels = nn.Conv2d(96, count + 1, 3, padding=1)
        self.votes = nn.Conv2d(64, 3 * count, 1)
        self.region = nn.Sequential(block(96, 96, stride=2), block(96, 128, stride=2), nn.Flatten())
        self.rotation = nn.Sequential(nn.Linear(128 * (REGION // 4) ** 2, 256), nn.LeakyReLU(0.1),
                                      nn.Linear(256, 4 * count))

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        fine = self.stem(image)
        middle = self.middle(fine)
        deep = F.interpolate(self.deep(middle), size=(CELLS, CELLS), mode="bilinear", align_corners=False)
        merged = self.merge(torch.cat([middle, deep], dim=1))
        wide = F.interpolate(merged, size=(LABEL_PX, LABEL_PX), mode="bilinear", align_corners=False)
        features = torch.cat([fine, wide], dim=1)
        votes = self.votes(merged).unflatten(1, (self.count, 3)).float()
        return self.labels(features).float(), votes, features

    def quaternions(self, features: Tensor, center: Tensor, side: Tensor, which: Tensor) -> Tensor:
        """Unit quaternions (w, x, y, z) [R, 4] of R regions of the features [R, 96, 80, 80].

        `center` [R, 2] and `side` [R] are in image widths, `which` [R] are the numbers of the objects.
        """
        axis = (torch.arange(REGION, device=center.device) + 0.5) / REGION - 0.5
        x, y = (2 * (center[:, n, None] + side[:, None] * axis) - 1 for n in (0, 1))
        grid = torch.stack([x[:, None].expand(-1, REGION, -1), y[:, :, None].expand(-1, -1, REGION)], dim=-1)
        cut = F.grid_sample(features, grid.to(features.dtype), align_corners=False)
        all_of = self.rotation(self.region(cut)).float().unflatten(1, (self.count, 4))
        return F.normalize(all_of[torch.arange(len(which), device=which.device), which], dim=-1)


def network_input(rgb: Tensor, depth_m: Tensor | None) -> Tensor:
    """The input [B, 5, 160, 160] from images [B, 3, H, W] (0 to 1) and depths [B, H, W] in metres, if there are any."""
    size = (INPUT_PX, INPUT_PX)
    small = F.interpolate(rgb, size=size, mode="area")
    if depth_m is None:
        return torch.cat([small, torch.zeros(len(small), 2, *size, device=small.device)], dim=1)
    near = F.interpolate(depth_m[:, None], size=size, mode="nearest")
    scaled = ((near - DEPTH_M) / DEPTH_SPAN_M).clamp(-1.0, 2.0)
    return torch.cat([small, scaled, torch.ones_like(scaled)], dim=1)


def hough_center(cells: Tensor, directions: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Where the votes meet: the centre [2] in image widths, and which of the N cells support it [N] (truth values).

    `cells` [N, 2] are their places in image widths, `directions` [N, 2] unit vectors, `weight` [N] their weights. The
    best candidate of a grid is refined: the point with the least squared distances to the lines of its supporters.
    """
    axis = torch.linspace(*_SPAN, _CANDIDATES)
    candidates = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), dim=-1).view(-1, 2)
    towards = F.normalize(candidates[:, None] - cells, dim=-1)  # [C, N, 2]
    supported = (towards * directions).sum(-1) > INLIERS[0]
    best = candidates[torch.argmax((supported * weight).sum(1))]
    across = (torch.eye(2) - directions[:, :, None] * directions[:, None, :]) * weight[:, None, None]
    for least in INLIERS:  # of the refined point the supporters are counted more strictly
        inliers = (F.normalize(best - cells, dim=-1) * directions).sum(-1) > least
        chosen = across * inliers[:, None, None]
        # The small share of the identity keeps the point where it is if the lines are nearly parallel.
        left = chosen.sum(0) + 0.01 * torch.eye(2)
        right = (chosen @ cells[:, :, None]).sum(0) + 0.01 * best[:, None]
        best = torch.linalg.solve(left, right)[:, 0]
    return best, inliers


def rotation_of(quaternion: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of unit quaternions (w, x, y, z) [..., 4]."""
    w, x, y, z = quaternion.unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def region_side(crop_side_m: Numbers, scale: Numbers, focal_widths: float) -> Numbers:
    """The sides of objects' regions in image widths, from the sides of their crops (m) and 0.40 m / range."""
    return crop_side_m * scale * (focal_widths / REFERENCE_RANGE_M)


class PoseCNN:
    """PoseCNN for K objects. Raises SaccadeError if the weights lack an object, are damaged, or are of another
    architecture."""

    def __init__(self, weights: Weights, names: tuple[str, ...]):
        self.cards = weights.cards_of(names)
        self.sides_m = np.array([card.crop_side_m for card in self.cards])
        self.rows = [weights.names.index(name) for name in names]
        network = weights.fill(PoseNetwork(len(weights.names)), "posecnn")
        assert isinstance(network, PoseNetwork)  # it is what was filled
        self.network = network
        self.pixel_std = weights.calibrated(names, "pixel_std", PIXEL_STD)
        self.log_scale_std = weights.calibrated(names, "log_scale_std", LOG_SCALE_STD)

    @torch.inference_mode()
    def see(self, rgb: NDArray[np.uint8], intrinsics_px: ArrayLike, up: ArrayLike,
            depth_m: NDArray[np.float32] | None = None, *, alone: bool = False) -> Seen:
        """Infers all objects from an image [H, H, 3], and from its depth [H, H] where there is one. `up` is not
        used."""
        width = rgb.shape[1]
        image = torch.from_numpy(np.array(rgb)).permute(2, 0, 1)[None].float() / 255.0
        depth = None if depth_m is None else torch.from_numpy(np.array(depth_m))[None]
        labels, votes, features = self.network(network_input(image, depth))
        shares = labels[0].softmax(0)
        label = shares.argmax(0)
        focal = float(np.asarray(intrinsics_px)[0])
        count = len(self.rows)
        presence, pixel, scale = np.zeros(count), np.full((count, 2), width / 2), np.ones(count)
        for k, row in enumerate(self.rows):
            found = _tally(shares[row + 1], (label == row + 1).float(), votes[0, row])
            if found is not None:
                presence[k], pixel[k], scale[k] = found[0], found[1] * width, found[2]
        side = region_side(self.sides_m, scale, focal / width)
        quaternion = self.network.quaternions(
            features.expand(count, -1, -1, -1), torch.tensor(pixel / width, dtype=torch.float32),
            torch.tensor(side, dtype=torch.float32), torch.tensor(self.rows))
        rays = pixel_rays(pixel, intrinsics_px)
        rotation = rotation_onto(rays) @ rotation_of(quaternion.double()).numpy()
        masks = torch.stack([label == row + 1 for row in self.rows]).numpy()
        nothing = np.zeros((count, 0), dtype=np.float32)
        return Seen(presence, pixel, self.pixel_std, scale, self.log_scale_std, nothing, nothing, np.zeros(count),
                    bits(masks), pose(rotation, rays * (REFERENCE_RANGE_M / scale)[:, None]))


def _tally(share: Tensor, label: Tensor, votes: Tensor) -> tuple[float, NDArray[np.float64], float] | None:
    """Presence, centre [2] in image widths and scale of one object, or None if no cell has its label.

    `share` [80, 80] are the probabilities of its label, `label` [80, 80] is 1 where it is the likeliest, `votes` are
    [3, 40, 40].
    """
    weight = F.avg_pool2d((share * label)[None], LABEL_PX // CELLS)[0].flatten()
    total = float(weight.sum())
    if total == 0.0:
        return None
    center, log_scale = counted(votes, weight)
    sure = float((share * label).sum() / label.sum())
    scale = float(log_scale.clamp(-2.0, 2.0).exp())
    return sure * total / (total + FEW_CELLS), center.clamp(-0.5, 1.5).double().numpy(), scale


def counted(votes: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """The centre [2] in image widths and log(0.40 m / range) by the votes [3, 40, 40] of the cells that have a weight
    [1600]."""
    chosen = weight.topk(min(MOST_VOTERS, int((weight > 0).sum()))).indices
    cells = torch.stack([(chosen % CELLS + 0.5) / CELLS, (chosen // CELLS + 0.5) / CELLS], dim=-1)
    voted, weight = votes.flatten(1)[:, chosen], weight[chosen]
    center, inliers = hough_center(cells, F.normalize(voted[:2].T, dim=-1), weight)
    supporting = weight * inliers if inliers.any() else weight
    return center, (voted[2] * supporting).sum() / supporting.sum()
