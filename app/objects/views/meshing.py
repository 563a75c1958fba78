"""Makes a mesh from pictures around an object."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from saccade.app.objects.learning import SIZES_M
from saccade.app.objects.views.colouring import coloured_parts
from saccade.app.objects.views.hull import hull_of
from saccade.app.objects.views.pictures import Told
from saccade.app.objects.views.reading import FEWEST, views_of
from saccade.app.objects.views.view import directions_of
from saccade.shared.errors import SaccadeError
from saccade.shared.render.foreign_mesh import joined_mesh
from saccade.shared.render.mesh import Mesh
from saccade.shared.world.geometry import Array, direction, fibonacci_sphere

NEAR_RAD = np.radians(30)  # a view shows what lies so near to its direction well
AROUND = 0.75  # of the directions around must be seen
STEEP_RAD, LOW_RAD = np.radians(75), np.radians(25)  # of views: from above; low enough to tell a height
BELOW_RAD, ABOVE_RAD = np.radians(-20), np.radians(20)  # of a view that shows the underside; of one that shows the top
SAMPLES = 500  # directions


@dataclass(frozen=True)
class FromViews:
    """A mesh, in how many views it was seen, from which share of all directions, and sentences for the user."""

    mesh: Mesh
    views: int
    seen: float
    notes: tuple[str, ...]


def mesh_from_views(source: Path, name: str, told: Told, masks: Path | None = None) -> FromViews:
    """Makes the mesh of an object from a folder of pictures or a video. It is upright as the poses' world, and the
    centre of its box is at the origin.

    Raises SaccadeError, in one line that says what to do, if the pictures, the poses or the masks cannot be used, if
    they show too little of the object, or if its size is none that an object has.
    """
    views = views_of(source, told, masks)
    hull = hull_of(views)
    low, high = hull.points_m.min(0), hull.points_m.max(0)
    largest = float((high - low).max())
    if not SIZES_M[0] <= largest <= SIZES_M[1]:
        size = f"{largest:.3g} m" if largest >= 1 else f"{1000 * largest:.3g} mm"
        raise SaccadeError(f"object {name!r} would be {size} large: give --scale, the length in metres of the "
                           "unit of the poses")
    directions = directions_of(hull.views, (low + high) / 2)
    around = _around(directions)
    if len(hull.views) < FEWEST or around < AROUND:
        raise SaccadeError(f"the {len(hull.views)} pictures that can be used show the object from {around:.0%} of the "
                           "directions around it: go all around it, and look at the poses with `saccade poses show`")
    parts, coloured = coloured_parts(hull)
    seen = float(((fibonacci_sphere(SAMPLES) @ directions.T).max(1) > np.cos(NEAR_RAD)).mean())
    left = len(views) - len(hull.views)
    notes = [f"It was made from {len(hull.views)} pictures, which show it from {seen:.0%} of all directions.",
             *([f"{left} pictures are left out, because their outlines do not fit the others."] if left else []),
             *_unseen(np.arcsin(directions[:, 2])),
             *([f"{1 - coloured:.0%} of its surface is in no picture and has the colours beside it."]
               if coloured < 0.995 else [])]
    mesh = joined_mesh(parts, name, 1.0, "z", source)
    return FromViews(mesh, len(hull.views), seen, (*told.notes, *notes))


def _around(directions: Array) -> float:
    """The share of the azimuths that lie near one of these directions [V, 3]."""
    level = directions[np.abs(directions[:, 2]) < np.sin(STEEP_RAD)]
    if not len(level):
        return 0.0
    flat = level[:, :2] / np.linalg.norm(level[:, :2], axis=1, keepdims=True)
    azimuths = direction(np.linspace(-np.pi, np.pi, 360, endpoint=False), 0.0)[:, :2]
    return float(((azimuths @ flat.T).max(1) > np.cos(NEAR_RAD)).mean())


def _unseen(elevations_rad: Array) -> list[str]:
    """Sentences about what no view from these elevations [V] shows."""
    lines = []
    if elevations_rad.min() > BELOW_RAD:
        lines.append("Its underside was not seen: it is taken to be flat.")
    if elevations_rad.max() < ABOVE_RAD:
        lines.append("Its top was not seen: it is taken to be flat. Film it from above too.")
    if elevations_rad.min() > LOW_RAD:
        lines.append("It was seen from high above only: if it is round at its top, its height is too small. Film it "
                     "from its own height too.")
    return lines
