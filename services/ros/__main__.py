"""Runs the bridge to ROS 2: `python -m saccade.services.ros --config FILE`."""

from saccade.services.ros.bridge import main

if __name__ == "__main__":
    main()
