"""A world of numbers: the simulator draws noise, perception averages it, and so on around the loop."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterable

import numpy as np

from saccade.shared.bus.messages import Action, Belief, Frame, Goal, Percept, Plan, Result, Truth
from saccade.shared.bus.topics import ACTION, BELIEF, FRAME, GOAL, GOAL_PERCEPT, PERCEPT, PLAN, RESULT, TRUTH, Output
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.modules import ServiceModule
from saccade.shared.loop.seeding import generator
from saccade.shared.loop.service import Inputs, Service

SIDE_PX = 96
IDENTITY = np.eye(4)
INTRINSICS_PX = np.array([100.0, 100.0, 48.0, 48.0])

SIMULATOR = Service("simulator", inputs=(ACTION,), trigger=ACTION, outputs=(FRAME, GOAL, TRUTH),
                    closed_by=RESULT)
PERCEPTION = Service("perception", inputs=(FRAME, GOAL), trigger=FRAME, outputs=(PERCEPT, GOAL_PERCEPT))
BELIEVER = Service("belief", inputs=(PERCEPT, GOAL_PERCEPT), trigger=PERCEPT, outputs=(BELIEF,))
PLANNER = Service("planner", inputs=(BELIEF,), trigger=BELIEF, outputs=(PLAN, ACTION))
EVALUATOR = Service("evaluator", inputs=(TRUTH,), trigger=TRUTH, outputs=(RESULT,))


class FakeSimulator:
    """Frames of noise that depend on where the actions led."""

    def __init__(self, seed: int, episodes: int, steps: int) -> None:
        self.seed, self.episodes, self.steps = seed, episodes, steps
        self.position_m = np.zeros(3)

    def begin(self, run: str, episode: int) -> Iterable[Output]:
        self.at, self.position_m[:] = (run, episode), 0.0
        rgb = generator(self.seed, "fake", episode, 0, "goal").integers(0, 256, (SIDE_PX, SIDE_PX, 3), dtype=np.uint8)
        yield Output(GOAL, Goal(run=run, episode=episode, step=0, rgb=rgb, intrinsics_px=INTRINSICS_PX))
        yield from self._observe(0)

    def step(self, inputs: Inputs) -> Iterable[Output]:
        action = inputs["action"]
        self.position_m += action.translation_m  # in place: what was published before must not change with it
        return self._observe(action.step + 1)

    def _observe(self, step: int) -> Iterable[Output]:
        run, episode = self.at
        pose = np.eye(4)
        pose[:3, 3] = self.position_m
        noise = generator(self.seed, "fake", episode, step, "simulator")
        rgb = (noise.integers(0, 200, (SIDE_PX, SIDE_PX, 3)) + abs(self.position_m).sum()).astype(np.uint8)
        depth = noise.random((SIDE_PX, SIDE_PX)).astype(np.float32)
        if step < self.steps:
            yield Output(FRAME, Frame(run=run, episode=episode, step=step, rgb=rgb, intrinsics_px=INTRINSICS_PX,
                                      world_from_camera=pose, depth_m=depth.T))
        yield Output(TRUTH, Truth(run=run, episode=episode, step=step, scene=f"fake-{episode}", target="mug",
                                  names=["mug"], keep_out_m=np.ones(1), target_center_m=np.zeros(3),
                                  centers_m=self.position_m[None], yaws_rad=np.zeros(1), world_from_camera=pose,
                                  goal_world_from_camera=IDENTITY, success=False, done=step == self.steps))


class FakePerception:
    """Statistics of the image, another one for each object."""

    def __init__(self, parts: tuple[str, ...]) -> None:
        self.parts = parts

    def begin(self, run: str, episode: int) -> Iterable[Output]:
        self.goal_seen = False
        return ()

    def step(self, inputs: Inputs) -> Iterable[Output]:
        frame, goal = inputs["frame"], inputs["goal"]
        for i, name in enumerate(self.parts):
            if not self.goal_seen:
                yield Output(GOAL_PERCEPT, self._percept(frame, goal.rgb[..., i % 3] / 255.0, name), name)
            yield Output(PERCEPT, self._percept(frame, frame.depth_m * (i + 1), name), name)
        self.goal_seen = True

    def _percept(self, frame: Frame, image: np.ndarray, name: str) -> Percept:
        latent = np.array([image.sum(), image.std(), image.mean(), image[0].sum()], np.float32)
        return Percept(run=frame.run, episode=frame.episode, step=frame.step, object=name, presence=0.9,
                       pixel=np.array([image.mean(), 2.0]), pixel_std=1.0, scale=1.0, log_scale_std=0.1,
                       latent_mean=latent, latent_std=np.ones_like(latent), intrinsics_px=frame.intrinsics_px,
                       world_from_camera=frame.world_from_camera)


class FakeBelief:
    """Sums up what was seen in this episode."""

    def __init__(self, parts: tuple[str, ...]) -> None:
        self.parts = parts

    def begin(self, run: str, episode: int) -> Iterable[Output]:
        self.sums = {name: np.zeros(3) for name in self.parts}
        return ()

    def step(self, inputs: Inputs) -> Iterable[Output]:
        for name, percept in inputs["percept"].items():
            self.sums[name] += percept.latent_mean[:3] - inputs["goal_percept"][name].latent_mean[:3] / 7
            particles = np.outer(np.arange(300), self.sums[name]).astype(np.float32)
            yield Output(BELIEF, Belief(
                run=percept.run, episode=percept.episode, step=percept.step, object=name, presence=0.9,
                world_from_camera=percept.world_from_camera, mean_m=self.sums[name], covariance_m2=np.eye(3),
                particles_m=particles, views=percept.step), name)


class FakePlanner:
    """A bounded move away from the sums. In episode `dies_in` it kills itself, in `silent_in` it says nothing, for
    tests of what then happens."""

    def __init__(self, dies_in: int | None = None, breaks_in: int | None = None, silent_in: int | None = None) -> None:
        self.dies_in, self.breaks_in, self.silent_in = dies_in, breaks_in, silent_in

    def begin(self, run: str, episode: int) -> Iterable[Output]:
        if episode == self.breaks_in:
            raise SaccadeError("the fake planner has had enough: give it a break")
        if episode == self.dies_in:
            os.kill(os.getpid(), signal.SIGKILL)
        return ()

    def step(self, inputs: Inputs) -> Iterable[Output]:
        beliefs = list(inputs["belief"].values())
        if beliefs[0].episode == self.silent_in:
            return
        at = {"run": beliefs[0].run, "episode": beliefs[0].episode, "step": beliefs[0].step}
        move = np.tanh(sum(b.mean_m for b in beliefs) / 1e4 + beliefs[0].particles_m.sum() / 1e9) / 4
        yield Output(PLAN, Plan(**at, target="mug", mode="seek", viewpoint=IDENTITY, look_at_m=move, g_position=1.0,
                                g_scale=0.0, g_pose=0.0, g_information=0.0, candidates=1, goal_confidence=1.0,
                                believed_distance_m=-1.0, arrived=False))
        yield Output(ACTION, Action(**at, translation_m=move, rotation_rad=move[::-1] / 2))


class FakeEvaluator:
    """A result at the end of an episode."""

    def begin(self, run: str, episode: int) -> Iterable[Output]:
        return ()

    def step(self, inputs: Inputs) -> Iterable[Output]:
        truth = inputs["truth"]
        if truth.done:
            yield Output(RESULT, Result(
                run=truth.run, episode=truth.episode, step=truth.step, scene=truth.scene, target="mug", objects=1,
                success=False, steps=truth.step, azimuth_error_rad=0.0, elevation_error_rad=0.0,
                range_error_m=float(abs(truth.centers_m).sum()), declared=False, declared_true=False))


def build(name: str, config: Config):
    """The fake core of that name; `scene.scene` may hold an instruction such as "planner dies"."""
    names, wish = config.scene.names, config.scene.scene or ""
    if wish == f"{name} breaks at start":
        raise SaccadeError("weights are missing: fetch them")
    return {
        "simulator": lambda: FakeSimulator(config.seed, config.scene.count, config.simulator.max_steps),
        "perception": lambda: FakePerception(names),
        "belief": lambda: FakeBelief(names),
        "planner": lambda: FakePlanner(*(1 if wish == f"planner {what}" else None
                                         for what in ("dies", "breaks", "is silent"))),
        "evaluator": FakeEvaluator,
    }[name]()


SERVICES = {s.name: s for s in (SIMULATOR, PERCEPTION, BELIEVER, PLANNER, EVALUATOR)}


def pairs(config: Config) -> list:
    """Every fake service with its core, for a run in one process."""
    return [(service, build(name, config)) for name, service in SERVICES.items()]


def module(name: str) -> ServiceModule:
    """A fake service as a process runs it."""
    return ServiceModule(SERVICES[name], lambda config: build(name, config))
