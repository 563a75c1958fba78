"""python -m tests.fakes.simulator --config FILE"""

from shared.loop import main
from tests.fakes.services import SERVICES, build

if __name__ == "__main__":
    main(SERVICES["simulator"], lambda config: build("simulator", config), source=True)
