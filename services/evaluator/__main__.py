"""Runs the evaluator, which turns the truth into results: `python -m saccade.services.evaluator --config FILE`."""

from saccade.shared.loop.main import main

main("evaluator")
