"""Numbers over steps."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import rerun as rr

from services.viewer.layout import Colour
from shared.messages import Belief, Plan, Status, Truth

F_TERMS = ("pose", "identity", "crop", "position", "likelihood")
G_TERMS = ("position", "scale", "pose", "information")
TOTAL: Colour = (230, 230, 230)
SMALLEST_M2 = 1e-8  # variance below which nothing is known more exactly


class Curves:
    """Logs scalars; the series of an object has the object's colour."""

    def __init__(self, recording: rr.RecordingStream, colour_of: Callable[[str], Colour]) -> None:
        self._to, self._colour_of = recording, colour_of
        self._styled: set[str] = set()
        for origin in ("F", "G"):
            self._to.log(f"{origin}/total", rr.SeriesLines(colors=[TOTAL], widths=[2.5], names="total"), static=True)

    def beliefs(self, beliefs: Iterable[Belief]) -> None:
        """Of all objects at one step: entropy and presence of each, the terms of F of all."""
        beliefs = list(beliefs)
        for belief in beliefs:
            self._of_object("entropy", belief.object, entropy_nats(belief))
            self._of_object("presence", belief.object, belief.presence)
        for term in F_TERMS:
            self._number(f"F/{term}", sum(getattr(belief, f"f_{term}") for belief in beliefs))
        self._number("F/total", sum(belief.free_energy for belief in beliefs))

    def plan(self, plan: Plan) -> None:
        """The terms of G of the chosen viewpoint, and how far the goal is believed to be."""
        for term in G_TERMS:
            self._number(f"G/{term}", getattr(plan, f"g_{term}"))
        self._number("G/total", plan.g)
        if plan.believed_distance_m >= 0:
            self._number("distance/believed", plan.believed_distance_m)

    def truth(self, truth: Truth) -> None:
        """How far the goal is."""
        apart = (truth.world_from_camera - truth.goal_world_from_camera)[:3, 3]
        self._number("distance/true", float(np.linalg.norm(apart)))

    def status(self, status: Status) -> None:
        """What a service's last step took, and what it did not get or left out."""
        if status.milliseconds > 0:
            self._number(f"milliseconds/{status.service}", status.milliseconds)
        self.dropped(status.service, status.skipped + status.gaps)

    def dropped(self, service: str, count: int) -> None:
        """Messages that a service has not taken so far."""
        self._number(f"dropped/{service}", count)

    def _of_object(self, what: str, name: str, value: float) -> None:
        path = f"{what}/{rr.escape_entity_path_part(name)}"
        if path not in self._styled:
            self._styled.add(path)
            self._to.log(path, rr.SeriesLines(colors=[self._colour_of(name)], names=name), static=True)
        self._number(path, value)

    def _number(self, path: str, value: float) -> None:
        self._to.log(path, rr.Scalars(float(value)))


def entropy_nats(belief: Belief) -> float:
    """Differential entropy of the position's Gaussian."""
    covariance = belief.covariance_m2 + np.eye(3) * SMALLEST_M2
    return float(0.5 * np.linalg.slogdet(2 * np.pi * np.e * covariance)[1])
