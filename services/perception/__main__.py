"""`python -m saccade.services.perception --config FILE`: frames and goals in, percepts out."""

from saccade.shared.loop.main import main

main("perception")
