"""Runs the belief service, which turns percepts into beliefs: `python -m saccade.services.belief --config FILE`."""

from saccade.shared.loop.main import main

main("belief")
