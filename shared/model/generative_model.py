"""The cortical column network (CCN): one small generative model for each object (paper, section 3.2 and appendix C).

The encoder turns a crop o into q(p | o), a Gaussian over the latent pose of the object. The transition p(p' | p, a)
moves the latent pose by a displacement in azimuth and elevation. The decoder p(o | p) draws the crop. Perception uses
the encoder, belief uses the transition (in NumPy: `shared/model/latent.py`), and training uses all of them.

There are two architectures: "paper" follows the paper's tables exactly, and "default" is Saccade's own.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state

from saccade.shared.model.latent import MIN_STD
from saccade.shared.model.weights import Architecture

LATENT = 8


def conv_stack(channels_in: int, width: int) -> nn.Sequential:
    """Four 4x4 convolutions of stride 2 (paper, tables 4 and 5): [B, C, 64, 64] -> [B, 256 width]."""
    layers: list[nn.Module] = []
    for channels in (8, 16, 32, 64):
        layers += [nn.Conv2d(channels_in, channels * width, 4, stride=2), nn.LeakyReLU()]
        channels_in = channels * width
    return nn.Sequential(*layers, nn.Flatten())


def gaussian(parameters: Tensor) -> tuple[Tensor, Tensor]:
    """Splits parameters [..., 2 L] into a mean [..., L] and a standard deviation [..., L] > 0."""
    mean, raw = parameters.chunk(2, dim=-1)
    return mean, F.softplus(raw) + MIN_STD


class Encoder(nn.Module):
    """q(p | o): masked crop and its mask [B, 4, 64, 64] -> mean and standard deviation [B, L] (paper, table 5).

    The paper's encoder has width 1 and sees the masked crop only.
    """

    def __init__(self, width: int = 2, channels_in: int = 4):
        super().__init__()
        self.convolutions = conv_stack(channels_in, width)
        self.head = nn.Linear(256 * width, 2 * LATENT)

    def forward(self, crop: Tensor) -> tuple[Tensor, Tensor]:
        return gaussian(self.head(self.convolutions(crop)).float())


class Transition(nn.Module):
    """p(p' | p, a): latent pose [B, L] and displacement (azimuth, elevation) [B, 2] in radians -> mean and standard
    deviation [B, L] (paper, table 7).

    If `periodic`, the azimuth enters as sine and cosine, so that a full turn changes nothing. Otherwise it enters as an
    angle, as in the paper.
    """

    def __init__(self, periodic: bool = True):
        super().__init__()
        self.periodic = periodic
        self.layers = nn.Sequential(
            nn.Linear(LATENT + (3 if periodic else 2), 128), nn.LeakyReLU(), nn.Linear(128, 256), nn.LeakyReLU(),
            nn.Linear(256, 256), nn.LeakyReLU(), nn.Linear(256, 2 * LATENT))

    def forward(self, latent: Tensor, displacement: Tensor) -> tuple[Tensor, Tensor]:
        if self.periodic:
            azimuth, elevation = displacement[..., :1], displacement[..., 1:]
            displacement = torch.cat([azimuth.sin(), azimuth.cos(), elevation], dim=-1)
        return gaussian(self.layers(torch.cat([latent, displacement], dim=-1)).float())


class Decoder(nn.Module):
    """p(o | p): latent pose [B, L] -> crop on black [B, 3, 64, 64].

    It uses pixel shuffle instead of the paper's wide 5x5 convolutions (table 6). This is 4.5 times faster on a CPU,
    with the same quality.
    """

    def __init__(self):
        super().__init__()
        self.linear = nn.Sequential(nn.Linear(LATENT, 128), nn.LeakyReLU(), nn.Linear(128, 64 * 8 * 8), nn.LeakyReLU())
        self.convolutions = nn.Sequential(
            nn.Conv2d(64, 128, 3, padding=1), nn.PixelShuffle(2), nn.LeakyReLU(),
            nn.Conv2d(32, 64, 3, padding=1), nn.PixelShuffle(2), nn.LeakyReLU(),
            nn.Conv2d(16, 32, 3, padding=1), nn.PixelShuffle(2), nn.LeakyReLU(),
            nn.Conv2d(8, 3, 3, padding=1))

    def forward(self, latent: Tensor) -> Tensor:
        return self.convolutions(self.linear(latent).view(-1, 64, 8, 8))


class PaperDecoder(nn.Module):
    """p(o | p) of the paper (table 6): latent pose [B, L] -> crop on black [B, 3, 64, 64].

    Without padding, the convolutions shrink the image: 8 pixels become 4, 17 become 13, 35 become 30, and 69 become 64.
    """

    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(LATENT, 64 * 8 * 8)
        self.convolutions = nn.Sequential(
            nn.Conv2d(64, 64, 5), nn.LeakyReLU(), nn.Upsample(17, mode="bilinear"),
            nn.Conv2d(64, 64, 5), nn.LeakyReLU(), nn.Upsample(35, mode="bilinear"),
            nn.Conv2d(64, 32, 6), nn.LeakyReLU(), nn.Upsample(69, mode="bilinear"),
            nn.Conv2d(32, 16, 6), nn.LeakyReLU(), nn.Conv2d(16, 3, 1))

    def forward(self, latent: Tensor) -> Tensor:
        return self.convolutions(self.linear(latent).view(-1, 64, 8, 8))


def encoder_of(architecture: Architecture) -> Encoder:
    """Returns an untrained q(p | o)."""
    return Encoder(width=1, channels_in=3) if architecture == "paper" else Encoder()


def transition_of(architecture: Architecture) -> Transition:
    """Returns an untrained p(p' | p, a)."""
    return Transition(periodic=architecture == "default")


def decoder_of(architecture: Architecture) -> Decoder | PaperDecoder:
    """Returns an untrained p(o | p)."""
    return PaperDecoder() if architecture == "paper" else Decoder()


class CCN(nn.Module):
    """Encoder, transition and decoder of one object."""

    def __init__(self, architecture: Architecture = "default"):
        super().__init__()
        self.encoder, self.transition = encoder_of(architecture), transition_of(architecture)
        self.decoder = decoder_of(architecture)


class Stacked:
    """Evaluates K networks of the same shape together, one for each object. Inputs and outputs have K as their first
    dimension."""

    def __init__(self, modules: Sequence[nn.Module]):
        self.parameters, self.buffers = stack_module_state([module.eval() for module in modules])
        self._modules = [module.eval() for module in modules]
        skeleton = modules[0]
        self._call = torch.vmap(lambda p, b, *inputs: functional_call(skeleton, (p, b), inputs))

    @torch.inference_mode()
    def __call__(self, *inputs: Tensor):
        return self._call(self.parameters, self.buffers, *inputs)

    @torch.inference_mode()
    def some(self, which: Sequence[int], *inputs: Tensor):
        """Evaluates the networks of the numbers `which`. Each may be there several times."""
        rows = list(which)
        parameters, buffers = ({name: value[rows] for name, value in held.items()}
                               for held in (self.parameters, self.buffers))
        return self._call(parameters, buffers, *inputs)

    @torch.inference_mode()
    def one_by_one(self, *inputs: Tensor):
        """Computes the same in a slow loop, for the parity test and the benchmark."""
        results = [module(*(x[k] for x in inputs)) for k, module in enumerate(self._modules)]
        if isinstance(results[0], tuple):
            return tuple(torch.stack(parts) for parts in zip(*results, strict=True))
        return torch.stack(results)


def log_density(x: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """log N(x; mean, std) of diagonal Gaussians [..., L], summed over the last axis."""
    return (-0.5 * ((x - mean) / std) ** 2 - std.log() - 0.9189385332046727).sum(-1)


def kl_divergence(mean_q: Tensor, std_q: Tensor, mean_p: Tensor | float, std_p: Tensor | float) -> Tensor:
    """KL[q || p] of diagonal Gaussians [..., L] in nats, summed over the last axis."""
    mean_p, std_p = torch.as_tensor(mean_p), torch.as_tensor(std_p)
    ratio = std_q / std_p
    return (0.5 * (ratio ** 2 + ((mean_q - mean_p) / std_p) ** 2 - 1.0) - ratio.log()).sum(-1)
