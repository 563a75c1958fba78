"""The core of the simulator: it takes actions and gives frames and the truth, by the rules of shared/world/task.py."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from saccade.services.simulator.scene import PAPER_TABLE, Obstacle, Placed, Scene
from saccade.services.simulator.scenes import Sizes, generate_scene, load_scenes
from saccade.services.simulator.stage import Stage, details_of, place_of
from saccade.shared.bus.messages import Frame, Goal, Truth
from saccade.shared.bus.topics import ACTION, FRAME, GOAL, RESULT, TRUTH, Output
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.seeding import generator
from saccade.shared.loop.service import Inputs, Service
from saccade.shared.render.look import RANDOM, Look, load_look, random_look
from saccade.shared.render.mesh import Mesh
from saccade.shared.render.objects import load_mesh, names_in_use
from saccade.shared.render.world import World
from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX
from saccade.shared.world.goal_image import GoalImage, read_goal_image
from saccade.shared.world.task import MAX_STEPS, Episode, Spheres, spheres_around
from saccade.shared.world.workspace import Allowed

SERVICE = Service("simulator", inputs=(ACTION,), trigger=ACTION, outputs=(FRAME, GOAL, TRUTH), closed_by=RESULT)


class At(TypedDict):
    """The run, the episode and the step of a message."""

    run: str
    episode: int
    step: int


class Looks:
    """How each episode of a run looks. Raises SaccadeError if a look is missing or wrong."""

    def __init__(self, config: Config):
        self.config, told = config, config.simulator
        self._scenes = None if told.look == RANDOM else load_look(told.look)
        name = told.goal_look or told.look
        self._goals = None if name == RANDOM else load_look(name)
        self._alike = told.goal_look is None  # then the goal has the look of its scene, also where it is drawn

    def of(self, episode: int) -> tuple[Look, Look]:
        """The looks of an episode's scene and of its goal image."""
        scene = self._scenes or random_look(self.generator(episode, 0, "look"))
        return scene, scene if self._alike else self._goals or random_look(self.generator(episode, 0, "goal look"))

    def generator(self, episode: int, step: int, what: str) -> np.random.Generator:
        """The generator of the randomness of a look at one step."""
        return generator(self.config.seed, self.config.bus.world, episode, step, f"look {what}")


