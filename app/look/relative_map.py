"""A map from pictures of which nothing is known: no poses, no board. The known objects give it, by their sizes.

Each picture tells where its objects are, seen from its camera. Where two pictures have three objects in common, the
cameras are placed so that these lie at the same places. The map's axes are those of the first picture's camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from saccade.app.look.sights import Look
from saccade.shared.world.geometry import Array, pixel_rays, pose

LEAST_COMMON = 3  # objects in common that place a picture
LEAST_SPREAD_M = 0.02  # chosen: objects that are nearer to one line than this do not tell a rotation
MOST_APART_M = 0.10  # chosen: a picture whose objects lie farther from the map's (root mean square) is not believed


@dataclass(frozen=True)
class RelativeMap:
    """Objects and cameras in the axes of the first picture's camera (OpenGL: x right, y up, z backward; metres).

    `places` [3] are the means over the pictures, by the objects' names. `cameras` [4, 4] map each camera to the map,
    by the number of the picture; what is not in it could not be placed, and `why_not` says why. `apart_m` is how far
    an object's places by single pictures are from their mean (root mean square), None if no object is in two of them.
    """

    places: dict[str, Array]
    cameras: dict[int, Array]
    why_not: dict[int, str]
    apart_m: float | None

    def worth(self, pictures: int) -> str:
        """One line that says what the map is worth."""
        scale = "the scale is that of the objects' sizes, and nothing checks it"
        if self.apart_m is None:
            return (f"map: {len(self.places)} objects by one picture alone, each by its size in it; no other picture "
                    f"checks them, and {scale}")
        return (f"map: {len(self.places)} objects by {len(self.cameras)} of {pictures} pictures, which put an object "
                f"{100 * self.apart_m:.1f} cm from its mean place (rms), and so a camera wrong by about "
                f"{100 * self.cameras_apart_m:.0f} cm; {scale}. It tells what is beside what, and is no substitute for "
                "poses")

    @property
    def cameras_apart_m(self) -> float:
        """About how far the cameras are wrong (metres): the error of the places turns the camera around objects that
        are near to one line, and it is far from them."""
        points = np.array([*self.places.values()])
        away_m = np.mean([np.linalg.norm(camera[:3, 3] - points.mean(0)) for camera in self.cameras.values()])
        return float(self.apart_m or 0.0) * (1.0 + float(away_m) / max(_spread(points), LEAST_SPREAD_M))

    def entry(self, names: Sequence[str]) -> dict[str, Any]:
        """The map as JSON: objects by name, cameras by the pictures' `names`."""
        return {"axes": "the first picture's camera: x right, y up, z backward; metres",
                "objects": {name: place.round(4).tolist() for name, place in sorted(self.places.items())},
                "cameras": {names[k]: camera.round(6).tolist() for k, camera in self.cameras.items()},
                "left_out": {names[k]: why for k, why in self.why_not.items()},
                "apart_m": None if self.apart_m is None else round(self.apart_m, 4)}


def places_in(look: Look) -> dict[str, Array]:
    """Where the objects that are seen in a picture are [3] in its camera's axes (metres), by name."""
    photo = look.photo
    share = np.tile(np.array(photo.size_px) / photo.rgb.shape[1::-1], 2)
    intrinsics = np.array(photo.intrinsics_px) * share
    return {sight.name: sight.range_m * pixel_rays(sight.pixel, intrinsics) for sight in look.sights if sight.is_seen}


def map_of(pictures: Sequence[dict[str, Array]]) -> RelativeMap:
    """The map from what each picture tells alone (see `places_in`). The first that shows an object begins it. Pictures
    that cannot be placed yet are tried again when others have added objects."""
    first = next((k for k, seen in enumerate(pictures) if seen), None)
    if first is None:
        return RelativeMap({}, {}, dict.fromkeys(range(len(pictures)), "it shows no known object"), None)
    cameras, why_not = {first: np.eye(4)}, dict[int, str]()
    waiting = [k for k in range(len(pictures)) if k != first]
    while waiting:
        means, left = _means(pictures, cameras), []
        for k in waiting:
            placed = _placed(pictures[k], means)
            if isinstance(placed, str):
                why_not[k] = placed
                left.append(k)
            else:
                cameras[k] = placed
                why_not.pop(k, None)
                means = _means(pictures, cameras)
        if len(left) == len(waiting):
            break
        waiting = left
    means = _means(pictures, cameras)
    offsets = [_moved(cameras[k], place) - means[name] for k in cameras for name, place in pictures[k].items()
               if sum(name in pictures[other] for other in cameras) > 1]
    apart_m = float(np.sqrt(np.mean(np.sum(np.square(offsets), axis=1)))) if offsets else None
    return RelativeMap(means, dict(sorted(cameras.items())), why_not, apart_m)


def _means(pictures: Sequence[dict[str, Array]], cameras: dict[int, Array]) -> dict[str, Array]:
    found: dict[str, list[Array]] = {}
    for k, camera in cameras.items():
        for name, place in pictures[k].items():
            found.setdefault(name, []).append(_moved(camera, place))
    return {name: np.mean(places, axis=0) for name, places in found.items()}


def _moved(camera: Array, place: Array) -> Array:
    return np.asarray(camera[:3, :3] @ place + camera[:3, 3])


def _placed(seen: dict[str, Array], means: dict[str, Array]) -> Array | str:
    """The camera's pose [4, 4] in the map, by the objects in common, or why there is none."""
    common = sorted(set(seen) & set(means))
    if len(common) < LEAST_COMMON:
        return f"it has {len(common)} objects in common with the map, and {LEAST_COMMON} are needed"
    here, there = np.array([seen[name] for name in common]), np.array([means[name] for name in common])
    if _spread(here) < LEAST_SPREAD_M or _spread(there) < LEAST_SPREAD_M:
        return "the objects in common lie on one line, which tells no rotation"
    camera = _rigid(here, there)
    apart_m = float(np.sqrt(np.mean(np.sum((here @ camera[:3, :3].T + camera[:3, 3] - there) ** 2, axis=1))))
    if apart_m > MOST_APART_M:
        return f"its objects lie {100 * apart_m:.0f} cm from where the map has them: did something move?"
    return camera


def _spread(points: Array) -> float:
    """How far points [N, 3] are from one line (root mean square)."""
    return float(np.linalg.svd(points - points.mean(0), compute_uv=False)[1] / np.sqrt(len(points)))


def _rigid(here: Array, there: Array) -> Array:
    """The pose [4, 4] that moves points [N, 3] onto others best (Kabsch, 1976)."""
    u, _, vt = np.linalg.svd((there - there.mean(0)).T @ (here - here.mean(0)))
    turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return pose(turn, there.mean(0) - turn @ here.mean(0))
