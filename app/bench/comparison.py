"""`saccade table` compares all agents: it runs the benchmarks that are not there yet, and writes the paper's tables.

The results of each agent on each suite are a file of `saccade bench` in the folder `results`. A file that holds the
wanted scenes of the same agent is taken as it is; an interrupted benchmark goes on.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

from rich.console import Console

from saccade.app.bench.bench import Plan, bench, differing, facts, prepare
from saccade.app.bench.charts import draw_errors, draw_final_views, draw_learning
from saccade.app.bench.repeat import Results, prepare_again, read_results, replay
from saccade.app.bench.table import MEASURES, PAPER_AGENTS, PAPER_ROOM, Row, milliseconds, rows, summarise
from saccade.app.look.picture import Story
from saccade.app.run.display import say
from saccade.app.run.registry import AGENTS, agent_of
from saccade.shared.config import Config, load
from saccade.shared.errors import SaccadeError, told
from saccade.shared.files import replace_whole, writing
from saccade.shared.model.weights import Weights

ROOM = "lexa-room"
SUITES_OF = {"ycb": ("paper-500", "yaw-500", ROOM), "pantry": ("paper-like", "paper-like-yaw", ROOM)}
COMPARED = ("sceneccn", "paper", "posecnn", "posecnn-infogain", "render-and-compare")  # on all suites
IN_THE_ROOM = ("lexa", "random-walk", "still")  # in the room only: one was trained there, the others know nothing
PAPERS_NAMES = {"paper": "SceneCCN + AIF", "posecnn": "PoseCNN (uses depth)", "posecnn-infogain": "PoseCNN + Infogain"}
PAPERS_ROOM = {"paper": "SceneCCN", "posecnn": "PoseCNN", "posecnn-infogain": "PoseCNN + Infogain",
               "lexa": "LEXA (about 7 M steps)"}
PAPERS_STEPS = 7e6  # environment steps of the paper's LEXA
GOALS_SHOWN = 10  # columns of the picture of final views
PAGE, FOLDER = "table.md", "results"


@dataclass(frozen=True)
class Cell:
    """One agent on one suite, and the file of its results."""

    agent: str
    suite: str
    path: Path


def cells(out: Path, objects: str, agents: Sequence[str] | None) -> list[Cell]:
    """All that is compared, suite by suite. Raises SaccadeError if the set has no suites, if no agent is named, or if
    one is unknown or has no place in the table."""
    known = (*COMPARED, *IN_THE_ROOM)
    if objects not in SUITES_OF:
        raise SaccadeError(f"--objects {told(objects)} has no suites for the table: choose from "
                           f"{', '.join(SUITES_OF)}")
    if agents is not None and not agents:
        raise SaccadeError(f"--agents names none: choose from {', '.join(known)}")
    for agent in agents or ():
        agent_of(agent)
        if agent not in known:
            raise SaccadeError(f"agent {agent!r} is not in the table: choose from {', '.join(known)}")
    chosen = [agent for agent in known if agents is None or agent in agents]
    return [Cell(agent, suite, out / FOLDER / f"{agent}_{objects}_{suite}.json")
            for suite in SUITES_OF[objects] for agent in chosen if suite == ROOM or agent in COMPARED]


def compare(out: Path, objects: str, *, agents: Sequence[str] | None = None, limit: int | None = None, jobs: int = 1,
            cluster: str | None = None, command: str = "saccade table", console: Console) -> list[Path]:
    """Runs what is missing, and writes the page with its pictures. Returns the results files.

    Raises SaccadeError if the weights of an agent are missing or do not serve it; what was measured before is kept.
    """
    wanted = cells(out, objects, agents)
    with writing(out, "table"):
        (out / FOLDER).mkdir(parents=True, exist_ok=True)
    plans = {cell: prepare(cell.agent, _configuration(cell.agent, objects), cell.path, suite=cell.suite, limit=limit)
             for cell in wanted}  # all of them first, so that what is missing is told soon
    for cell, plan in plans.items():
        if not _is_there(plan, command):
            say(console, f"{cell.agent} on {cell.suite}")
            bench(plan, jobs=jobs, command=command, console=console, cluster=cluster)
    write_page(out, {cell: read_results(cell.path) for cell in wanted},
               {cell: len(plan.scenes) for cell, plan in plans.items()}, console)
    return [cell.path for cell in wanted]


def _is_there(plan: Plan, command: str) -> bool:
    """Whether the results of a plan are there: of the same agent, weights and scenes, and all that are wanted."""
    if not plan.out.is_file():
        return False
    results, origin = read_results(plan.out), facts(plan, command)
    held = {record["scene"] for record in results.records}
    return not differing(results.facts, origin) and held >= {plan.scenes[number].id for number in plan.chosen}


def _configuration(agent: str, objects: str) -> Config:
    return load(None, AGENTS[agent].preset).with_values({"scene.objects": objects})


def write_page(out: Path, found: dict[Cell, Results], scenes: dict[Cell, int], console: Console) -> None:
    """Writes table.md and its pictures from results files. `scenes` says how many scenes each suite has."""
    lines = ["# All agents, side by side", "",
             "Success with Wilson's 95 % interval; errors of the last view, mean ± standard error; milliseconds per "
             "step of perception, belief and planner together. The paper's figures stand below ours.", ""]
    for suite in dict.fromkeys(cell.suite for cell in found):
        mine = {cell.agent: results for cell, results in found.items() if cell.suite == suite}
        lines += [f"## {suite}", "", *table_of(suite, mine), ""]
        picture = out / f"errors_{suite}.png"
        draw_errors([replace(results, label=agent) for agent, results in mine.items()], picture)
        lines += [f"![Errors of azimuth, elevation and range on {suite}]({picture.name})", ""]
        if suite != ROOM:
            lines += [*by_target(mine), ""]
    lines += ["## What each agent has", "", *budgets(found), "",
              "At the pace of these results, all scenes of this table take "
              f"{core_hours(found, scenes):.1f} hours of one core.", ""]
    room = {cell.agent: results for cell, results in found.items() if cell.suite == ROOM}
    if "lexa" in room:
        lines += _learning("lexa", room["lexa"].objects, out)
    if room:
        draw_final_views(_final_views(room, console), out / "final_views.png")
        lines += ["## The views that were reached in the room", "",
                  "![The goals, and below them the last view of each agent](final_views.png)", ""]
    with writing(out / PAGE, "table"):
        replace_whole(out / PAGE, ("\n".join(lines).rstrip() + "\n").encode())
    say(console, f"written to {out / PAGE}")


def table_of(suite: str, results: dict[str, Results]) -> list[str]:
    """The table of one suite: a row for each agent, and below it the paper's row."""
    lines = ["| agent | scenes | success | " + " | ".join(MEASURES.values()) + " | median steps | ms per step |",
             "| --- | --- | --- |" + " --- |" * (len(MEASURES) + 2)]
    for agent, of in results.items():
        row = rows(of.records)[-1]
        spent = milliseconds(of.records)
        agents_ms = sum(spent.get(service, 0.0) for service in ("perception", "belief", "planner"))
        lines.append(f"| **{agent}** | {row.scenes} | {_share(row)} | {_means(row)} | {row.median_steps:g} | "
                     f"{agents_ms:.0f} |")
        if suite == ROOM and agent in PAPERS_ROOM:
            lines.append(f"| paper: {PAPERS_ROOM[agent]} | 100 | {PAPER_ROOM[PAPERS_ROOM[agent]]} % | | | | | |")
        elif suite == "paper-500" and agent in PAPERS_NAMES:
            theirs = PAPER_AGENTS[PAPERS_NAMES[agent]]
            means = " | ".join(f"{mean:.3f} ± {error:.3f}"
                               for mean, error in zip(theirs.means, theirs.errors or (), strict=True))
            lines.append(f"| paper: {PAPERS_NAMES[agent]} | 500 | {theirs.success_percent:.1f} % | {means} | | |")
    return lines


