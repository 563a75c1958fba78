"""`python -m services.perception --config FILE`: frames and goals in, percepts out."""

from services.perception.core import SERVICE, build
from shared.loop import main

if __name__ == "__main__":
    main(SERVICE, build)
