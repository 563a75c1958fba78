"""python -m saccade.services.recorder --config FILE: every message of the world into run.mcap."""

from saccade.services.recorder.core import main

if __name__ == "__main__":
    main()
