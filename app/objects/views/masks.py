"""Tells an object from a plain background."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, binary_opening, label

BORDER = 0.04  # of the shorter side: the picture's border shows the background
SAMPLES = 6_000  # pixels of the border that are looked at
ROUNDS = 5  # of the fit; each leaves out what stands out
LEAST_DIFFERENT, NOISES = 14.0, 5.0  # what differs by so much, and by so many times the noise, is not background
NOISIEST = 8.0  # of a background that counts as plain; this and the above in steps of 0 to 255
MOST_DIFFERENT = 0.2  # share of the border that may differ
SHADE = (0.8, 1.06)  # the same colour, as much darker or brighter as this, is the background in a soft shadow
LARGE = 0.1  # of the largest region: a smaller one is a speck
SMALL_HOLE = 0.01  # of the object: a hole that is smaller is a highlight, and not one that one sees through
LEAST_PX = 200  # of an object


def plain_mask(rgb: NDArray[np.uint8]) -> NDArray[np.bool_] | None:
    """The mask [H, W] of what stands before a plain background in a picture [H, W, 3]; nothing may stand there. None if
    the background is not plain.

    The background's colour may change smoothly over the picture: it is a polynomial of second degree that is fitted to
    the border.
    """
    background, noise, different = _background(rgb)
    if noise > NOISIEST or different > MOST_DIFFERENT:
        return None
    found = _difference(rgb, background) > max(LEAST_DIFFERENT, NOISES * noise)
    return cleaned(binary_opening(found, iterations=1))


def cleaned(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A mask without specks and without the holes that highlights make. It is empty if little is left."""
    regions, count = label(mask)
    if count == 0:
        return mask
    sizes = np.bincount(regions.ravel())
    sizes[0] = 0
    kept = (sizes >= LARGE * sizes.max())[regions]
    holes, count = label(binary_fill_holes(kept) & ~kept)
    if count:
        sizes = np.bincount(holes.ravel())
        kept |= (sizes < SMALL_HOLE * kept.sum())[holes] & (holes > 0)
    return kept if kept.sum() >= LEAST_PX else np.zeros_like(kept)


def at_the_border(mask: NDArray[np.bool_]) -> bool:
    """Whether the picture's border cuts something off."""
    return bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())


def _terms(rows: NDArray, columns: NDArray, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """The terms of the polynomial [..., 6] at pixels."""
    y, x = (2 * rows / shape[0] - 1).astype(np.float32), (2 * columns / shape[1] - 1).astype(np.float32)
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def _background(rgb: NDArray[np.uint8]) -> tuple[NDArray[np.float32], float, float]:
    """The background's colours [H, W, 3], its noise, and the share of the border that differs from it."""
    height, width = rgb.shape[:2]
    wide = max(2, round(BORDER * min(height, width)))
    edge = np.ones((height, width), dtype=bool)
    edge[wide:-wide, wide:-wide] = False
    rows, columns = np.nonzero(edge)
    some = np.linspace(0, len(rows) - 1, min(SAMPLES, len(rows))).astype(int)
    rows, columns = rows[some], columns[some]
    seen, terms = rgb[rows, columns].astype(np.float32), _terms(rows, columns, rgb.shape)
    fitted = np.broadcast_to(np.median(seen, axis=0), seen.shape)
    for _ in range(ROUNDS):
        difference = _difference(seen, fitted)
        near = difference <= max(LEAST_DIFFERENT, 3 * float(np.median(difference)))
        if near.sum() < 0.3 * len(near):
            break
        fitted = terms @ np.linalg.lstsq(terms[near], seen[near], rcond=None)[0]
    coefficients = np.linalg.lstsq(terms, fitted, rcond=None)[0]
    difference = _difference(seen, fitted)
    noise = float(np.median(difference))
    y, x = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    return (_terms(y, x, rgb.shape) @ coefficients, noise,
            float((difference > max(LEAST_DIFFERENT, NOISES * noise)).mean()))


def _difference(rgb: NDArray, background: NDArray) -> NDArray[np.float32]:
    """By how much colours [..., 3] differ from those of the background, in the channel that differs most."""
    colours, behind = rgb.astype(np.float32), background.astype(np.float32)
    shade = (colours * behind).sum(-1) / np.maximum((behind * behind).sum(-1), 1.0)
    return np.asarray(np.abs(colours - np.clip(shade, *SHADE)[..., None] * behind).max(-1), dtype=np.float32)
