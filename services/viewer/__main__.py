"""python -m saccade.services.viewer --config FILE: what the agent sees, believes and plans, for browsers."""

from saccade.services.viewer.live import main

if __name__ == "__main__":
    main()
