"""The core of the evaluator: it receives the simulator's truth and gives one result per episode."""

from __future__ import annotations

from saccade.shared.bus.messages import Result, Truth
from saccade.shared.bus.topics import RESULT, TRUTH, Output
from saccade.shared.config import Config
from saccade.shared.loop.service import Inputs, Service
from saccade.shared.world.task import errors

SERVICE = Service("evaluator", inputs=(TRUTH,), trigger=TRUTH, outputs=(RESULT,))


class Evaluator:
    """Gives the result of an episode when the episode's last truth arrives, by the paper's measures (section 4.2)."""

    def begin(self, run: str, episode: int) -> list[Output]:
        """Does nothing, because the last truth of an episode is enough for its result. Nothing is published."""
        return []

    def step(self, inputs: Inputs) -> list[Output]:
        """Returns the result if the episode is over, otherwise nothing."""
        truth: Truth = inputs["truth"]
        return [Output(RESULT, result_of(truth))] if truth.done else []


def result_of(truth: Truth) -> Result:
    """The result of an episode whose last truth is `truth`. The errors are those of the last camera position.

    For a symmetric target they are those to the nearest view that looks like the goal image, which the truth tells.
    """
    azimuth, elevation, distance = errors(truth.world_from_camera[:3, 3], truth.goal_world_from_camera[:3, 3],
                                          truth.target_center_m)
    return Result(run=truth.run, episode=truth.episode, step=truth.step, scene=truth.scene, target=truth.target,
                  objects=len(truth.names), success=truth.success, steps=truth.step, azimuth_error_rad=azimuth,
                  elevation_error_rad=elevation, range_error_m=distance, declared=truth.declared,
                  declared_true=truth.declared_true)


def build(config: Config) -> Evaluator:
    """Creates the evaluator. It uses no key of the configuration."""
    return Evaluator()
