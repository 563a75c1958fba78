"""Runs perception, which turns frames into percepts: `python -m saccade.services.perception --config FILE`."""

from saccade.shared.loop.main import main

main("perception")
