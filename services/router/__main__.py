"""python -m saccade.services.router --config FILE: a Zenoh router, where the other services meet."""

from saccade.services.router.core import main

if __name__ == "__main__":
    main()
