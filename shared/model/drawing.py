"""p(o | p) in NumPy: draws crops from latent poses without PyTorch (paper, section 3.2 and table 6), or from banks.

The decoder computes the same as `Decoder` and `PaperDecoder` in `shared/model/generative_model.py`, which training and
perception use.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from saccade.shared.errors import SaccadeError
from saccade.shared.model.bank import bank_in
from saccade.shared.model.latent import LEAK
from saccade.shared.model.weights import Weights

Array = NDArray[np.float32]
Layer = Callable[[Array], Array]

PREFIX = "ccn.decoder."
START = (64, 8, 8)  # channels, height and width of the output of the linear layers


class LatentDecoder:
    """Draws one object. Raises SaccadeError if its weights are missing or damaged, or are not those of a decoder."""

    def __init__(self, weights: Weights, name: str) -> None:
        state = weights.state(name, PREFIX)
        try:
            make = _paper if weights.architecture == "paper" else _default
            self._linear, self._layers = make(state)
            self(np.zeros(self._linear[0][0].shape[0], np.float32))
        except (KeyError, ValueError, IndexError) as error:
            raise SaccadeError(f"weights {weights.folder / name} are of another architecture: train anew") from error

    def __call__(self, latent: Array) -> Array:
        """Returns the crop on black [3, 64, 64] of a latent mean [L]."""
        x = latent
        for weight, bias, leaky in self._linear:
            x = x @ weight + bias
            x = rectified(x) if leaky else x
        x = x.reshape(START)
        for layer in self._layers:
            x = layer(x)
        return x


def drawn(decoder: LatentDecoder, latent: Array) -> NDArray[np.uint8]:
    """The crop on black [64, 64, 3] of a latent mean [L], as an image."""
    image: NDArray[np.uint8] = (decoder(latent).clip(0, 1).transpose(1, 2, 0) * 255 + 0.5).astype(np.uint8)
    return image


class BankPictures:
    """Shows one object from its bank. Raises SaccadeError if the bank is missing or damaged."""

    def __init__(self, weights: Weights, name: str) -> None:
        self.bank = bank_in(weights, name)

    def nearest(self, towards: NDArray[np.float64]) -> int:
        """The view that is nearest to a direction [3] from the object to the camera."""
        return int(np.argmax(self.bank.directions @ towards))

    def view(self, number: int) -> NDArray[np.uint8]:
        """A view on black [64, 64, 3]."""
        return self.bank.image(number)[..., :3]

    def picture(self, towards: NDArray[np.float64]) -> NDArray[np.uint8]:
        """The nearest view to a direction [3], on black [64, 64, 3]."""
        return self.view(self.nearest(towards))


def _default(state: dict[str, Array]) -> tuple[list, list[Layer]]:
    linear = [(*_linear(state, f"linear.{i}"), True) for i in (0, 2)]
    layers: list[Layer] = []
    for i in (0, 3, 6):
        layers += [_convolution(state, f"convolutions.{i}", margin=1), shuffled, rectified]
    return linear, [*layers, _convolution(state, "convolutions.9", margin=1)]


def _paper(state: dict[str, Array]) -> tuple[list, list[Layer]]:
    layers: list[Layer] = []
    for i, side in ((0, 17), (3, 35), (6, 69)):
        layers += [_convolution(state, f"convolutions.{i}"), rectified, functools.partial(enlarged, side=side)]
    layers += [_convolution(state, "convolutions.9"), rectified, _convolution(state, "convolutions.11")]
    return [(*_linear(state, "linear"), False)], layers


def _linear(state: dict[str, Array], name: str) -> tuple[Array, Array]:
    return np.ascontiguousarray(state[f"{name}.weight"].T), state[f"{name}.bias"]


def _convolution(state: dict[str, Array], name: str, margin: int = 0) -> Layer:
    weight, bias = state[f"{name}.weight"], state[f"{name}.bias"]
    side = weight.shape[-1]
    taps = np.ascontiguousarray(weight.transpose(2, 3, 0, 1)).reshape(side * side, *weight.shape[:2])

    def convolve(x: Array) -> Array:
        x = np.pad(x, ((0, 0), (margin, margin), (margin, margin)))
        height, width = x.shape[1] - side + 1, x.shape[2] - side + 1
        flat = np.broadcast_to(bias[:, None], (len(bias), height * width)).copy()
        for k, tap in enumerate(taps):
            row, column = divmod(k, side)
            flat += tap @ x[:, row:row + height, column:column + width].reshape(len(x), -1)
        return flat.reshape(-1, height, width)

    return convolve


def rectified(x: Array) -> Array:
    """A leaky rectifier, for each number of x."""
    return np.maximum(x, LEAK * x)


def shuffled(x: Array) -> Array:
    """Pixel shuffle: turns channels into pixels, [4 C, H, W] -> [C, 2 H, 2 W]."""
    channels, height, width = x.shape
    blocks = x.reshape(channels // 4, 2, 2, height, width).transpose(0, 3, 1, 4, 2)
    return blocks.reshape(channels // 4, 2 * height, 2 * width)


def enlarged(x: Array, side: int) -> Array:
    """Bilinear enlargement [C, H, H] -> [C, side, side]. The corners of the two images coincide, not the centres of
    their corner pixels."""
    between = _between(x.shape[-1], side)
    rows: Array = between @ x
    return rows @ between.T


@functools.cache
def _between(old: int, new: int) -> Array:
    """The weights [new, old] of the old pixels in each new one."""
    place = np.clip((np.arange(new) + 0.5) * old / new - 0.5, 0, None)
    low = np.floor(place).astype(np.int64)
    high, share = np.minimum(low + 1, old - 1), place - low
    weights = np.zeros((new, old), np.float32)
    np.add.at(weights, (np.arange(new), low), 1 - share)
    np.add.at(weights, (np.arange(new), high), share)
    return weights
