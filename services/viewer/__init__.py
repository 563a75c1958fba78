"""The viewer: it shows in Rerun what the agent sees, believes and plans."""

from saccade.shared.bus.topics import BELIEF, FRAME, GOAL, PERCEPT, PLAN, RESULT, STATUS, TRUTH

SHOWN = (FRAME, GOAL, PERCEPT, BELIEF, PLAN, TRUTH, RESULT, STATUS)  # the topics that a viewer receives
