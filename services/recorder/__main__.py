"""python -m services.recorder --config FILE: every message of the world into run.mcap beside the configuration."""

from services.recorder.core import main

if __name__ == "__main__":
    main()