def by_target(results: dict[str, Results]) -> list[str]:
    """The share of successes (%) of each agent for each target."""
    targets = list(dict.fromkeys(r["target"] for of in results.values() for r in of.records))
    lines = ["| success for each target | " + " | ".join(targets) + " |", "| --- |" + " --- |" * len(targets)]
    for agent, of in results.items():
        each = [[r for r in of.records if r["target"] == target] for target in targets]
        shares = [f"{100 * summarise(t, records).success.value:.0f} %" if records else "-"
                  for t, records in zip(targets, each, strict=True)]
        lines.append(f"| {agent} | " + " | ".join(shares) + " |")
    return lines


def core_hours(found: dict[Cell, Results], scenes: dict[Cell, int]) -> float:
    """Hours of one core for all `scenes`, if they take as long as those that were measured."""
    return sum(count * fmean(record["seconds"] for record in found[cell].records)
               for cell, count in scenes.items()) / 3600


def budgets(found: dict[Cell, Results]) -> list[str]:
    """What each agent works with, and how its networks were trained."""
    lines = ["| agent | works with | trained |", "| --- | --- | --- |"]
    for agent, of in {cell.agent: results for cell, results in found.items()}.items():
        lines.append(f"| {agent} | {AGENTS[agent].knows} | {_training(agent, of.objects)} |")
    return lines


