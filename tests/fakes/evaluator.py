"""python -m tests.fakes.evaluator --config FILE"""

from shared.loop import main
from tests.fakes.services import SERVICES, build

if __name__ == "__main__":
    main(SERVICES["evaluator"], lambda config: build("evaluator", config))
