"""python -m tests.fakes.perception --config FILE"""

from shared.loop import main
from tests.fakes.services import SERVICES, build

if __name__ == "__main__":
    main(SERVICES["perception"], lambda config: build("perception", config))
