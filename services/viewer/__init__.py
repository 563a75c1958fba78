"""The viewer: it shows in Rerun what the agent sees, believes and plans."""

from saccade.shared.bus.topics import BELIEF, EVENTS, FRAME, GOAL, PERCEPT, PLAN, RESULT, STATUS, TRUTH

SHOWN = (FRAME, GOAL, PERCEPT, BELIEF, EVENTS, PLAN, TRUTH, RESULT, STATUS)  # the topics that a viewer receives
