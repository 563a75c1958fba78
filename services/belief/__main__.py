"""`python -m saccade.services.belief --config FILE`: percepts in, beliefs out."""

from saccade.services.belief.core import SERVICE, build
from saccade.shared.loop.main import main

if __name__ == "__main__":
    main(SERVICE, build)
