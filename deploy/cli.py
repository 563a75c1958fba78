"""The front door: `saccade <command>`. Commands load what they need when they are called."""

from __future__ import annotations

import shlex
import signal
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from deploy.logs.cli import app as logs
from deploy.options import configured, numbers, parse_value, split_names
from deploy.threads import prefer_one_thread
from deploy.views import app as views
from shared.errors import SaccadeError

EXIT_ERROR, EXIT_INTERRUPTED = 2, 130

app = typer.Typer(name="saccade", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
                  help="An active-vision agent: it looks, believes and moves until it sees the goal image.")
app.add_typer(logs, name="log")
app.add_typer(views)

Objects = Annotated[Literal["pantry", "ycb"] | None, typer.Option(help="object set", show_default="pantry")]
Names = Annotated[str | None, typer.Option(help="only these objects of the set: a,b", metavar="NAMES")]
ConfigFile = Annotated[Path | None, typer.Option(help="configuration, TOML or JSON; options go before it")]
Values = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE",
                                                  help="configuration by dotted key, e.g. planner.step_m=0.03")]
WeightsFolder = Annotated[Path | None, typer.Option(help="folder of the weights", show_default="weights/<set>")]
Seed = Annotated[int | None, typer.Option(min=0, help="seed of everything random", show_default="0")]
Yaw = Annotated[Literal["random", "fixed"] | None, typer.Option(help="whether drawn objects are turned")]
ScenesFile = Annotated[Path | None, typer.Option(help="scenes file")]


@app.command()
def run(*, objects: Objects = None, names: Names = None, scenes: ScenesFile = None,
        scene: Annotated[str | None, typer.Option(help="id of one scene in the file")] = None, seed: Seed = None,
        count: Annotated[int | None, typer.Option(min=1, help="how many scenes to draw")] = None,
        n_objects: Annotated[int | None, typer.Option(min=1, help="objects on the table")] = None, yaw: Yaw = None,
        goal: Annotated[Path | None, typer.Option(help="goal image, 480x480 PNG or JPEG")] = None,
        explore: Annotated[bool, typer.Option("--explore", help="no goal: find out what is there")] = False,
        out: Annotated[Path | None, typer.Option(help="folder of the run", show_default="runs/<time>-<seed>")] = None,
        bus: Annotated[Literal["zenoh", "local"] | None, typer.Option(
            help="services as processes on Zenoh, or all within this one", show_default="zenoh")] = None,
        agent: Annotated[str, typer.Option(help="which agent")] = "sceneccn", weights: WeightsFolder = None,
        world: Annotated[str, typer.Option(help="simulator, or camera: a real one")] = "simulator",
        source: Annotated[str | None, typer.Option(
            help="of a camera's images: a folder, a video file, or a webcam: webcam:0")] = None,
        poses: Annotated[Path | None, typer.Option(help="where the camera was: JSON lines or TUM")] = None,
        intrinsics: Annotated[str | None, typer.Option(help="of its images, in pixels", metavar="fx,fy,cx,cy")] = None,
        rate: Annotated[float | None, typer.Option(
            help="images a second of a folder or webcam", show_default="10")] = None,
        loop: Annotated[bool, typer.Option("--loop", help="from the first image again after the last")] = False,
        config: ConfigFile = None, values: Values = None,
        view: Annotated[bool, typer.Option("--view", help="show it in a browser, see `saccade view`")] = False,
        plain: Annotated[bool, typer.Option("--plain", help="lines instead of the live display")] = False) -> None:
    """Run the agent and log everything: run.mcap, config.json, picture.png."""
    from deploy.run import run as run_agent

    given = {"scene.objects": objects, "scene.names": split_names(names), "scene.file": scenes, "scene.scene": scene,
             "seed": seed, "scene.count": count, "scene.n_objects": n_objects, "scene.yaw": yaw,
             "scene.goal_image": goal, "scene.explore": explore or None, "bus.kind": bus,
             "perception.weights": weights, "camera.source": source, "camera.poses": poses,
             "camera.intrinsics_px": numbers(intrinsics), "camera.rate_hz": rate, "camera.loop": loop or None}
    run_agent(configured(config, given, values), agent=agent, out=out, plain=plain, world=world, view=view)


