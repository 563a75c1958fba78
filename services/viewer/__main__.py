"""Runs the viewer, which shows a run in web browsers: `python -m saccade.services.viewer --config FILE`."""

from saccade.services.viewer.live import main

if __name__ == "__main__":
    main()
