"""python -m saccade.tests.fakes.perception --config FILE"""

from saccade.shared.loop.main import run_module
from saccade.tests.fakes.services import module

run_module(module("perception"))