class Simulator:
    """A world that runs one episode after the other. Episode k has scene k.

    Every step gives a Truth and, until the episode is over, a Frame. With `goal_rgb` [H, W, 3] the user's image
    replaces the goal image of the scene. Its viewpoint is unknown, so no step is a success, and the episode ends when
    the agent says that it has arrived. `notes` tells the user what is assumed, one line for each assumption. In scenes
    with a workspace, `also` limits where the camera may be: it takes positions [N, 3] (metres) and returns [N] truths.
    """

    def __init__(self, world: World, scenes: Sequence[Scene], *, max_steps: int = MAX_STEPS,
                 publish_depth: bool = False, goal_rgb: NDArray[np.uint8] | None = None, explore: bool = False,
                 until: Literal["reached", "declared"] = "reached", looks: Looks | None = None,
                 notes: tuple[str, ...] = (), also: Allowed | None = None):
        self.world, self.scenes, self.max_steps = world, tuple(scenes), max_steps
        self.publish_depth, self.goal_rgb, self.explore = publish_depth, goal_rgb, explore
        self.until = "declared" if goal_rgb is not None else until
        self.looks, self.notes, self.also = looks or Looks(Config()), notes, also
        self._sizes_m = {name: mesh.size_m for name, mesh in world.meshes.items()}
        self._furnished = False
        # Camera pose, image and depth of the last frame. Where the camera stands still, nothing is rendered again.
        self._shown: tuple[NDArray[np.float64], NDArray[np.uint8], NDArray[np.float32] | None] | None = None

    @property
    def episodes(self) -> int:
        """The number of episodes, which is the number of scenes."""
        return len(self.scenes)

    def begin(self, run: str, episode: int) -> list[Output]:
        """Sets up the scene. Returns the goal, the first frame and the first truth.

        Raises SaccadeError if there is no such episode.
        """
        if not 0 <= episode < self.episodes:
            raise SaccadeError(f"episode {episode} does not exist: there are {self.episodes}, counted from 0")
        self.scene = self.scenes[episode]
        self._run, self._episode = run, episode
        self.look, goal_look = self.looks.of(episode)
        self.stage, self._seen = Stage(self.scene, self._sizes_m, self.also), np.zeros(0)
        self._happened: list[str] = []
        target, spheres = self.scene.target_placed, self._spheres()
        self._symmetry = self.world.meshes[target.name].symmetry
        self.state = Episode(self.scene.goal_world_from_camera, spheres, max_steps=self.max_steps,
                             judged=self.goal_rgb is None and not self.explore, until=self.until,
                             center_m=target.center_m, symmetry=self._symmetry,
                             start=self.scene.start_world_from_camera, space=self.stage.space())
        if not self.scene.is_plain:
            self._changed()
        goal = Goal(**self._stamp(), rgb=self._goal_image(goal_look), intrinsics_px=self.world.intrinsics_px,
                    **place_of(self.scene))
        self._place(self.scene.on_table, self.look, self.scene.obstacles)
        return [Output(GOAL, goal), *self._outputs()]

    def step(self, inputs: Inputs) -> list[Output]:
        """Lets happen what happens with this step, and moves the camera. Returns the new frame (unless the episode is
        over now) and the truth.

        Returns nothing if the episode was over before.
        """
        if self.state.done:
            return []
        action = inputs["action"]
        if self.scene.events:
            happened = self.stage.advance(self.state.step + 1, self._seen)
            self._happened = happened or []
            if happened is not None:
                self._changed()
                self._place(self.stage.objects, self.look, self.scene.obstacles)
        self.state.act(action.translation_m, action.rotation_rad, arrived=action.arrived)
        return self._outputs()

    def _stamp(self) -> At:
        return {"run": self._run, "episode": self._episode, "step": self.state.step}

    def _spheres(self) -> Spheres:
        objects = self.stage.objects
        return spheres_around([p.center_m for p in objects], [self._sizes_m[p.name] for p in objects])

    def _changed(self) -> None:
        """Tells the episode what the world is like now."""
        spheres = self._spheres()
        self.state.change(spheres, self.stage.space(), self.stage.views(self._symmetry, spheres))

    def _place(self, objects: Sequence[Placed], look: Look, obstacles: Sequence[Obstacle] = ()) -> None:
        if self.world.look is not look:
            self.world.set_look(look)
        if self.scene.workspace is not None or self._furnished:
            table = self.scene.table or PAPER_TABLE
            self.world.furnish((*table.size_xy_m, table.height_m),
                               [(o.center_m, o.size_m, o.yaw_rad, o.rgb) for o in obstacles])
            self._furnished = self.scene.workspace is not None
        self.world.place({p.label: (p.center_m, p.turned) for p in objects}, self.scene.table_rgb)
        self._shown = None

    def _goal_image(self, look: Look) -> NDArray[np.uint8] | None:
        """The goal image [H, W, 3]: the user's, or the target alone on the table, seen from the goal's pose.

        None if the agent explores.
        """
        if self.explore:
            return None
        if self.goal_rgb is not None:
            return self.goal_rgb
        self._place([self.scene.target_placed], look)
        image = self.world.render(self.scene.goal_world_from_camera)
        return look.seen(image, self.looks.generator(self._episode, 0, "goal"))

    def _outputs(self) -> list[Output]:
        truth = Output(TRUTH, self._truth())
        return [truth] if self.state.done else [Output(FRAME, self._frame()), truth]

    def _frame(self) -> Frame:
        camera = self.state.camera
        if self._shown is None or not np.array_equal(self._shown[0], camera):
            depth = self.world.render_depth(camera) if self.publish_depth else None
            self._shown = camera, self.world.render(camera), depth
        _, rendered, depth = self._shown
        rgb = self.look.seen(rendered, self.looks.generator(self._episode, self.state.step, "camera"))
        return Frame(**self._stamp(), rgb=rgb, intrinsics_px=self.world.intrinsics_px, world_from_camera=camera,
                     depth_m=depth)

    def _truth(self) -> Truth:
        scene, state, present = self.scene, self.state, self.stage.objects
        yaws = np.array([p.yaw_rad for p in present], dtype=np.float64)
        center, instance = state.target
        more: dict[str, Any] = {}
        if not scene.is_plain:
            self._seen = self.stage.shares(state.camera)
            more = details_of(present, self._sizes_m, self._seen, self._happened)
        return Truth(**self._stamp(), scene=scene.id, target=scene.target, names=[p.name for p in present],
                     centers_m=state.spheres.centers_m, yaws_rad=yaws, keep_out_m=state.spheres.radii_m,
                     target_center_m=center, world_from_camera=state.camera,
                     goal_world_from_camera=state.goal, success=state.reached, done=state.done,
                     declared=state.declared, declared_true=state.declared_true, target_instance=instance, **more)


