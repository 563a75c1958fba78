"""`python -m services.evaluator`: the evaluator as a process."""

from services.evaluator.core import SERVICE, build
from shared.loop import main

if __name__ == "__main__":
    main(SERVICE, build)
