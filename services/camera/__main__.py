"""`python -m saccade.services.camera --config FILE`: a real camera's frames, one a period."""

from saccade.services.camera.core import SERVICE, build
from saccade.shared.loop.main import main

if __name__ == "__main__":
    main(SERVICE, build, source=True)
