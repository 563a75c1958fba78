"""Which inputs make a step, what is latched, late or stray, and what number a message gets."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from saccade.shared.bus.topics import ACTION, FRAME, GOAL, PERCEPT, PLAN, TRUTH
from saccade.shared.bus.wire import MessageError, encode
from saccade.shared.loop.service import Service
from saccade.shared.loop.stepper import Stepper, settle
from saccade.tests.fakes.services import SIMULATOR, FakeSimulator
from saccade.tests.fakes.timed import TIMED, FakeCamera
from saccade.tests.samples import sample

PARTS = ("mug", "can")


class Keeper:
    """A core that keeps its inputs."""

    def __init__(self) -> None:
        self.steps, self.begun = [], []

    def begin(self, run, episode):
        self.begun.append((run, episode))
        return ()

    def step(self, inputs):
        self.steps.append(inputs)
        return ()


BOTH = Service("both", inputs=(PERCEPT, TRUTH, GOAL), trigger=TRUTH, outputs=(PLAN,))


def offer(stepper, topic, part=None, **changes) -> bool:
    """Offers a sample; whether the core stepped."""
    extra = {"object": part} if part else {}
    stepper.offer(topic, part, sample(topic.type, **{"run": "r", "episode": 0, "step": 0} | extra | changes))
    return stepper.advance() is not None


def test_a_step_needs_every_topic_every_part_and_what_is_latched():
    stepper = Stepper(BOTH, core := Keeper(), PARTS)
    assert not offer(stepper, PERCEPT, "can")
    assert not offer(stepper, TRUTH)
    assert stepper.waits_for() == ["percept/mug of step 0 of episode 0", "goal of step 0 of episode 0"]
    assert not offer(stepper, PERCEPT, "mug")
    assert offer(stepper, GOAL)
    assert list(core.steps[0]["percept"]) == list(PARTS)
    assert list(core.steps[0]) == ["percept", "truth", "goal"]
    assert core.begun == [("r", 0)]


def test_a_latched_message_holds_from_its_step_on():
    stepper = Stepper(Service("s", inputs=(TRUTH, GOAL), trigger=TRUTH, outputs=()), core := Keeper(), PARTS)
    offer(stepper, GOAL, step=0, seq=0)
    offer(stepper, GOAL, step=2, seq=1)
    for step in range(4):
        assert offer(stepper, TRUTH, step=step)
    assert [inputs["goal"].seq for inputs in core.steps] == [0, 0, 1, 1]


def test_a_new_episode_begins_with_its_first_complete_step():
    stepper = Stepper(BOTH, core := Keeper(), ("mug",))
    for episode in (0, 1):
        offer(stepper, GOAL, episode=episode)
        offer(stepper, PERCEPT, "mug", episode=episode)
    assert offer(stepper, TRUTH, episode=0)
    assert core.begun == [("r", 0)]
    assert offer(stepper, TRUTH, episode=1)
    assert core.begun == [("r", 0), ("r", 1)]
    assert not offer(stepper, TRUTH, episode=0, step=5)
    assert stepper.skipped == 0


def test_in_lockstep_no_step_is_left_out_and_what_lacks_is_known():
    """A core's state is a fold: a later step waits, however complete, until those before it have come."""
    stepper = Stepper(BOTH, core := Keeper(), ("mug",))
    assert stepper.wants is None
    offer(stepper, GOAL)
    for step in (2, 0, 1):
        assert not offer(stepper, TRUTH, step=step)
    assert not offer(stepper, PERCEPT, "mug", step=2)
    assert stepper.waits_for() == ["percept/mug of step 0 of episode 0"]
    assert offer(stepper, PERCEPT, "mug", step=0)
    assert stepper.wants == ("r", 0, 1)
    assert offer(stepper, PERCEPT, "mug", step=1)
    assert stepper.advance() is not None
    assert [inputs["truth"].step for inputs in core.steps] == [0, 1, 2]
    assert stepper.skipped == 0


