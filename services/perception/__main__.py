"""`python -m saccade.services.perception --config FILE`: frames and goals in, percepts out."""

from saccade.services.perception.core import SERVICE, build
from saccade.shared.loop.main import main

if __name__ == "__main__":
    main(SERVICE, build)
