"""`saccade report` turns results files into a Markdown page with pictures, with the paper's figures beside ours."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

from rich.console import Console

from saccade.app.bench import charts as pictures
from saccade.app.bench.bench import SCENES_ENDING
from saccade.app.bench.failures import failed_scenes, section
from saccade.app.bench.repeat import Again, Results, prepare_again, read_results, replay, same_as, told_otherwise
from saccade.app.bench.table import (
    MEASURES,
    PAPER,
    PAPER_AGENTS,
    PAPER_ROOM,
    Estimate,
    Figures,
    Row,
    milliseconds,
    rows,
)
from saccade.app.run.display import say
from saccade.app.run.threads import enforce_one_thread
from saccade.shared.config import validate
from saccade.shared.errors import SaccadeError
from saccade.shared.files import replace_whole, writing
from saccade.shared.model.weights import Weights

ORACLE = "oracle"
REPORT_NAME, FAILURES_NAME, FOLDER = "report.md", "failures.md", "report"


def report(paths: Sequence[Path], out: Path, *, failures: bool = False, reruns: bool = True,
           weights: Path | None = None, jobs: int = 1, console: Console) -> None:
    """Writes `out`/report.md and its pictures. With `failures` it also writes failures.md, for which every failed scene
    is run again. Without `reruns` there are no pictures of episodes. Raises SaccadeError if no results are given."""
    enforce_one_thread()
    paths = [path for path in paths if not path.name.endswith(SCENES_ENDING)]  # scenes lie beside results
    if not paths:
        raise SaccadeError("no results are given: name files that `saccade bench` has written")
    files = labelled([read_results(path) for path in paths])
    with writing(out, "report"):
        (out / FOLDER).mkdir(parents=True, exist_ok=True)
    lines = ["# Results", "", *origins(files), *success_and_errors(files), *side_by_side(files), *plots(files, out),
             *conduct(files), *training(files)]
    with tempfile.TemporaryDirectory() as folder:
        again = _again(files, Path(folder), weights) if reruns or failures else {}
        if reruns:
            lines += _episodes(files, again, out, console)
        _write(out / REPORT_NAME, lines, console)
        if failures:
            page = ["# Failures", "",
                    "Every failed scene was run again and compared with the truth. The scenes are sorted by the first "
                    "thing that went wrong.", ""]
            for file in files:
                page += _failed(file, again[file.path], out, jobs, console)
            _write(out / FAILURES_NAME, page, console)


def labelled(files: Sequence[Results]) -> list[Results]:
    """Puts the oracle last, because it is the floor, and makes equal labels different. Raises SaccadeError if two files
    have the same name, because their pictures would have the same name too."""
    stem, often = Counter(file.path.stem for file in files).most_common(1)[0]
    if often > 1:
        raise SaccadeError(f"{often} results files are called {stem}: rename all but one")
    counts = Counter(file.label for file in files)
    named = [replace(f, label=f.label if counts[f.label] == 1 else f"{f.label} ({f.path.stem})") for f in files]
    return sorted(named, key=lambda file: file.agent == ORACLE)


def origins(files: Sequence[Results]) -> list[str]:
    """Says where each results file comes from."""
    lines = ["| results | file | scenes | sha256 of the scenes | commit | weights | processor |",
             "| --- | --- | ---: | --- | --- | --- | --- |"]
    for file in files:
        facts = file.facts
        commits = ", ".join(c[:12] + "-dirty" * c.endswith("-dirty") for c in facts["commit"].split(", "))
        hashes = " ".join(sorted({digest[:8] for digest in facts["weights"].values()})) or "none"
        lines.append(f"| {file.label} | {file.path.name} | {len(file.records)} | {facts['scenes']['sha256'][:12]} | "
                     f"{commits} | {hashes} | {facts['machine']['processor']} |")
    return [*lines, ""]


def success_and_errors(files: Sequence[Results]) -> list[str]:
    """Puts all results and the paper's into one table. Then follows the paper's table for each file: target by target,
    with the paper's figures beside ours."""
    measures = ["success (%)", *MEASURES.values()]
    lines = ["## Success and errors", "", "Success with Wilson's 95 % interval; errors as mean ± standard error.", "",
             "| agent, objects, scenes | " + " | ".join(measures) + " |", "| --- |" + " ---: |" * len(measures)]
    lines += [f"| paper: {agent}, its 500 scenes | " + " | ".join(_paper_cells(figures)) + " |"
              for agent, figures in PAPER_AGENTS.items()]
    lines += [f"| {f.label}{' (floor)' * (f.agent == ORACLE)} | " + " | ".join(_cells(rows(f.records)[-1])) + " |"
              for f in files]
    if files[-1].agent == ORACLE:
        lines += ["", "The oracle is told the goal's view. As an episode ends once the camera is within tolerance, "
                  "its errors are the floor for any agent."]
    if any(file.suite == "lexa-room" for file in files):
        room = ", ".join(f"{agent} {share}" for agent, share in PAPER_ROOM.items())
        lines += ["", f"The paper's agents in one room of five objects, success of 100 goals (%): {room}."]
    for file in files:
        if file.agent == ORACLE:
            continue
        lines += ["", f"### {file.label}", "", "| target | " + " | ".join(f"{m} | paper" for m in measures) + " |",
                  "| --- |" + " ---: | ---: |" * len(measures)]
        for row in rows(file.records):
            pairs = zip(_cells(row), _paper_cells(PAPER.get(row.name) if file.objects == "ycb" else None), strict=True)
            lines.append(f"| {row.name} | " + " | ".join(f"{ours} | {theirs}" for ours, theirs in pairs) + " |")
    return [*lines, ""]


