"""Runs a real camera, which publishes one frame per period: `python -m saccade.services.camera --config FILE`."""

from saccade.shared.loop.main import main

main("camera")
