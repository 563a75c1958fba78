"""An agent that walks at random, to compare with: `saccade bench --agent random-walk`."""

from saccade.services.planner.baselines import SERVICE, Blind
from saccade.shared.config import Config

__all__ = ["SERVICE", "build"]


def build(config: Config) -> Blind:
    """Creates the core from a run's configuration. Its steps are as long as the planner's (`planner.step_m`)."""
    return Blind(config, walks=True)
