"""Runs the page that guides a hand: `python -m saccade.services.guide --config FILE`."""

from saccade.services.guide.live import main

if __name__ == "__main__":
    main()
