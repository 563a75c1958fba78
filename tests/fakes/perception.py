"""python -m saccade.tests.fakes.perception --config FILE"""

from saccade.shared.loop.main import main
from saccade.tests.fakes.services import SERVICES, build

if __name__ == "__main__":
    main(SERVICES["perception"], lambda config: build("perception", config))
