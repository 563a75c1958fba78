"""python -m saccade.tests.fakes.evaluator --config FILE"""

from saccade.shared.loop.main import main
from saccade.tests.fakes.services import SERVICES, build

if __name__ == "__main__":
    main(SERVICES["evaluator"], lambda config: build("evaluator", config))