def _cells(row: Row) -> list[str]:
    share = row.success
    return [f"{100 * share.value:.1f} ({100 * share.low:.1f} to {100 * share.high:.1f})", *map(_mean, row.means)]


def _mean(estimate: Estimate) -> str:
    known = estimate.standard_error is not None
    return f"{estimate.value:.3f}" + (f" ± {estimate.standard_error:.3f}" if known else "")


def _paper_cells(figures: Figures | None) -> list[str]:
    if figures is None:
        return ["-"] * (1 + len(MEASURES))
    errors = [f" ± {error:.3f}" for error in figures.errors] if figures.errors else [""] * len(figures.means)
    return [f"{figures.success_percent:.1f}", *(f"{m:.3f}{e}" for m, e in zip(figures.means, errors, strict=True))]


def side_by_side(files: Sequence[Results]) -> list[str]:
    """Compares files of the same scenes: what is different in each, and what that changed in the success of each scene.
    The others are compared with the first file."""
    groups: dict[str, list[Results]] = {}
    for file in files:
        groups.setdefault(file.facts["scenes"]["sha256"], []).append(file)
    lines = []
    for base, *others in groups.values():
        if not others:
            continue
        lines += [f"## Side by side: {base.suite}", "",
                  "Gained and lost: scenes solved that the first does not solve, and the other way round.", "",
                  "| results | differs in | success (%) | gained, lost | " + " | ".join(MEASURES.values())
                  + " | median steps | mean steps |", "| --- | --- | ---: | ---: |" + " ---: |" * (len(MEASURES) + 2)]
        solved = {r["scene"] for r in base.records if r["success"]}
        for file in (base, *others):
            row, mine = rows(file.records)[-1], {r["scene"] for r in file.records if r["success"]}
            shared = {r["scene"] for r in base.records} & {r["scene"] for r in file.records}
            change = "-" if file is base else f"+{len((mine - solved) & shared)}, -{len((solved - mine) & shared)}"
            lines.append(f"| {file.path.stem} | {', '.join(differences(base, file)) or '-'} | "
                         f"{100 * row.success.value:.1f} | {change} | " + " | ".join(map(_mean, row.means))
                         + f" | {row.median_steps:g} | {fmean(r['steps'] for r in file.records):.1f} |")
        lines.append("")
    return lines


def differences(base: Results, other: Results) -> list[str]:
    """Returns what is different in another run: the agent, the weights, or keys of the configuration."""
    found = [] if base.agent == other.agent else [f"agent {other.agent}"]
    found += told_otherwise(base.facts["config"], other.facts["config"])
    changed = base.facts["weights"] != other.facts["weights"] and base.agent == other.agent
    return found + ["weights"] * (changed and not any(f.startswith("perception.weights") for f in found))


def plots(files: Sequence[Results], out: Path) -> list[str]:
    """Draws the plots that need the results alone."""
    shown = {"errors": (pictures.draw_errors, "Errors of the last view; triangles are means"),
             "objects": (pictures.draw_objects, "Success against the number of objects on the table"),
             "steps": (pictures.draw_steps, "Goals reached within so many steps")}
    lines = []
    for name, (draw, caption) in shown.items():
        draw(files, out / FOLDER / f"{name}.png")
        lines += [f"![{caption}]({FOLDER}/{name}.png)", "", f"*{caption}.*", ""]
    return lines


