"""How networks imagine an object: as it is seen, and as it would be seen from elsewhere.

Networks with latent poses decode them; the transition moves a latent pose to another viewpoint (paper, section 3.2).
Networks that know objects by their views show the nearest of these.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from saccade.shared.bus.messages import Belief, Percept
from saccade.shared.model.bank import FILLED
from saccade.shared.model.drawing import BankPictures, LatentDecoder, drawn
from saccade.shared.model.latent import LatentTransition
from saccade.shared.model.weights import ObjectCard, Weights
from saccade.shared.world.geometry import pixel_rays, rotation_towards, spherical, unit, wrap

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Drawn:
    """A crop [64, 64, 3] of an object, and how it lies: its side in metres, where its middle is from the object's
    [2] (right, down, in half sides), and by what angle it is rolled (rad)."""

    crop: Image
    side_m: float
    middle: Array
    roll_rad: float

    def place(self, at: Array) -> Array:
        """The places on the crop of places `at` [..., 2] around the object, both in half sides."""
        cos, sin = np.cos(self.roll_rad), np.sin(self.roll_rad)
        turned: Array = at @ np.array([[cos, -sin], [sin, cos]])
        return turned - self.middle


class Artist(Protocol):
    """Draws one object."""

    def __init__(self, weights: Weights, card: ObjectCard) -> None: ...

    def as_seen(self, percept: Percept) -> Image:
        """The object as the percept says that it is seen [64, 64, 3]."""

    def moved(self, viewpoint: Array, belief: Belief, seen: Percept) -> Drawn:
        """The object as it would be seen from a viewpoint [4, 4], by a belief and the last percept that saw it."""


class LatentArtist:
    """Decodes latent poses. Raises SaccadeError if the weights are missing or damaged."""

    def __init__(self, weights: Weights, card: ObjectCard) -> None:
        self.card = card
        self._decoder, self._transition = LatentDecoder(weights, card.name), LatentTransition(weights, card.name)

    def as_seen(self, percept: Percept) -> Image:
        """The mean of the percept's latent pose, decoded."""
        return drawn(self._decoder, percept.latent_mean)

    def moved(self, viewpoint: Array, belief: Belief, seen: Percept) -> Drawn:
        """The latent pose of the percept, moved to the viewpoint and decoded."""
        azimuth, elevation, _ = spherical(np.stack([seen.world_from_camera[:3, 3], viewpoint[:3, 3]]), belief.mean_m)
        by = np.array([[wrap(azimuth[1] - azimuth[0]), elevation[1] - elevation[0]]])
        latent = self._transition(seen.latent_mean, by)[0][0]
        return Drawn(drawn(self._decoder, latent), self.card.crop_side_m, np.zeros(2), 0.0)


class BankArtist:
    """Shows views of a bank. Raises SaccadeError if the bank is missing or damaged."""

    def __init__(self, weights: Weights, card: ObjectCard) -> None:
        self._pictures = BankPictures(weights, card.name)

    def as_seen(self, percept: Percept) -> Image:
        """The view from the likeliest direction."""
        return self._pictures.picture(-rotation_of(percept).T @ pixel_rays(percept.pixel, percept.intrinsics_px))

    def moved(self, viewpoint: Array, belief: Belief, seen: Percept) -> Drawn:
        """The view from where the viewpoint would be, if the object is turned as the percept says."""
        world_from_object = seen.world_from_camera[:3, :3] @ rotation_of(seen)
        away = viewpoint[:3, 3] - belief.mean_m
        view = self._pictures.nearest(world_from_object.T @ unit(away))
        right, down, radius_m = self._pictures.bank.circles_m[view]
        # The top of the view as the viewpoint's upright crop shows it.
        towards = rotation_towards(-away)
        top = towards.T @ world_from_object @ rotation_towards(-self._pictures.bank.directions[view])[:, 1]
        side_m = 2 * radius_m / FILLED
        return Drawn(self._pictures.view(view), float(side_m), 2 * np.array([right, down]) / side_m,
                     float(np.arctan2(top[0], top[1])))


def rotation_of(percept: Percept) -> Array:
    """The likeliest rotation camera_from_object [3, 3]; none at all if the percept tells no rotation."""
    if percept.rotations is not None and len(percept.rotations):
        return np.asarray(percept.rotations[0])
    return np.eye(3) if percept.camera_from_object is None else np.asarray(percept.camera_from_object[:3, :3])


ARTISTS: dict[str, type[Artist]] = {"default": LatentArtist, "paper": LatentArtist, "open": BankArtist}
