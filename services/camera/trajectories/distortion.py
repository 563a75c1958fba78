"""How a lens distorts: OpenCV's polynomial model with up to eight coefficients, and its fisheye model with four.

Rays are (x, y) at depth 1 with y down, as OpenCV counts them. `k` holds the coefficients by name (k1 to k6, p1, p2).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from saccade.shared.world.geometry import Array

Coefficients = Mapping[str, float]

WIDEST_RAD = np.radians(85)  # from the optical axis; beyond it a ray has hardly a place at depth 1
ANGLES = 4096  # of the table from which Newton's method starts
ROUNDS = 12  # of Newton's method; three are usual
STEP, EXACT = 1e-6, 1e-8  # of a ray; half a pixel is about 1e-3


def distorted(rays: Array, k: Coefficients, *, fisheye: bool) -> Array:
    """Returns where the lens shows rays [N, 2]: places [N, 2] in focal lengths from the principal point."""
    square = (rays ** 2).sum(1, keepdims=True)
    radius = np.sqrt(square)
    shown = rays * _share(radius, k, fisheye)
    if fisheye:
        return shown
    p1, p2 = k.get("p1", 0.0), k.get("p2", 0.0)
    return shown + 2 * rays[:, :1] * rays[:, 1:] * (p1, p2) + (p2, p1) * (square + 2 * rays ** 2)


def _share(radius: Array, k: Coefficients, fisheye: bool) -> Array:
    """By how much the lens moves rays of these radii outwards, as factors."""
    k1, k2, k3, k4, k5, k6 = (k.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "k5", "k6"))
    if fisheye:
        angle = np.arctan(radius)
        a = angle ** 2
        return angle * (1 + a * (k1 + a * (k2 + a * (k3 + a * k4)))) / np.maximum(radius, 1e-12)
    a = radius ** 2
    return (1 + a * (k1 + a * (k2 + a * k3))) / (1 + a * (k4 + a * (k5 + a * k6)))


def _table(k: Coefficients, fisheye: bool) -> tuple[Array, Array]:
    """Radii of rays, and where the lens shows them, as far as what is further out is shown further out."""
    radius = np.tan(np.linspace(0.0, WIDEST_RAD, ANGLES))
    with np.errstate(all="ignore"):  # a polynomial of wrong coefficients goes anywhere
        shown = radius * _share(radius, k, fisheye)
        rising = np.diff(shown) > 0
    count = ANGLES if rising.all() else int(rising.argmin()) + 1
    return radius[:count], shown[:count]


def widest(k: Coefficients, *, fisheye: bool) -> float:
    """Returns the radius of the last ray for which the model holds. Beyond it a polynomial turns back and would show
    the scene once more."""
    return float(_table(k, fisheye)[0][-1])


def undistorted(places: Array, k: Coefficients, *, fisheye: bool) -> Array:
    """Returns the rays [N, 2] that the lens shows at `places` [N, 2]. NaN where it shows none."""
    table_radius, table_shown = _table(k, fisheye)
    shown = np.linalg.norm(places, axis=1, keepdims=True)
    rays = places * np.interp(shown, table_shown, table_radius) / np.maximum(shown, 1e-12)
    with np.errstate(all="ignore"):
        for _ in range(ROUNDS):
            error = distorted(rays, k, fisheye=fisheye) - places
            if np.abs(error).max(initial=0.0) < EXACT / 10:
                break
            a, b = ((distorted(rays + step, k, fisheye=fisheye) - distorted(rays - step, k, fisheye=fisheye))
                    / (2 * STEP) for step in (np.array([STEP, 0.0]), np.array([0.0, STEP])))
            determinant = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
            rays = rays - np.stack([b[:, 1] * error[:, 0] - b[:, 0] * error[:, 1],
                                    a[:, 0] * error[:, 1] - a[:, 1] * error[:, 0]], axis=1) / determinant[:, None]
        exact = np.abs(distorted(rays, k, fisheye=fisheye) - places).max(1) < EXACT
    known = exact & (np.linalg.norm(rays, axis=1) <= table_radius[-1])
    return np.where(known[:, None], rays, np.nan)
