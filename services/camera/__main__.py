"""`python -m saccade.services.camera --config FILE`: a real camera's frames, one a period."""

from saccade.shared.loop.main import main

main("camera")
