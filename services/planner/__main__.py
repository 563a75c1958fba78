"""`python -m services.planner --config FILE`: beliefs in, plans and actions out."""

from services.planner.core import SERVICE, build
from shared.loop import main

if __name__ == "__main__":
    main(SERVICE, build)