@app.command()
def replay(logs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="folders of runs, or their logs")], *,
           into: Annotated[str, typer.Option(metavar="NAMES", help="services: perception,belief,planner,evaluator")],
           check: Annotated[bool, typer.Option("--check", help="exit code 1 if anything is not as recorded")] = False,
           bus: Annotated[Literal["zenoh", "local"], typer.Option(
               help="services as processes on Zenoh, or all within this one")] = "zenoh",
           rate: Annotated[str, typer.Option(help="times as fast as recorded, 0.1 to 100, or max")] = "max",
           start: Annotated[str | None, typer.Option(help="first step, or a time such as 2.5s")] = None,
           end: Annotated[str | None, typer.Option(help="last step, or a time such as 9s")] = None,
           episode: Annotated[int | None, typer.Option(min=0, help="only this one")] = None,
           topics: Annotated[str | None, typer.Option(metavar="NAMES", help="only these of the inputs")] = None,
           loop: Annotated[int, typer.Option(min=1, help="so many times")] = 1,
           step: Annotated[bool, typer.Option("--step", help="one message for each key press")] = False,
           perception: Annotated[Path | None, typer.Option(
               help="other weights: a folder, or its name in weights/; tells what moved")] = None,
           out: Annotated[Path | None, typer.Option(help="folder of the replay", show_default="replays/<time>")] = None,
           values: Values = None) -> None:
    """Play recorded inputs into services as they are now, log what they say, compare it with the recording.

    Space pauses and goes on, q ends.
    """
    from rich.console import Console

    from deploy.replay_report import replay_all, replays_of

    replays = replays_of(logs, into=into, rate=rate, start=start, end=end, episode=episode, topics=topics, step=step,
                         perception=perception, values=dict(parse_value(text) for text in values or ()))
    swapped = bool(perception or values)
    equal = replay_all(replays, bus=bus, out=out, swapped=swapped, loops=loop, console=wide(Console()))
    raise typer.Exit(int(check and not equal))


@app.command()
def bench(*, objects: Objects = None, scenes: ScenesFile = None,
          suite: Annotated[str | None, typer.Option(
              help="paper-500, yaw-500, lexa-room, dev (for tuning) or paper-like",
              show_default="paper-500 for ycb, paper-like for pantry")] = None,
          agent: Annotated[str, typer.Option(help="which agent")] = "sceneccn",
          limit: Annotated[int | None, typer.Option(min=1, help="only so many scenes, evenly chosen")] = None,
          jobs: Annotated[int, typer.Option(min=1, help="processes at a time")] = 1,
          cluster: Annotated[str | None, typer.Option(
              metavar="ADDRESS", help="a Ray cluster in place of --jobs: ray://host:10001")] = None,
          json: Annotated[Path | None, typer.Option(
              help="file for the results", show_default="bench/<agent>_<set>[_<suite>].json")] = None,
          yaw: Annotated[Literal["random", "fixed"] | None, typer.Option(
              help="the suite paper-like, drawn from --seed, its objects turned or not")] = None,
          seed: Seed = None, weights: WeightsFolder = None, config: ConfigFile = None, values: Values = None) -> None:
    """Measure an agent on many scenes; given again after an interruption, go on from there."""
    from rich.console import Console

    from deploy.bench import bench as run_bench
    from deploy.bench import prepare

    resolved = configured(config, {"scene.objects": objects, "scene.file": scenes, "seed": seed,
                                   "perception.weights": weights}, values)
    if yaw is not None and (resolved.scene.file is not None or suite is not None):
        raise SaccadeError("--yaw is for scenes that are drawn: leave it or --scenes and --suite out")
    if yaw is not None:
        suite = {"fixed": "paper-like", "random": "paper-like-yaw"}[yaw]
    name = "_".join(filter(None, (agent, resolved.scene.objects, suite)))
    plan = prepare(agent, resolved, json or Path("bench") / f"{name}.json", suite=suite, limit=limit)
    run_bench(plan, jobs=jobs, cluster=cluster, command=command_line(), console=wide(Console()))


@app.command()
def report(*, results: Annotated[list[Path], typer.Argument(
               metavar="RESULTS.json...", help="files of `saccade bench`")],
           out: Annotated[Path, typer.Option(help="folder of the report")],
           failures: Annotated[bool, typer.Option(
               "--failures", help="also failures.md: every failed scene, run again, by its cause")] = False,
           no_reruns: Annotated[bool, typer.Option(
               "--no-reruns", help="only what the results alone tell: no episodes are run again")] = False,
           weights: WeightsFolder = None,
           jobs: Annotated[int, typer.Option(min=1, help="processes at a time, for --failures")] = 1) -> None:
    """Write results as a page with tables and pictures: report.md."""
    from rich.console import Console

    from deploy.report import report as write_report

    write_report(results, out, failures=failures, reruns=not no_reruns, weights=weights, jobs=jobs, console=Console())


