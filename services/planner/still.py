"""An agent that stands still, to compare with: `saccade bench --agent still`."""

from saccade.services.planner.baselines import SERVICE, Blind
from saccade.shared.config import Config

__all__ = ["SERVICE", "build"]


def build(config: Config) -> Blind:
    """Creates the core from a run's configuration."""
    return Blind(config, walks=False)
