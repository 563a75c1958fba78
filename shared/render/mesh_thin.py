"""Makes meshes of many faces smaller, so that rendering them stays fast. Seams of textures stay where they are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from saccade.shared.errors import SaccadeError
from saccade.shared.render.mesh_parts import Part, weld

MANY_FACES = 20_000  # an image of 480x480 shows no more of them
_TOLERATED = 1.25  # times as many may remain, if seams of the texture would open otherwise
_AGGRESSION = 5.0  # of the library, from 0 (slow and good) to 10
NEEDS = (f"a mesh of more than {MANY_FACES} faces is simplified with the library fast-simplification: pip install "
         "'saccade[objects]'")


def thinned(parts: list[Part]) -> list[Part]:
    """The same parts with about MANY_FACES faces in all, and the same box. Raises SaccadeError if the library that does
    it is not there."""
    try:
        import fast_simplification  # noqa: F401
    except ImportError as error:
        raise SaccadeError(NEEDS) from error
    share = MANY_FACES / sum(len(part.corners) for part in parts)
    before = _box(parts)
    parts = [_thinned(part, max(4, int(share * len(part.corners)))) for part in parts]
    after = _box(parts)
    scale = (before[1] - before[0]) / np.where(after[1] > after[0], after[1] - after[0], 1.0)
    return [Part((part.corners - after[0]) * scale + before[0], part.uv, part.image, part.colours) for part in parts]


def _box(parts: list[Part]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return (np.min([part.corners.min((0, 1)) for part in parts], axis=0),
            np.max([part.corners.max((0, 1)) for part in parts], axis=0))


def _thinned(part: Part, target: int) -> Part:
    """A part with about as many faces. What a new corner looks like is a mean over the old ones that became it."""
    if len(part.corners) <= target:
        return part
    # The library's thresholds are absolute: it works in a box of side 1.
    low = part.corners.min((0, 1))
    side = max(float(np.ptp(part.corners.reshape(-1, 3), axis=0).max()), 1e-300)
    looks = part.uv if part.uv is not None else part.colours
    assert looks is not None
    rows, inverse = weld(np.concatenate([((part.corners - low) / side).reshape(-1, 3),
                                         looks.reshape(-1, looks.shape[-1]).astype(np.float64)], axis=1))
    faces = inverse.reshape(-1, 3)
    points, faces, became = simplified(rows[:, :3].astype(np.float64), faces, target)
    look = _means(rows, became, points)[faces]
    corners = points[faces] * side + low
    if part.uv is not None:
        return Part(corners, look, part.image)
    return Part(corners, colours=np.clip(look.round(), 0, 255).astype(np.uint8))


def simplified(points: NDArray[np.float64], faces: NDArray[np.int64],
                target: int) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """New points [V, 3], faces [F, 3], and which new point each old one became [V before]."""
    import fast_simplification as library

    for keep_seams in (True, False):
        _, _, collapses = library.simplify(points, faces.astype(np.int32), target_count=target, agg=_AGGRESSION,
                                           return_collapses=True, preserve_border=keep_seams)
        new, new_faces, became = library.replay_simplification(points, faces.astype(np.int32), collapses)
        if len(new_faces) <= _TOLERATED * target:
            break
    return np.asarray(new, dtype=np.float64), np.asarray(new_faces, dtype=np.int64), np.asarray(became)


def _means(rows: NDArray[np.float32], became: NDArray[np.int64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means [V, K] of what the old points looked like. A near point counts more."""
    there = (became >= 0) & (became < len(points))
    old, into = rows[there].astype(np.float64), became[there]
    weights = 1.0 / (((old[:, :3] - points[into]) ** 2).sum(1) + 1e-10)
    total = np.bincount(into, weights, minlength=len(points))
    sums = [np.bincount(into, weights * column, minlength=len(points)) for column in old[:, 3:].T]
    return np.stack(sums, axis=1) / np.maximum(total, 1e-300)[:, None]