@app.command()
def train(*, objects: Objects = None, names: Names = None,
          out: Annotated[Path | None, typer.Option(
              help="folder of the training", show_default="training_runs/<set>")] = None,
          steps_ccn: Annotated[int | None, typer.Option(min=1, help="steps of each object's networks")] = None,
          steps_extraction: Annotated[int | None, typer.Option(min=1, help="steps of the network for all")] = None,
          views: Annotated[int | None, typer.Option(min=20, max=5000, help="views of each object")] = None,
          seed: Seed = None, jobs: Annotated[int, typer.Option(min=1, help="networks at a time")] = 1,
          device: Annotated[Literal["auto", "cpu", "cuda"] | None, typer.Option(show_default="auto")] = None,
          architecture: Annotated[Literal["default", "paper"], typer.Option(
              help="our networks, or those of the paper's tables; theirs go to folders named <set>-paper")] = "default",
          weights: WeightsFolder = None, values: Annotated[list[str] | None, typer.Option(
              "--set", metavar="KEY=VALUE", help="any key of training/settings.py, e.g. batch_ccn=64")] = None) -> None:
    """Train the networks of an object set; given again after an interruption, go on from there."""
    from rich.console import Console

    from services.simulator.core import names_in_use
    from shared.config import REPOSITORY, SceneConfig
    from training.run import export
    from training.run import train as run_training
    from training.settings import settings_from

    object_set = objects or "pantry"
    given = {"seed": seed, "steps_ccn": steps_ccn, "steps_extraction": steps_extraction, "views": views,
             "device": device, "architecture": architecture}
    chosen = names_in_use(SceneConfig(objects=object_set, names=split_names(names)))
    settings = settings_from({"objects": object_set, "names": chosen}
                             | {k: v for k, v in given.items() if v is not None}
                             | dict(parse_value(text) for text in values or ()))
    name = object_set if architecture == "default" else f"{object_set}-{architecture}"
    folder, target = out or Path("training_runs") / name, weights or REPOSITORY / "weights" / name
    run_training(folder, settings, jobs=jobs, console=Console())
    export(folder, target)
    print(f"weights written to {target}")


@app.command()
def doctor() -> None:
    """Check this machine: what works, what is missing, how to mend it."""
    from deploy.doctor import examine

    raise typer.Exit(examine())


Key = Annotated[str, typer.Argument(metavar="KEY", help="full key, topic or topic/part; * stands for any")]
LogFile = Annotated[Path | None, typer.Option(help="a log, or a run's folder, instead of a bus", metavar="RUN")]
Count = Annotated[int | None, typer.Option(min=1, help="end after so many messages")]
Endpoint = Annotated[str | None, typer.Option(help="the bus, e.g. tcp/127.0.0.1:7447")]
OfRun = Annotated[Path | None, typer.Option(
    metavar="FOLDER", help="of a run that goes on, for its bus", show_default="the newest in runs/ that answers")]


@app.command()
def topics(*, world: Annotated[str | None, typer.Option(
               help="world, the second part of every key", show_default="the run's, or table")] = None,
           log: LogFile = None,
           live: Annotated[bool, typer.Option(
               "--live", help="of a run that goes on; understood with --endpoint, --run or --seconds")] = False,
           seconds: Annotated[int | None, typer.Option(
               min=1, max=3600, help="how long to listen", show_default="2")] = None,
           endpoint: Endpoint = None, run: OfRun = None) -> None:
    """List what there is on the bus: topics, keys, message types; live or from a log, the keys and how much comes."""
    from rich.console import Console

    from deploy.topics import topics as list_topics

    list_topics(world=world, log=log, on_bus=live, seconds=seconds, endpoint=endpoint, run=run, console=wide(Console()))


@app.command()
def echo(key: Key, log: LogFile = None, count: Count = None, endpoint: Endpoint = None, run: OfRun = None) -> None:
    """Print messages, live or from a log; Ctrl-C ends it."""
    from deploy.echo import echo as print_messages

    print_messages(key, log=log, count=count, endpoint=endpoint, run=run)


@app.command()
def hz(key: Key, log: LogFile = None, count: Count = None, endpoint: Endpoint = None, run: OfRun = None) -> None:
    """Show how often messages come and how evenly, live or from a log; Ctrl-C ends it."""
    from deploy.hz import hz as show_rates

    show_rates(key, log=log, count=count, endpoint=endpoint, run=run)


def wide(console: Any) -> Any:
    """Room for a table where nobody looks at a terminal: in a file or a pipe."""
    if not console.is_terminal:
        console.width = max(console.width, 140)
    return console


def command_line() -> str:
    """The command as it was given."""
    return shlex.join(["saccade", *sys.argv[1:]])


def main() -> None:
    """The console script: what the user can mend is one line and exit code 2, Ctrl-C one line and 130."""
    prefer_one_thread()
    try:
        app()
    except SaccadeError as error:
        print(f"saccade: {error}", file=sys.stderr)
        sys.exit(EXIT_ERROR)
    except SystemExit as error:
        if error.code == EXIT_INTERRUPTED:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # once more would break into the interpreter's end
            reason = getattr(error.__context__, "__cause__", None)
            print(f"saccade: interrupted{f': {reason}' if str(reason or '') else ''}", file=sys.stderr)
        raise


if __name__ == "__main__":
    main()
