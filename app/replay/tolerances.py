"""How much a replay may differ from its recording. Every tolerance is listed here with its reason, and nowhere else.

On one machine and with the same weights every byte is equal, so that no tolerance is used.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Tolerance:
    """What is tolerated: |replayed - recorded| <= absolute + relative * |recorded|, for every number of a field. For a
    field of packed bits, `flipped` is used instead: the share of the bits that may differ. Of a set of points [N, 3]
    with a `spread`, the mean and the deviation are compared: they may differ by so many deviations more."""

    absolute: float
    relative: float
    reason: str
    flipped: float | None = None
    spread: float | None = None


EXACT = Tolerance(0.0, 0.0, "")
NETWORK = Tolerance(1e-3, 1e-3, "another processor's matrix products sum in another order, in single precision")
DERIVED = Tolerance(1e-2, 1e-2, "sums over the outputs of the networks")
CLOUD = Tolerance(2e-3, 0.0, "a few of the particles are drawn differently where a weight changes in its last digits")
SAMPLE = Tolerance(2e-3, 0.0, "where one particle is drawn differently, all after it get other noise: of 64, a mean "
                              "then moves by up to 0.2 of a deviation", spread=0.6)
CHOSEN = Tolerance(1e-3, 1e-3, "they follow from beliefs that differ in their last digits, on another processor")
MASK = Tolerance(0.0, 0.0, "7 of 60 x 60 cells, on the outline: rounding flips none, weights that differ by 0.1 % flip "
                           "one", flipped=0.002)

# By topic and field; "*" stands for every other field of numbers. A field that is not named must be equal.
TOLERANCES: dict[tuple[str, str], Tolerance] = {
    ("percept", "*"): NETWORK, ("goal_percept", "*"): NETWORK,
    ("percept", "pixel"): Tolerance(0.05, 0.0, "the tolerance of the networks, in an image of 480 pixels"),
    ("goal_percept", "pixel"): Tolerance(0.05, 0.0, "the tolerance of the networks, in an image of 480 pixels"),
    ("percept", "mask_bits"): MASK, ("goal_percept", "mask_bits"): MASK,
    ("percept", "reconstruction_error"): DERIVED, ("goal_percept", "reconstruction_error"): DERIVED,
    ("belief", "*"): DERIVED, ("belief", "mean_m"): CLOUD, ("belief", "covariance_m2"): CLOUD,
    ("belief", "particles_m"): SAMPLE, ("plan", "*"): CHOSEN, ("action", "*"): CHOSEN,
}

# Fields that are not compared in any topic, with the reason.
IGNORED = {"seq": "it numbers the messages of an episode, and a replay that begins later counts from there"}


def tolerance_of(topic: str, field: str) -> Tolerance:
    """Returns the tolerance of a field of a topic."""
    return TOLERANCES.get((topic, field)) or TOLERANCES.get((topic, "*")) or EXACT