def _training(agent: str, objects: str) -> str:
    if not AGENTS[agent].weights:
        return "not at all"
    manifest = Weights(_configuration(agent, objects).weights).manifest
    hours = f"{manifest['seconds'] / 3600:.1f}" if "seconds" in manifest else "unknown"
    return f"{manifest.get('data', 'unknown')}; {hours} hours on {manifest.get('where_trained', 'unknown')}"


def _learning(agent: str, objects: str, out: Path) -> list[str]:
    """How the agent that lives in the room learns, drawn from what its weights say."""
    measured = Weights(_configuration(agent, objects).weights).manifest.get("measured")
    if not measured:
        return []
    draw_learning(measured, (PAPERS_STEPS, PAPER_ROOM[PAPERS_ROOM[agent]]), out / "learning.png")
    return [f"## How {agent} learns", "",
            f"Goals of the room that it never learns from, and that are not the suite's: {measured[-1]['goals']:.0f} "
            "at each point, with Wilson's 95 % intervals. A tolerance, 7.5 cm or 0.5 rad, counts as success.", "",
            "![Goals reached over environment steps, and how near it comes](learning.png)", ""]


def _share(row: Row) -> str:
    share = row.success
    return f"{100 * share.value:.1f} % ({100 * share.low:.1f} to {100 * share.high:.1f})"


def _means(row: Row) -> str:
    return " | ".join(f"{mean.value:.3f}" + (f" ± {mean.standard_error:.3f}" if mean.standard_error else "")
                      for mean in row.means)


def _final_views(room: dict[str, Results], console: Console) -> dict[str, list[Story]]:
    """The last views of every agent for goals of the room that all of them have, spread evenly. The episodes are run
    again."""
    everyone = [{r["scene"] for r in of.records} for of in room.values()]
    common = [r["scene"] for r in next(iter(room.values())).records if all(r["scene"] in one for one in everyone)]
    count = min(GOALS_SHOWN, len(common))
    chosen = [common[k * len(common) // count] for k in range(count)]
    stories: dict[str, list[Story]] = {}
    with tempfile.TemporaryDirectory() as folder, console.status("running ten goals again"):
        for agent, of in room.items():
            again = prepare_again(of, Path(folder))
            stories[agent] = [replay(*again.arguments(scene)) for scene in chosen]
    return stories
