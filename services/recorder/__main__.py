"""Runs the recorder, which writes every message into run.mcap: `python -m saccade.services.recorder --config FILE`."""

from saccade.services.recorder.core import main

if __name__ == "__main__":
    main()
