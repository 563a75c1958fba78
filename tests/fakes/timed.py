"""python -m saccade.tests.fakes.timed --config FILE: a camera of noise that goes by time."""

from __future__ import annotations

import numpy as np

from saccade.shared.bus.messages import Frame, Goal
from saccade.shared.bus.topics import ACTION, FRAME, GOAL, Output
from saccade.shared.loop.main import run_module
from saccade.shared.loop.modules import ServiceModule
from saccade.shared.loop.service import Service
from saccade.tests.fakes.services import IDENTITY, INTRINSICS_PX

TIMED = Service("timed", inputs=(ACTION,), trigger=ACTION, outputs=(FRAME, GOAL))
PIXELS = np.random.default_rng(0).integers(0, 256, (96, 96, 3), dtype=np.uint8)


class FakeCamera:
    """`frames` of them, one every `period_s`; after each two images that it could not publish."""

    episodes, notes = 1, ("the lens is dirty", "nobody knows where this is")

    def __init__(self, frames: int, period_s: float) -> None:
        self.frames, self.period_s, self.skipped = frames, period_s, 0

    def begin(self, run, episode):
        self.at, self.shown, self.skipped = {"run": run, "episode": episode}, 0, 0
        return [Output(GOAL, Goal(**self.at, step=0, rgb=PIXELS, intrinsics_px=INTRINSICS_PX)), *self.next_frame()]

    def next_frame(self):
        if self.shown == self.frames:
            return []
        step, self.shown = self.shown, self.shown + 1
        self.skipped += 2
        depth_m = np.full((96, 96), step, np.float32)
        return [Output(FRAME, Frame(**self.at, step=step, rgb=PIXELS + np.uint8(step % 256), depth_m=depth_m,
                                    intrinsics_px=INTRINSICS_PX, world_from_camera=IDENTITY))]

    def step(self, inputs):
        return []


if __name__ == "__main__":
    run_module(ServiceModule(TIMED, lambda config: FakeCamera(config.simulator.max_steps, 0.03)))