def conduct(files: Sequence[Results]) -> list[str]:
    """Describes the steps, what the agent says about its arrival, and what a step costs."""
    lines = ["## Steps, declarations, time", "",
             "Declared means that the agent said that it had arrived. A false alarm means that it had not arrived when "
             "it first said so. An episode that ends at the goal, as the paper's do, can show false alarms only. With "
             "`simulator.until=declared` an episode ends when the agent says that it has arrived. Reached then means "
             "that the camera was within tolerance at some step until that moment.", "",
             "| results | median steps (interquartile range) | reached (%) | declared (%) | rightly, of those (%) | "
             "declared and right, of all (%) | false alarms, of all (%) | milliseconds per step |",
             "| --- | ---: | ---: | ---: | ---: | ---: | ---: | --- |"]
    for file in files:
        row = rows(file.records)[-1]
        own_word = file.facts["config"]["simulator"]["until"] == "declared"
        rightly = row.declared_true if own_word else None
        shares = [row.success.value, row.declared if own_word else None, rightly,
                  None if rightly is None else row.declared * rightly, row.false_alarms]
        said = " | ".join("-" if share is None else f"{100 * share:.1f}" for share in shares)
        spent = ", ".join(f"{name} {ms:.1f}" for name, ms in milliseconds(file.records).items()) or "-"
        lines.append(f"| {file.label} | {row.median_steps:g} ({row.middle_steps[0]:g} to {row.middle_steps[1]:g}) | "
                     f"{said} | {spent} |")
    return [*lines, ""]


def training(files: Sequence[Results]) -> list[str]:
    """Says what the training of the weights took, according to their manifests. It covers weights that are at hand and
    unchanged."""
    lines: dict[Path, str] = {}
    for file in files:
        folder = validate(file.facts["config"], str(file.path)).weights
        try:
            weights = Weights(folder)
        except SaccadeError:
            continue
        if weights.hashes == file.facts["weights"]:
            facts = weights.manifest
            steps = facts["training"]
            lines[folder] = (f"| {folder.name} | {facts['where_trained']} | {facts['seconds'] / 3600:.1f} | "
                             f"{steps['steps_ccn']:,} x {steps['batch_ccn']} | "
                             f"{steps['steps_extraction']:,} x {steps['batch_extraction']} |")
    head = ["## Training", "", "Hours are of one process; the networks of a set can be trained side by side.", "",
            "| weights | where | hours | CCN: steps x batch | extraction: steps x batch |",
            "| --- | --- | ---: | ---: | ---: |"]
    return [*head, *lines.values(), ""] if lines else []


def _again(files: Sequence[Results], folder: Path, weights: Path | None) -> dict[Path, Again | SaccadeError]:
    """Returns for each file what is needed to run its scenes again, or the error that says why this is not possible."""
    found: dict[Path, Again | SaccadeError] = {}
    for k, file in enumerate(files):
        (own := folder / str(k)).mkdir()
        try:
            found[file.path] = prepare_again(file, own, weights)
        except SaccadeError as error:
            found[file.path] = error
    return found


def _episodes(files: Sequence[Results], again: dict[Path, Any], out: Path, console: Console) -> list[str]:
    """Draws the galleries of all files, and the exploration of the first agent that keeps a belief."""
    lines, explored = ["## Goals and what was reached", ""], None
    for file in files:
        ready = again[file.path]
        if isinstance(ready, SaccadeError):
            say(console, f"saccade: no episodes of {file.label}: {ready}")
            lines += [f"{file.label}: not run again, since its scenes or weights are not at hand.", ""]
            continue
        console.print(f"running scenes of {file.label} again", markup=False)
        lines += _gallery(ready, out)
        if explored is None and file.agent != ORACLE:
            explored = pictures.explore(ready)
    if explored is not None:
        result = explored.story.result
        assert result is not None  # every episode that ran to its end has one
        pictures.draw_exploration(explored, out / FOLDER / "exploration.png")
        lines += ["## Exploration", "", "Without a goal the camera goes where it expects to learn most about where the "
                  f"objects are. Scene {result.scene}.", "",
                  f"![Belief after a number of views]({FOLDER}/exploration.png)", ""]
    return lines


def _gallery(again: Again, out: Path) -> list[str]:
    worst, middle = pictures.pick(again.results.records)
    cases, other = [], []
    for kind, records in (("worst", worst), ("median", middle)):
        for record in records:
            story = replay(*again.arguments(record["scene"]))
            cases.append((f"{kind}: {record['scene']}", story))
            other += [] if same_as(story, record) else [record["scene"]]
    name = f"gallery_{again.results.path.stem}.png"
    pictures.draw_gallery(cases, out / FOLDER / name)
    lines = [f"![{again.results.label}: goals above, last views below]({FOLDER}/{name})", "",
             f"*{again.results.label}: the worst cases and those in the middle.*", ""]
    if other:
        lines += ["Run again, these did not end as in the results (other code or another machine): "
                  f"{', '.join(other)}.", ""]
    return lines


def _failed(file: Results, ready: Again | SaccadeError, out: Path, jobs: int, console: Console) -> list[str]:
    if isinstance(ready, SaccadeError):
        raise ready
    cases = failed_scenes(ready, out, jobs=jobs, console=console)
    return section(file.label, len(file.records), [(d, p.relative_to(out).as_posix()) for d, p in cases])


def _write(path: Path, lines: Sequence[str], console: Console) -> None:
    with writing(path, "report"):
        replace_whole(path, ("\n".join(lines).rstrip("\n") + "\n").encode())
    say(console, f"written to {path}")
