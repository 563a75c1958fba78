"""Runs the planner, which turns beliefs into plans and actions: `python -m saccade.services.planner --config FILE`."""

from saccade.shared.loop.main import main

main("planner")
