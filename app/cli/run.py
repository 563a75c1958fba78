"""`saccade run`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from saccade.app.cli.options import (
    AGENT_DEFAULT,
    AGENTS,
    ConfigFile,
    Names,
    Objects,
    ScenesFile,
    Seed,
    Values,
    WeightsFolder,
    Yaw,
)
from saccade.app.cli.texts import configured, numbers, split_names
from saccade.shared.errors import SaccadeError

app = typer.Typer()


@app.command()
def run(*, objects: Objects = None, names: Names = None, scenes: ScenesFile = None,
        scene: Annotated[str | None, typer.Option(
            help="Run only the scene with this id in the file.")] = None, seed: Seed = None,
        count: Annotated[int | None, typer.Option(min=1, help="How many scenes are drawn.")] = None,
        n_objects: Annotated[int | None, typer.Option(
            min=1, help="How many objects stand on the table.")] = None, yaw: Yaw = None,
        goal: Annotated[Path | None, typer.Option(
            help="Image of the view to find: PNG or JPEG.")] = None,
        goal_intrinsics: Annotated[str | None, typer.Option(
            help="Intrinsics of the goal image, in pixels.", metavar="fx,fy,cx,cy",
            show_default="from its EXIF data")] = None,
        explore: Annotated[bool, typer.Option(
            "--explore", help="Explore without a goal: find out what is on the table.")] = False,
        out: Annotated[Path | None, typer.Option(
            help="New folder of the run.", show_default="runs/<time>-<seed>")] = None,
        bus: Annotated[Literal["zenoh", "local"] | None, typer.Option(
            help="Run each service as a process on a Zenoh bus, or all within this "
                 "process.", show_default="zenoh")] = None,
        agent: Annotated[str | None, typer.Option(
            help=f"Which agent to run: {AGENTS}.", show_default=AGENT_DEFAULT)] = None,
        weights: WeightsFolder = None,
        world: Annotated[str, typer.Option(
            help="Where images come from: simulator, or camera for a real one.")] = "simulator",
        source: Annotated[str | None, typer.Option(
            help="Images of a real camera: a folder, a video file, a ROS 2 bag, a webcam (webcam:0), or a topic of "
                 "ROS 2 (ros:/camera/image_raw).")] = None,
        poses: Annotated[Path | None, typer.Option(
            help="File or folder with the camera's poses, such as TUM, transforms.json or COLMAP.")] = None,
        scale: Annotated[float | None, typer.Option(
            help="Length in metres of the unit of the poses.", show_default="1")] = None,
        intrinsics: Annotated[str | None, typer.Option(
            help="Intrinsics of the camera's images, in pixels.", metavar="fx,fy,cx,cy")] = None,
        board: Annotated[list[Path] | None, typer.Option(
            help="Description of a printed board on the table, which tells the camera's poses (`saccade board`). Can "
                 "be given several times; the first board is the origin.",
            metavar="BOARD.json")] = None,
        calibration: Annotated[str | None, typer.Option(
            help="Calibration of the camera (`saccade calibrate`): a file, or the name of a camera.",
            metavar="FILE|NAME")] = None,
        rate: Annotated[float | None, typer.Option(
            help="Images per second, of a folder or a webcam.", show_default="10")] = None,
        image_topic: Annotated[str | None, typer.Option(
            help="Topic of the images in a ROS 2 bag.", show_default="the one that has a CameraInfo")] = None,
        camera_frame: Annotated[str | None, typer.Option(
            help="Frame of the camera in the tf of ROS 2.", show_default="that of the images")] = None,
        world_frame: Annotated[str | None, typer.Option(
            help="Frame of tf that is the agent's world.", show_default="the root of tf")] = None,
        ros: Annotated[bool, typer.Option(
            "--ros", help="Publish the chosen viewpoint and the beliefs to ROS 2.")] = False,
        loop: Annotated[bool, typer.Option("--loop", help="Begin again with the first image after the last.")] = False,
        config: ConfigFile = None, values: Values = None,
        view: Annotated[bool, typer.Option("--view", help="Show the run in a browser while it goes on.")] = False,
        guide: Annotated[bool | None, typer.Option(
            "--guide/--no-guide", help="Serve a page that tells who holds the camera where to go next.",
            show_default="for a camera that runs now")] = None,
        plain: Annotated[bool, typer.Option(
            "--plain", help="Print lines instead of the live display.")] = False) -> None:
    """Run the agent. The run's folder gets run.mcap (every message), config.json and picture.png."""
    from rich.console import Console

    from saccade.app.look.picture import draw_run
    from saccade.app.run.display import say
    from saccade.app.run.run import Finished
    from saccade.app.run.run import run as run_agent
    from saccade.services.viewer.server import url_of

    given = {"scene.objects": objects, "scene.names": split_names(names), "scene.file": scenes, "scene.scene": scene,
             "seed": seed, "scene.count": count, "scene.n_objects": n_objects, "scene.yaw": yaw,
             "scene.goal_image": goal,
             "scene.goal_intrinsics_px": numbers(goal_intrinsics, "--goal-intrinsics"),
             "scene.explore": explore or None, "bus.kind": bus,
             "perception.weights": weights, "camera.source": source, "camera.poses": poses,
             "camera.poses_scale": scale,
             "camera.board": board[0] if board else None,
             "camera.more_boards": [str(path) for path in board[1:]] if board and len(board) > 1 else None,
             "camera.calibration": calibration,
             "camera.intrinsics_px": numbers(intrinsics), "camera.rate_hz": rate, "camera.loop": loop or None,
             "camera.image_topic": image_topic, "camera.camera_frame": camera_frame,
             "camera.world_frame": world_frame, "ros.publish": ros or None}
    console = Console()

    def show(finished: Finished) -> None:
        try:
            draw_run(finished.folder)
        except SaccadeError as error:  # that it cannot be drawn does not undo the run
            print(f"saccade: no picture: {error}", file=sys.stderr)
        say(console, f"log, configuration and picture are in {finished.folder}")
        if console.is_terminal and finished.is_viewed():
            from saccade.app.look.view import stay  # Rerun is loaded where it is wanted

            say(console, f"to be seen at {url_of(finished.config.viewer)} until Ctrl-C")
            stay(finished.is_viewed)

    resolved, agent = configured(config, given, values, agent)
    finished = run_agent(resolved, agent=agent, out=out, plain=plain, console=console, world=world, view=view,
                         guide=guide, after=show)
    if finished.lacks:  # it was said when it happened
        raise typer.Exit(2)
