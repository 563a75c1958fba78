"""An arm in the simulator's place: it takes the topic `action`, moves the camera in its hand, and gives the frames.

PYTHONPATH=examples saccade run --set services.source=arm
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from saccade.services.simulator.core import SERVICE as SIMULATOR
from saccade.services.simulator.core import Simulator
from saccade.services.simulator.core import build as build_simulator
from saccade.shared.bus.topics import Output
from saccade.shared.config import Config
from saccade.shared.loop.service import Inputs
from saccade.shared.world.geometry import euler_xyz
from saccade.shared.world.task import apply_action, clip

from .arm import Arm

SERVICE = SIMULATOR  # the same topics
SECONDS = 0.6  # the time that the arm has for one action


class ArmedSimulator:
    """The simulator's table and rules, with a camera that an arm moves. It goes where the joints bring it, which is
    about where the action asks for."""

    def __init__(self, table: Simulator) -> None:
        self.table, self.arm = table, Arm()

    @property
    def episodes(self) -> int:
        """The number of episodes."""
        return self.table.episodes

    def begin(self, run: str, episode: int) -> list[Output]:
        """Begins with the arm where the task begins."""
        outputs = self.table.begin(run, episode)
        self.arm.put(self.table.state.camera)
        return outputs

    def step(self, inputs: Inputs) -> Iterable[Output]:
        """Carries out an action: the wanted pose of the camera is the aim of the joints' position control."""
        action, state = inputs["action"], self.table.state
        if not state.done:
            before = state.camera
            wanted = apply_action(before, action.translation_m, action.rotation_rad)
            wanted[:3, 3] = clip(wanted[:3, 3], state.spheres)  # the arm may not hit an object either
            self.arm.move(wanted, SECONDS)
            after = self.arm.camera
            action = replace(action, translation_m=after[:3, 3] - before[:3, 3],
                             rotation_rad=euler_xyz(after[:3, :3] @ before[:3, :3].T))
        return self.table.step({"action": action})


def build(config: Config) -> ArmedSimulator:
    """Creates the core from a run's configuration."""
    return ArmedSimulator(build_simulator(config))
