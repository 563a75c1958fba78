"""python -m saccade.tests.fakes.belief --config FILE"""

from saccade.shared.loop.main import run_module
from saccade.tests.fakes.services import module

run_module(module("belief"))
