"""python -m tests.fakes.belief --config FILE"""

from shared.loop import main
from tests.fakes.services import SERVICES, build

if __name__ == "__main__":
    main(SERVICES["belief"], lambda config: build("belief", config))
