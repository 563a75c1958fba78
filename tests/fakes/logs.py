"""A small log of a run that never was, with two objects, whose every message is known."""

from __future__ import annotations

import math

import numpy as np

from saccade.app.replay.replay import prepare, replay_here
from saccade.services.replayer.core import Keys, Pace
from saccade.shared.bus.topics import BELIEF, FRAME, GOAL, PERCEPT, PLAN, RESULT, STATUS, TRUTH
from saccade.shared.bus.wire import encode
from saccade.shared.errors import SaccadeError
from saccade.shared.log.reading import RunReader
from saccade.shared.log.recording import RunLog
from saccade.shared.world.geometry import look_at
from saccade.tests.samples import sample

INTRINSICS = np.array([40.0, 41.0, 15.0, 11.0])
SIZE = 24, 32
CENTERS = np.array([[0.1, 0.05, 0.06], [-0.1, 0.0, 0.04]])
GOAL_CAMERA = look_at([-0.3, 0.3, 0.4], CENTERS[0])
START_NS = 1_700_000_000_000_000_000
RNG = np.random.default_rng(0)


def camera_at(step, episode=0):
    """The camera's pose [4, 4]."""
    return look_at([0.4 - 0.05 * step, -0.3, 0.4 + 0.1 * episode], CENTERS[0])


def story(episodes=2, steps=3):
    """(topic, part, message) of a run; the last move of an episode has a truth and no frame."""
    for episode in range(episodes):
        def new(topic, step, episode=episode, **changes):
            return topic, changes.get("object"), sample(topic.type, run="r", episode=episode, step=step, **changes)

        for step in range(steps + 1):
            camera = camera_at(step, episode)
            yield new(TRUTH, step, names=["mug", "can"], target="mug", centers_m=CENTERS,
                      yaws_rad=np.array([0.5, -1.0]), keep_out_m=np.ones(2), world_from_camera=camera,
                      goal_world_from_camera=GOAL_CAMERA, done=step == steps, instances=np.ones(2, np.uint8),
                      rotations=None, sizes_m=None, in_view=np.ones(2), events=None)
            if step == steps:
                yield new(RESULT, step)
                break
            if step == 0:
                yield new(GOAL, 0, rgb=RNG.integers(0, 256, (*SIZE, 3), dtype=np.uint8), intrinsics_px=INTRINSICS)
            yield new(FRAME, step, rgb=RNG.integers(0, 256, (*SIZE, 3), dtype=np.uint8), intrinsics_px=INTRINSICS,
                      world_from_camera=camera, depth_m=RNG.random(SIZE, dtype=np.float32))
            for name in ("mug", "can"):
                yield new(PERCEPT, step, object=name)
            for name, center in zip(("mug", "can"), CENTERS, strict=True):
                scatter = RNG.normal(0, (0.03, 0.02, 0.01), (50, 3))
                yield new(BELIEF, step, object=name, mean_m=center, covariance_m2=np.cov(scatter.T), presence=0.8,
                          particles_m=(center + scatter).astype(np.float32),
                          goal_log_posterior=None if step == 0 else np.full((6, 7), -math.log(42), np.float32))
            yield new(PLAN, step, viewpoint=camera_at(step + 1, episode),
                      believed_distance_m=-1.0 if step == 0 else 0.2)
    yield STATUS, "planner", sample(STATUS.type, run="r", episode=0, step=0, service="planner", milliseconds=7.5)


def so_far(log):
    """(topic, part, message) of a log that is being written; none before it has begun."""
    try:
        return list(RunReader(log))
    except SaccadeError:
        return []


def logged(log):
    """The payloads of a log by (topic, part), in their order, without statuses, which depend on time."""
    messages = {}
    for entry in RunReader(log).entries():
        if entry.topic != STATUS:
            messages.setdefault((entry.topic.name, entry.part), []).append(entry.payload)
    return messages


def write(path, messages, *, configuration="{}"):
    """A log with a message every millisecond."""
    log = RunLog(path, world="table", configuration=configuration, metadata={"versions": {"x": "1"}})
    for i, (topic, part, message) in enumerate(messages):
        log.write(topic, part, encode(message), log_time_ns=START_NS + i * 10 ** 6)
    log.close()
    return path


def of(messages, topic, part=None):
    """Those of one topic and part."""
    return [m for t, p, m in messages if t == topic and p == part]


def assert_replayed(log, out, *into):
    """Played into these services within this process, the log's inputs give again what it holds, to the byte."""
    comparison = replay_here(prepare(log, into, {}, pace=Pace()), out, Keys(enabled=False), print).comparison
    assert comparison.equal
    assert comparison.unequal == 0
