"""Cameras whose source is a ROS 2 bag, and their frames: for the tests of bags."""

from __future__ import annotations

import numpy as np

from saccade.services.camera.core import build
from saccade.shared.config import Config
from saccade.tests.fakes.ros import SIZE


def config_of(source, **camera):
    return Config().with_values({f"camera.{key}": value for key, value in {"source": source, **camera}.items()})


def camera_of(source, **camera):
    return build(config_of(str(source), **camera))


def frames_of(camera):
    frames = [camera.begin("r", 0)[1].message]
    while outputs := camera.next_frame():
        frames.append(outputs[0].message)
    return frames


def numbers(frames):
    return [int(np.median(frame.rgb)) for frame in frames]


def grey(k):
    return np.full((SIZE[1], SIZE[0], 3), k, np.uint8)
