"""Guesses what mesh files do not say: the unit of their lengths, and which axis points up. Every guess is told."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from saccade.shared.errors import SaccadeError
from saccade.shared.render.mesh_parts import Loaded, Unit

METRES: dict[Unit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
NAMES: dict[Unit, str] = {"m": "metres", "cm": "centimetres", "mm": "millimetres"}
HOUSEHOLD_M = (0.02, 1.2)  # the largest side of household things
USUAL_M = 0.15
LIMITS_M = (0.001, 5.0)  # of the largest side of anything

_BOTTOM = 0.02  # of the height, from below: what is there is the base
_CLEARLY = 1.5  # times as large is a base, for an axis to be called up because of it


def in_metres(number: float) -> str:
    """A length in words, in the unit in which people say it."""
    if number >= 1.0:
        return f"{number:.3g} m"
    return f"{100 * number:.3g} cm" if number >= 0.01 else f"{1000 * number:.2g} mm"


def choose_unit(largest: float, unit: Literal["m", "cm", "mm", "auto"], loaded: Loaded, where: str) -> tuple[Unit, str]:
    """The unit of a mesh whose largest side is so long, and a note that says why.

    Raises SaccadeError if the object would be too small or too large to be one.
    """
    given = unit != "auto"
    if unit == "auto":
        chosen, why = loaded.unit or _guess(largest, loaded.kind)
    else:
        chosen, why = unit, "as you said"
    size = largest * METRES[chosen]
    if not LIMITS_M[0] <= size <= LIMITS_M[1]:
        raise SaccadeError(_refusal(largest, chosen, where))
    others = [other for other in METRES if other != chosen and _is_household(largest * METRES[other])]
    doubt = "" if given or not others else "; if it is " + " or ".join(
        f"{in_metres(largest * METRES[other])}, give --unit {other}" for other in others)
    return chosen, f"The lengths are in {NAMES[chosen]}, {why}: the largest side is {in_metres(size)}{doubt}."


def _guess(largest: float, kind: str) -> tuple[Unit, str]:
    """Metres if that is the size of a household thing. Otherwise the unit that brings it nearest to the usual size; in
    STL files, which come from construction programs, millimetres if possible."""
    fitting = [unit for unit in METRES if _is_household(largest * METRES[unit])]
    if not fitting:
        possible = [unit for unit in METRES if LIMITS_M[0] <= largest * METRES[unit] <= LIMITS_M[1]]
        return (possible or ["m"])[0], "which is a guess, because it has the size of no household thing in any unit"
    if "m" in fitting:
        return "m", "which is a guess by its size"
    if kind == "STL" and "mm" in fitting:
        return "mm", "which is a guess by its size and because STL files mostly are"
    nearest = min(fitting, key=lambda unit: abs(np.log(largest * METRES[unit] / USUAL_M)))
    return nearest, "which is a guess by its size"


def _is_household(size_m: float) -> bool:
    return HOUSEHOLD_M[0] <= size_m <= HOUSEHOLD_M[1]


def _refusal(largest: float, unit: Unit, where: str) -> str:
    small = largest * METRES[unit] < LIMITS_M[0]
    bound = f"smaller than {in_metres(LIMITS_M[0])}" if small else f"larger than {in_metres(LIMITS_M[1])}"
    helping = [other for other in METRES if LIMITS_M[0] <= largest * METRES[other] <= LIMITS_M[1]]
    helping.sort(key=lambda other: not _is_household(largest * METRES[other]))
    size = in_metres(largest * METRES[unit]) if largest * METRES[unit] >= 1e-4 else f"{largest * METRES[unit]:.1g} m"
    told = f"mesh {where} is {size} large in {NAMES[unit]}, {bound}: "
    if helping:
        return told + f"give --unit {helping[0]}, which makes it {in_metres(largest * METRES[helping[0]])}"
    return told + "scale it to its true size in the program that made it"


def choose_up(corners: NDArray[np.float64], up: Literal["z", "y", "auto"], loaded: Loaded) -> tuple[str, str]:
    """The axis that points up in triangles [F, 3, 3], and a note that says why."""
    if up != "auto":
        return up, f"The axis {up} points up, as you said."
    if loaded.up is not None:
        axis, why = loaded.up
        return axis, f"The axis {axis} points up, {why}; if the object lies on its side, give --up z."
    points = corners.reshape(-1, 3)
    base = {"y": _base(points, 1), "z": _base(points, 2)}
    likely, other = loaded.likely_up, "y" if loaded.likely_up == "z" else "z"
    if base[other] > _CLEARLY * base[likely]:
        return other, (f"The axis {other} points up, which is a guess because the object has its broadest base there; "
                       f"if it lies on its side, give --up {likely}.")
    return likely, f"The axis {likely} points up, which is a guess; if the object lies on its side, give --up {other}."


def _base(points: NDArray[np.float64], axis: int) -> float:
    """How much of the box's bottom the lowest points span, if this axis points up: from 0 to 1. What lies on its side
    touches the table in a line, what stands does so with a base."""
    low, extents = points.min(0), np.ptp(points, axis=0)
    lowest = points[points[:, axis] <= low[axis] + _BOTTOM * extents[axis]]
    across = [side for side in range(3) if side != axis]
    return float(np.prod(np.ptp(lowest, axis=0)[across] / extents[across]))
