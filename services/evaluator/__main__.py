"""`python -m saccade.services.evaluator --config FILE`: the truth in, results out."""

from saccade.shared.loop.main import main

main("evaluator")