def test_a_log_that_was_cut_begins_with_its_own_first_step():
    stepper = Stepper(Service("s", inputs=(TRUTH,), trigger=TRUTH, outputs=()), Keeper(), PARTS, first_step=3)
    assert not offer(stepper, TRUTH, step=4)
    assert offer(stepper, TRUTH, step=3)
    assert stepper.advance() is not None


def test_live_the_newest_complete_step_is_taken_and_those_before_are_skipped():
    stepper = Stepper(BOTH, core := Keeper(), ("mug",), live=True)
    offer(stepper, GOAL)
    offer(stepper, TRUTH, step=0)
    offer(stepper, TRUTH, step=1)
    assert offer(stepper, PERCEPT, "mug", step=1)
    assert stepper.skipped == 1
    assert not offer(stepper, PERCEPT, "mug", step=0)
    assert [inputs["truth"].step for inputs in core.steps] == [1]


def test_a_second_message_of_a_step_and_a_wrong_step_for_a_source_are_refused():
    stepper = Stepper(BOTH, Keeper(), PARTS)
    offer(stepper, TRUTH)
    offer(stepper, TRUTH)  # said once more, by a service that was started again
    with pytest.raises(MessageError, match="second, other"):
        offer(stepper, TRUTH, scene="another")
    with pytest.raises(MessageError, match="not an input"):
        offer(stepper, PLAN)
    simulator = Stepper(SIMULATOR, FakeSimulator(0, 1, 9), PARTS, source=True)
    simulator.begin("r", 0)
    with pytest.raises(MessageError, match="step: 3, not 0"):
        offer(simulator, ACTION, step=3)
    assert offer(simulator, ACTION, step=0)
    assert not offer(simulator, ACTION, step=0)


def test_an_action_that_a_camera_went_past_is_no_image_that_it_skipped():
    camera = FakeCamera(3, 1.0)
    stepper = Stepper(TIMED, camera, (), source=True, live=True)
    stepper.begin("r", 0)
    stepper.offer(ACTION, None, sample(ACTION.type, run="r", episode=0, step=0))
    stepper.tick()
    assert offer(stepper, ACTION, step=1)
    assert stepper.skipped == 0
    assert not offer(stepper, ACTION, step=0)


def test_stray_steps_do_not_pile_up():
    stepper = Stepper(BOTH, Keeper(), PARTS)
    for step in range(1000):
        offer(stepper, TRUTH, step=step)
        offer(stepper, GOAL, episode=step)
    assert len(stepper._slots) + len(stepper._latched) < 600
    assert stepper.skipped > 700


def test_settled_arrays_are_aligned_frozen_and_no_ones_else():
    message = sample(FRAME.type)
    buffer = np.frombuffer(b"x" + message.depth_m.tobytes(), "f4", offset=1).reshape(message.depth_m.shape)
    settled = settle(dataclasses.replace(message, depth_m=buffer))
    for value in (settled.rgb, settled.depth_m, settled.world_from_camera):
        assert value.flags.aligned
        assert value.flags.c_contiguous
        assert not value.flags.writeable
    assert not np.shares_memory(settled.rgb, message.rgb)
    assert settle(settled) is settled
    assert encode(settled) == encode(message)


def test_whoever_speaks_of_another_run_or_of_an_episode_after_the_next_is_refused():
    judge = Service("judge", inputs=(TRUTH,), trigger=TRUTH, outputs=())
    stepper = Stepper(judge, Keeper(), PARTS, run="r")

    def offer(**stamp):
        stepper.offer(TRUTH, None, sample(TRUTH.type, done=False, **stamp))

    with pytest.raises(MessageError, match="run: 'zz', not this run 'r'"):
        offer(run="zz", episode=0, step=0)
    offer(run="r", episode=0, step=0)
    assert stepper.advance() is not None
    with pytest.raises(MessageError, match="episode: 2, while episode 0 goes on"):
        offer(run="r", episode=2, step=0)
    offer(run="r", episode=1, step=0)
    assert stepper.advance() is not None
    assert stepper.at == ("r", 1, 0)
