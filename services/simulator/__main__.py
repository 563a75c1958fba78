"""Runs the simulator, which moves and renders the camera: `python -m saccade.services.simulator --config FILE`."""

from saccade.shared.loop.main import main

main("simulator")
