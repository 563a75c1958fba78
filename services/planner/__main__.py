"""`python -m saccade.services.planner --config FILE`: beliefs in, plans and actions out."""

from saccade.services.planner.core import SERVICE, build
from saccade.shared.loop.main import main

if __name__ == "__main__":
    main(SERVICE, build)
