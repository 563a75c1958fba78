"""python -m services.viewer --config FILE: what the agent sees, believes and plans, for browsers."""

from services.viewer.live import main

if __name__ == "__main__":
    main()
