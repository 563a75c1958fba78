"""`python -m saccade.services.simulator`: the simulator as a process."""

from saccade.services.simulator.core import SERVICE, build
from saccade.shared.loop.main import main

if __name__ == "__main__":
    main(SERVICE, build, source=True)
