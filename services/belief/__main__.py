"""`python -m services.belief --config FILE`: percepts in, beliefs out."""

from services.belief.core import SERVICE, build
from shared.loop import main

if __name__ == "__main__":
    main(SERVICE, build)
