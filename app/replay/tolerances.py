"""What a replay may differ in from its recording: here and nowhere else, each with its reason.

On one machine, with the same weights, nothing differs by a byte, and nothing here is made use of.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Tolerance:
    """|replayed - recorded| <= absolute + relative * |recorded|, for every number of a field. `flipped`: of a field of
    packed bits instead, the share of them that may be other ones."""

    absolute: float
    relative: float
    reason: str
    flipped: float | None = None


EXACT = Tolerance(0.0, 0.0, "")
NETWORK = Tolerance(1e-3, 1e-3, "another processor's matrix products sum in another order, in single precision")
DERIVED = Tolerance(1e-2, 1e-2, "sums over what the networks say")
CLOUD = Tolerance(2e-3, 0.0, "a few of the particles are drawn differently where a weight changes in its last digits")
CHOSEN = Tolerance(1e-3, 1e-3, "they follow from beliefs that differ in their last digits, on another processor")
MASK = Tolerance(0.0, 0.0, "cells on the outline, 7 of 60 x 60: rounding flips none, weights that are off by 0.1 % one",
                 flipped=0.002)

# By topic and field; "*" is every other field of numbers. What is not named must be equal.
TOLERANCES: dict[tuple[str, str], Tolerance] = {
    ("percept", "*"): NETWORK, ("goal_percept", "*"): NETWORK,
    ("percept", "pixel"): Tolerance(0.05, 0.0, "as the networks, at 480 pixels"),
    ("goal_percept", "pixel"): Tolerance(0.05, 0.0, "as the networks, at 480 pixels"),
    ("percept", "mask_bits"): MASK, ("goal_percept", "mask_bits"): MASK,
    ("percept", "reconstruction_error"): DERIVED, ("goal_percept", "reconstruction_error"): DERIVED,
    ("belief", "*"): DERIVED, ("belief", "mean_m"): CLOUD, ("belief", "particles_m"): CLOUD,
    ("belief", "covariance_m2"): CLOUD, ("plan", "*"): CHOSEN, ("action", "*"): CHOSEN,
}

# Fields that are not compared, of any topic.
IGNORED = {"seq": "it counts what was said in an episode: a replay that begins later counts from there"}


def tolerance_of(topic: str, field: str) -> Tolerance:
    """The tolerance of a field."""
    return TOLERANCES.get((topic, field)) or TOLERANCES.get((topic, "*")) or EXACT
