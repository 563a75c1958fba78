"""python -m tests.fakes.planner --config FILE"""

from shared.loop import main
from tests.fakes.services import SERVICES, build

if __name__ == "__main__":
    main(SERVICES["planner"], lambda config: build("planner", config))
