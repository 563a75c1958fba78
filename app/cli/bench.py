"""`saccade bench` and `saccade report`: how well an agent does."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from saccade.app.cli.options import (
    AGENT_DEFAULT,
    AGENTS,
    ConfigFile,
    Objects,
    ScenesFile,
    Seed,
    Values,
    WeightsFolder,
    command_line,
    wide,
)
from saccade.app.cli.texts import configured, split_names
from saccade.shared.errors import SaccadeError

app = typer.Typer()
Cluster = Annotated[str | None, typer.Option(
    metavar="ADDRESS", help="Use a Ray cluster instead of --jobs, such as ray://host:10001.")]


@app.command()
def bench(*, objects: Objects = None, scenes: ScenesFile = None,
          suite: Annotated[str | None, typer.Option(
              help="Scenes: paper-500, yaw-500, lexa-room, looks, dev (for tuning), paper-like, paper-like-yaw, "
                   "twins, lying, moving, drifting, crowd or anywhere.",
              show_default="paper-500 for ycb, paper-like for pantry")] = None,
          agent: Annotated[str | None, typer.Option(
              help=f"Which agent to measure: {AGENTS}.", show_default=AGENT_DEFAULT)] = None,
          limit: Annotated[int | None, typer.Option(min=1, help="Run only so many scenes, chosen evenly.")] = None,
          jobs: Annotated[int, typer.Option(min=1, help="How many processes work at a time.")] = 1,
          cluster: Cluster = None,
          json: Annotated[Path | None, typer.Option(
              help="File for the results.", show_default="bench/<agent>_<set>[_<suite>].json")] = None,
          yaw: Annotated[Literal["random", "fixed"] | None, typer.Option(
              help="Draw the suite paper-like from --seed, with its objects turned or not.")] = None,
          seed: Seed = None, weights: WeightsFolder = None, config: ConfigFile = None, values: Values = None) -> None:
    """Measure an agent on many scenes. The same command continues after an interruption."""
    from rich.console import Console

    from saccade.app.bench.bench import bench as run_bench
    from saccade.app.bench.bench import prepare
    from saccade.services.simulator.suites import SUITES

    of_suite = dict(SUITES[suite].values) if suite in SUITES else {}
    lying = suite in SUITES and SUITES[suite].lying
    resolved, agent = configured(config, {"scene.objects": objects, "scene.file": scenes, "seed": seed,
                                          "perception.weights": weights} | of_suite, values, agent, lying=lying)
    if yaw is not None and (resolved.scene.file is not None or suite is not None):
        raise SaccadeError("--yaw is for scenes that are drawn: leave it or --scenes and --suite out")
    if yaw is not None:
        suite = {"fixed": "paper-like", "random": "paper-like-yaw"}[yaw]
    name = "_".join(filter(None, (agent, Path(resolved.scene.objects).name, suite)))
    plan = prepare(agent, resolved, json or Path("bench") / f"{name}.json", suite=suite, limit=limit)
    run_bench(plan, jobs=jobs, cluster=cluster, command=command_line(), console=wide(Console()))


@app.command()
def report(*, results: Annotated[list[Path], typer.Argument(
               metavar="RESULTS.json...", help="Results files of `saccade bench`.")],
           out: Annotated[Path, typer.Option(help="Folder of the report.")],
           failures: Annotated[bool, typer.Option(
               "--failures", help="Also write failures.md: every failed scene is run again and sorted by its "
                                  "cause.")] = False,
           no_reruns: Annotated[bool, typer.Option(
               "--no-reruns", help="Run no episode again, and tell only what the results hold.")] = False,
           weights: WeightsFolder = None,
           jobs: Annotated[int, typer.Option(
               min=1, help="How many processes work at a time, for --failures.")] = 1) -> None:
    """Write results as a page with tables and pictures (report.md)."""
    from rich.console import Console

    from saccade.app.bench.report import report as write_report

    write_report(results, out, failures=failures, reruns=not no_reruns, weights=weights, jobs=jobs, console=Console())


@app.command()
def table(*, out: Annotated[Path, typer.Option(help="Folder of the page and of the results.")],
          objects: Annotated[str | None, typer.Option(
              metavar="SET", help="Object set: ycb or pantry.", show_default="ycb")] = None,
          agents: Annotated[str | None, typer.Option(
              metavar="NAMES", help="Only these agents, such as posecnn,lexa.", show_default="all")] = None,
          limit: Annotated[int | None, typer.Option(
              min=1, help="Run only so many scenes of each suite, chosen evenly.")] = None,
          jobs: Annotated[int, typer.Option(min=1, help="How many processes work at a time.")] = 1,
          cluster: Cluster = None) -> None:
    """Compare all agents of the paper, and others, on its suites. The same command continues after an interruption."""
    from rich.console import Console

    from saccade.app.bench.comparison import compare

    compare(out, objects or "ycb", agents=split_names(agents), limit=limit, jobs=jobs, cluster=cluster,
            command=command_line(), console=wide(Console()))
