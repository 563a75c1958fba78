"""Candidate viewpoints: where they are drawn, and the likeliest view of the goal among them."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from saccade.services.planner.goal import Preference
from saccade.services.planner.place import Ground
from saccade.shared.bus.messages import Belief
from saccade.shared.world.geometry import Array, direction, unit, viewing_grid, wrap

NEAREST_GOAL_M = 0.1  # chosen: no candidate is nearer to the target than this
SPREAD_M = 0.10  # from the published code: standard deviation of the candidates' ranges around the goal's range
CELL_RAD = 0.045  # derived: half a cell of the viewing grid; a candidate's direction is drawn within its cell
SPREAD = 0.02  # chosen: relative standard deviation of the range of candidates that are drawn from the goal posterior
PEAK_ROWS = 2  # chosen: the posterior's peak is averaged over this many cells of elevation on each side
PEAK_COLUMNS = 4  # chosen: the posterior's peak is averaged over this many cells of azimuth on each side


def draw(beliefs: dict[str, Belief], preference: Preference | None, doubt: float, count: int, ground: Ground,
         rng: Generator) -> tuple[Array, Array]:
    """Draws the positions and the look-at points of N candidates, each [N, 3] (m, world).

    A third of the positions is drawn from the posterior over the goal's direction, a third at the goal's range, and
    a third anywhere. The look-at points are drawn from the particles. The goal's log posterior is divided by `doubt`.
    """
    watched = [beliefs[preference.target]] if preference is not None else list(beliefs.values())
    clouds = np.concatenate([belief.particles_m for belief in watched]).astype(np.float64)
    gazes = clouds[rng.integers(len(clouds), size=count)]
    eyes = ground.anywhere(rng, count)
    if preference is None:
        return eyes, gazes
    third, target = count // 3, beliefs[preference.target]
    reach = preference.range_m + rng.normal(0, SPREAD_M, third)
    away = unit(eyes[third:2 * third] - gazes[third:2 * third])
    eyes[third:2 * third] = gazes[third:2 * third] + np.maximum(reach, NEAREST_GOAL_M)[:, None] * away
    if target.goal_log_posterior is not None:
        probabilities = np.exp(target.goal_log_posterior.astype(np.float64) / doubt).ravel()
        cells = rng.choice(len(probabilities), size=third, p=probabilities / probabilities.sum())
        elevation, azimuth = viewing_grid()
        e, a = elevation[cells // len(azimuth)], azimuth[cells % len(azimuth)]
        away = direction(a + rng.uniform(-CELL_RAD, CELL_RAD, third), e + rng.uniform(-CELL_RAD, CELL_RAD, third))
        reach = preference.range_m * np.exp(rng.normal(0, SPREAD * doubt, third))
        gazes[:third] = target.mean_m
        eyes[:third] = gazes[:third] + reach[:, None] * away
    return eyes, gazes


def peak(center: Array, log_posterior: NDArray[np.float32], range_m: float) -> Array:
    """The camera position [3] at the goal's range in the direction of the posterior's peak.

    The peak is averaged over its neighbours in the grid. Azimuth and elevation are averaged separately, because near
    the pole two positions may be neighbours although their images are rotated by half a turn.
    """
    elevation, azimuth = viewing_grid()
    fine = log_posterior.astype(np.float64)
    row, column = map(int, np.unravel_index(np.argmax(fine), fine.shape))
    rows = np.arange(max(row - PEAK_ROWS, 0), min(row + PEAK_ROWS + 1, len(elevation)))
    columns = np.arange(column - PEAK_COLUMNS, column + PEAK_COLUMNS + 1) % len(azimuth)
    mass = np.exp(fine[np.ix_(rows, columns)] - fine[row, column])
    mass /= mass.sum()
    mean_azimuth = azimuth[column] + (mass * wrap(azimuth[columns] - azimuth[column])).sum()
    mean_elevation = (mass * elevation[rows][:, None]).sum()
    return center + range_m * direction(mean_azimuth, mean_elevation)
