from saccade.shared.bus.topics import BELIEF, FRAME, GOAL, PERCEPT, PLAN, RESULT, STATUS, TRUTH

SHOWN = (FRAME, GOAL, PERCEPT, BELIEF, PLAN, TRUTH, RESULT, STATUS)  # what a viewer hears
