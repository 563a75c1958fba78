"""OpenCV, which is imported when it is first needed. It comes with the extra `camera`."""

from __future__ import annotations

import os
from typing import Any

from saccade.shared.errors import SaccadeError


def opencv(who: str, instead: str = "") -> Any:
    """Returns the module cv2. `who` needs it, such as "webcams need". Raises SaccadeError if it is not
    installed; `instead` names what works without it."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # quiet, because our own errors say what fails in one line
    try:
        import cv2
    except ImportError as error:
        raise SaccadeError(f"{who} OpenCV ({error}): pip install 'saccade[camera]'{instead}") from error
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    cv2.setNumThreads(1)  # every service uses one thread
    return cv2
