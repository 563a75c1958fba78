"""The agent's decisions in words."""

from __future__ import annotations

from collections.abc import Iterable

from saccade.shared.bus.messages import Belief, Events, Plan, Result

SEEN = 0.5  # an object with at least this presence counts as seen
NEAR_M = 0.10  # nearer than this to the goal's viewpoint the camera turns as planned


def decision(plan: Plan, beliefs: Iterable[Belief]) -> str:
    """What the agent has decided, in words."""
    if plan.arrived:
        return "arrived at the goal's view"
    if plan.mode == "search":
        unseen = sorted(plain(belief.object) for belief in beliefs if belief.presence < SEEN)
        what = f"{', '.join(unseen)} unseen" if unseen else "all are seen, but their positions are uncertain"
        return f"look for the {plain(plan.target)}: {what}" if plan.target else f"explore: {what}"
    if plan.mode == "approach":
        return f"approach the {plain(plan.target)}: the goal's viewpoint is not known yet"
    if 0 <= plan.believed_distance_m < NEAR_M:
        return f"centre the {plain(plan.target)} as in the goal"
    return f"approach: the goal's view of the {plain(plan.target)}"


HAPPENED = {"moved": "was moved", "gone": "is gone", "back": "is back", "drifts": "drifts", "rests": "rests again"}


def happened(events: Events) -> list[str]:
    """What was noticed with one image, in words: a sentence for each event."""
    return [f"the {plain(name)} {HAPPENED.get(kind, kind)} ({100 * probability:.0f} %)"
            for name, kind, probability in zip(events.labels(), events.kinds, events.probabilities, strict=False)]


def ending(result: Result) -> str:
    """How an episode ended, in words."""
    how = "reached the goal" if result.success else "did not reach the goal"
    return f"{result.scene}: {how} in {result.steps} steps"


def plain(name: str) -> str:
    """An object's name in plain words: `005_tomato_soup_can` becomes `tomato soup can`."""
    return name.lstrip("0123456789_").replace("_", " ") or name
