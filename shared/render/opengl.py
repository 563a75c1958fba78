"""Chooses an OpenGL backend that works without a screen. MuJoCo reads this choice once, when it is imported."""

from __future__ import annotations

import ctypes.util
import os

from saccade.shared.errors import SaccadeError

HOW_TO_MEND = ("no OpenGL without a screen: install libosmesa6 (Debian, Ubuntu: `sudo apt-get install libosmesa6`) "
               "or a driver with EGL, or set MUJOCO_GL to the one you have")


def choose_backend() -> str:
    """Sets the environment variable MUJOCO_GL to osmesa or egl, unless the user has set it. Returns its value.

    Raises SaccadeError if neither of the two is installed.
    """
    chosen = os.environ.get("MUJOCO_GL")
    if chosen:
        return chosen
    for backend, library in (("egl", "nvidia-eglcore"), ("osmesa", "OSMesa"), ("egl", "EGL")):
        if ctypes.util.find_library(library):
            os.environ["MUJOCO_GL"] = backend
            return backend
    raise SaccadeError(HOW_TO_MEND)
