"""Choosing an OpenGL that works without a screen, before MuJoCo is imported (it decides once, at import)."""

from __future__ import annotations

import ctypes.util
import os

from saccade.shared.errors import SaccadeError

HOW_TO_MEND = ("no OpenGL without a screen: install libosmesa6 (Debian, Ubuntu: `sudo apt-get install libosmesa6`) "
               "or a driver with EGL, or set MUJOCO_GL to the one you have")


def choose_backend() -> str:
    """Sets MUJOCO_GL to osmesa or egl where the user has not chosen; raises SaccadeError where neither is there."""
    chosen = os.environ.get("MUJOCO_GL")
    if chosen:
        return chosen
    for backend, library in (("egl", "nvidia-eglcore"), ("osmesa", "OSMesa"), ("egl", "EGL")):
        if ctypes.util.find_library(library):
            os.environ["MUJOCO_GL"] = backend
            return backend
    raise SaccadeError(HOW_TO_MEND)
