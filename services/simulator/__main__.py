"""`python -m saccade.services.simulator --config FILE`: actions in, frames and the truth out."""

from saccade.shared.loop.main import main

main("simulator")
