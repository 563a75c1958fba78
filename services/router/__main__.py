"""Runs the router, which connects the other services: `python -m saccade.services.router --config FILE`."""

from saccade.services.router.core import main

if __name__ == "__main__":
    main()