def world_for(meshes: tuple[Mesh, ...], scenes: Sequence[Scene], *, size_px: int = IMAGE_SIZE_PX,
              intrinsics_px: ArrayLike = INTRINSICS_PX) -> World:
    """A world with all objects and obstacles that the scenes need. Raises SaccadeError if OpenGL does not work."""
    further = {p.label: p.name for scene in scenes for p in scene.objects if p.instance > 1}
    return World(meshes, size_px=size_px, intrinsics_px=intrinsics_px, further=further,
                 boxes=max((len(scene.obstacles) for scene in scenes), default=0))


def scenes_of(config: Config, sizes: Sizes) -> list[Scene]:
    """The scenes of a configuration, one per episode: read from its file, or drawn from its seed.

    `sizes` holds the objects that may occur. Raises SaccadeError if the file or the scene does not exist or is not
    valid, or if the objects do not fit on the table.
    """
    scene = config.scene
    if scene.file is not None:
        scenes = load_scenes(scene.file, tuple(sizes))
        if scene.scene is None:
            return scenes
        chosen = [s for s in scenes if s.id == scene.scene]
        if not chosen:
            raise SaccadeError(f"scene {scene.scene!r} is not in {scene.file}: choose an id such as {scenes[0].id!r}")
        return chosen
    if scene.scene is not None:
        raise SaccadeError("scene.scene needs scene.file: give the file that holds the id")
    drawn = []
    for episode in range(scene.count):
        rng = generator(config.seed, config.bus.world, episode, 0, "scene")
        target = str(rng.choice(tuple(sizes)))
        count = scene.n_objects or int(rng.integers(1, len(sizes) + 1))
        drawn.append(generate_scene(rng, sizes, target, count, yaw=scene.yaw,
                                    scene_id=f"{target}-{count}-{config.seed}.{episode}"))
    return drawn


def build(config: Config) -> Simulator:
    """Creates the simulator from a configuration.

    Raises SaccadeError if an object, the scenes or the goal image are missing or damaged, or without OpenGL.
    """
    scene, looks = config.scene, Looks(config)
    goal: GoalImage | None = None
    if scene.goal_image is not None:
        goal = read_goal_image(scene.goal_image, scene.goal_intrinsics_px)
    meshes = tuple(load_mesh(scene.objects, name) for name in names_in_use(scene))
    scenes = scenes_of(config, {mesh.name: mesh.size_m for mesh in meshes})
    return Simulator(world_for(meshes, scenes), scenes, max_steps=config.simulator.max_steps,
                     until=config.simulator.until, publish_depth=config.simulator.publish_depth,
                     goal_rgb=goal.rgb if goal else None, explore=scene.explore, looks=looks,
                     notes=(goal.note,) if goal and not scene.explore else ())
