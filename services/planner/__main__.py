"""`python -m saccade.services.planner --config FILE`: beliefs in, plans and actions out."""

from saccade.shared.loop.main import main

main("planner")
