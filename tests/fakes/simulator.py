"""python -m saccade.tests.fakes.simulator --config FILE"""

from saccade.shared.loop.main import main
from saccade.tests.fakes.services import SERVICES, build

if __name__ == "__main__":
    main(SERVICES["simulator"], lambda config: build("simulator", config), source=True)
