"""python -m saccade.tests.fakes.planner --config FILE"""

from saccade.shared.loop.main import main
from saccade.tests.fakes.services import SERVICES, build

if __name__ == "__main__":
    main(SERVICES["planner"], lambda config: build("planner", config))
