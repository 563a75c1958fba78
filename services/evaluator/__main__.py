"""`python -m saccade.services.evaluator`: the evaluator as a process."""

from saccade.services.evaluator.core import SERVICE, build
from saccade.shared.loop.main import main

if __name__ == "__main__":
    main(SERVICE, build)
