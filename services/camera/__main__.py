"""`python -m services.camera --config FILE`: a real camera's frames, one a period."""

from services.camera.core import SERVICE, build
from shared.loop import main

if __name__ == "__main__":
    main(SERVICE, build, source=True)
