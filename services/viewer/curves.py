"""Curves: numbers over the steps of a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import rerun as rr

from saccade.services.viewer.layout import Colour
from saccade.shared.bus.messages import Belief, Plan, Status, Truth

F_TERMS: dict[str, Colour] = {"total": (230, 230, 230), "pose": (86, 156, 214), "identity": (78, 201, 176),
                              "crop": (181, 137, 0), "position": (106, 90, 205), "likelihood": (206, 120, 80)}
G_TERMS: dict[str, Colour] = {"total": (230, 230, 230), "position": (106, 90, 205), "scale": (78, 201, 176),
                              "pose": (86, 156, 214), "information": (206, 120, 80)}
DISTANCES: dict[str, Colour] = {"believed": (255, 200, 0), "true": (230, 30, 230)}
SMALLEST_M2 = 1e-8  # variance that is added to a position's covariance, so that its entropy is finite


class Curves:
    """Logs numbers. Several series share one entity, because each entity makes drawing slower."""

    def __init__(self, recording: rr.RecordingStream, names: Sequence[str],
                 colour_of: Callable[[str], Colour]) -> None:
        self._to, self._names = recording, tuple(names)
        self._dropped: dict[str, int] = {}
        objects = {name: colour_of(name) for name in names}
        for path, series in {"F": F_TERMS, "G": G_TERMS, "entropy": objects, "presence": objects}.items():
            widths = [2.5 if name == "total" else 1.5 for name in series]
            self._to.log(path, rr.SeriesLines(names=list(series), colors=list(series.values()), widths=widths),
                         static=True)
        for name, colour in DISTANCES.items():
            self._to.log(f"distance/{name}", rr.SeriesLines(names=name, colors=colour), static=True)

    def beliefs(self, beliefs: dict[str, Belief]) -> None:
        """Logs the entropy and presence of each object at one step, and the terms of F summed over the objects."""
        known = [beliefs.get(name) for name in self._names]
        self._numbers("entropy", [np.nan if belief is None else entropy_nats(belief) for belief in known])
        self._numbers("presence", [np.nan if belief is None else belief.presence for belief in known])
        self._numbers("F", [sum(belief.free_energy if term == "total" else getattr(belief, f"f_{term}")
                                for kind in beliefs.values() for belief in kind.each()) for term in F_TERMS])

    def plan(self, plan: Plan) -> None:
        """Logs the terms of G of the chosen viewpoint, and the believed distance to the goal (m)."""
        self._numbers("G", [plan.g if term == "total" else getattr(plan, f"g_{term}") for term in G_TERMS])
        if plan.believed_distance_m >= 0:
            self._numbers("distance/believed", [plan.believed_distance_m])

    def truth(self, truth: Truth) -> None:
        """Logs the true distance to the goal (m)."""
        apart = (truth.world_from_camera - truth.goal_world_from_camera)[:3, 3]
        self._numbers("distance/true", [float(np.linalg.norm(apart))])

    def status(self, status: Status) -> None:
        """Logs how long the last step of a service took, and how many messages it has missed or skipped."""
        if status.milliseconds > 0:
            self._numbers(f"milliseconds/{status.service}", [status.milliseconds])
        self.dropped(status.service, status.skipped + status.gaps)

    def dropped(self, service: str, count: int) -> None:
        """Logs how many messages a service has missed or skipped so far."""
        if self._dropped.get(service) != count:
            self._dropped[service] = count
            self._numbers(f"dropped/{service}", [count])

    def _numbers(self, path: str, values: Sequence[float]) -> None:
        self._to.log(path, rr.Scalars(values))


def entropy_nats(belief: Belief) -> float:
    """Differential entropy of the position's Gaussian, in nats (positions in metres)."""
    covariance = belief.covariance_m2 + np.eye(3) * SMALLEST_M2
    return float(0.5 * np.linalg.slogdet(2 * np.pi * np.e * covariance)[1])
