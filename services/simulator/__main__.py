"""`python -m services.simulator`: the simulator as a process."""

from services.simulator.core import SERVICE, build
from shared.loop import main

if __name__ == "__main__":
    main(SERVICE, build, source=True)
