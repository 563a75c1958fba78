"""The Gymnasium environment: the interface's own checker, determinism, reward."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from saccade.services.planner.motion import step_towards
from saccade.services.simulator.gym_env import ID
from saccade.services.simulator.scenes import generate_split, save_scenes
from saccade.shared.errors import SaccadeError

OPTIONS = {"names": ("soup_can", "rice_box"), "n_objects": 2}


@pytest.fixture
def env():
    env = gymnasium.make(ID, render_mode="rgb_array", **OPTIONS)
    yield env
    env.close()


def test_the_checker_has_no_complaint(env):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_a_seed_decides_everything(env):
    def play(seed):
        observation, info = env.reset(seed=seed)
        trace = [observation["goal"], observation["image"]]
        env.action_space.seed(0)
        for _ in range(3):
            observation, *_ = env.step(env.action_space.sample() * 0.1)
            trace += [observation["image"], observation["pose"]]
        return trace, info

    (first, info), (again, info_again), (other, _) = play(1), play(1), play(2)
    assert info == info_again
    assert all((a == b).all() for a, b in zip(first, again, strict=True))
    assert (first[0] != other[0]).any()


def test_reward_is_one_at_the_goal_and_zero_before(env):
    env.reset(seed=5)
    state = env.unwrapped._simulator.state
    rewards, ended = [], False
    while not ended:
        observation, reward, ended, truncated, info = env.step(np.concatenate(
            step_towards(state.camera, state.goal, state.spheres)))
        rewards.append(reward)
        assert not truncated
    assert rewards[-1] == 1.0
    assert sum(rewards) == 1.0
    assert info["range_error_m"] < 0.075
    np.testing.assert_array_equal(observation["image"], env.render())


def test_it_is_truncated_when_the_steps_are_used_up():
    env = gymnasium.make(ID, max_steps=2, **OPTIONS)
    env.reset(seed=0)
    assert env.step(np.zeros(6))[2:4] == (False, False)
    assert env.step(np.zeros(6))[2:4] == (False, True)
    env.close()


def test_scenes_of_a_file_can_be_chosen(tmp_path):
    sizes = {"soup_can": (0.07, 0.07, 0.10), "rice_box": (0.05, 0.09, 0.18)}
    scenes = generate_split(sizes, seed=0, counts=(1, 2), repeats=2)
    save_scenes(tmp_path / "s.json", scenes)
    env = gymnasium.make(ID, names=tuple(sizes), scenes=tmp_path / "s.json")
    for scene in scenes[::3]:
        assert env.reset(options={"scene": scene.id})[1]["scene"] == scene.id
    assert env.reset(seed=1)[1]["scene"] in {scene.id for scene in scenes}
    with pytest.raises(SaccadeError, match="not in the environment's file"):
        env.reset(options={"scene": "nothing"})
    env.close()
