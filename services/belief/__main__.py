"""`python -m saccade.services.belief --config FILE`: percepts in, beliefs out."""

from saccade.shared.loop.main import main

main("belief")
