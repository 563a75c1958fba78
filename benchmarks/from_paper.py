"""`python -m saccade.benchmarks.from_paper OUT [LIMIT]` goes from the paper's agent to Saccade's, one step at a time.

Each step gives one group of settings Saccade's value and keeps those of the steps before. Every row is measured on the
development scenes (or on LIMIT of them). OUT gets the results files and `steps.md`. What is there is not run again.
"""

from __future__ import annotations

import sys
from functools import reduce
from pathlib import Path
from typing import Any

from rich.console import Console

from saccade.app.bench.bench import bench, prepare
from saccade.app.bench.repeat import Results, read_results
from saccade.app.bench.table import mean, rows
from saccade.shared.config import Config, load
from saccade.shared.files import replace_whole

STEPS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("the paper's agent", ()),
    ("an object counts as seen from a lower presence on", ("belief.present_above",)),
    ("an object that was not seen is ruled out less", ("belief.missed_weight",)),
    ("particles are moved more, born anew and resampled less", ("belief.jitter_m", "belief.born",
                                                                "belief.resample_below")),
    ("an object may hide behind outlines only", ("belief.hidden",)),
    ("calibrated covariances", ("belief.covariance",)),
    ("the pose from all views", ("belief.pose",)),
    ("the goal's pixel", ("planner.goal_pixel",)),
    ("second thoughts", ("planner.retry",)),
    ("a goal image of nothing known is not followed", ("planner.goal_confidence",)),
    ("Saccade's networks", ("perception.architecture",)),
)


def value_of(tree: dict[str, Any], key: str) -> Any:
    return reduce(lambda node, part: node[part], key.split("."), tree)


def measure(out: Path, limit: int | None, console: Console) -> list[tuple[str, Results]]:
    """Measures what is missing. Returns the results of each step."""
    ours, config = Config().model_dump(mode="json"), load(None, "paper").with_values({"scene.objects": "ycb"})
    found = []
    for number, (name, keys) in enumerate(STEPS):
        config = config.with_values({key: value_of(ours, key) for key in keys})
        path = out / f"{number:02}.json"
        if not path.is_file():
            console.print(name)
            plan = prepare("sceneccn", config, path, suite="dev", limit=limit)
            bench(plan, jobs=1, command=f"python -m saccade.benchmarks.from_paper {out.name}", console=console)
        found.append((name, read_results(path)))
    return found


def page(found: list[tuple[str, Results]]) -> str:
    """The steps as a Markdown table: success with Wilson's interval, median steps, and the change of success from the
    row above, over the scenes that both have, with its standard error."""
    lines = ["| each row keeps what the rows above have | scenes | success (%) | change | median steps |",
             "| --- | --- | --- | --- | --- |"]
    before: Results | None = None
    for name, results in found:
        row, change = rows(results.records)[-1], ""
        if before is not None:
            earlier = {record["scene"]: record["success"] for record in before.records}
            paired = mean([100.0 * (record["success"] - earlier[record["scene"]])
                           for record in results.records if record["scene"] in earlier])
            change = f"{paired.value:+.1f} ± {paired.standard_error or 0.0:.1f}"
        share = row.success
        told = f"{100 * share.value:.1f} ({100 * share.low:.1f} to {100 * share.high:.1f})"
        lines.append(f"| {name} | {row.scenes} | {told} | {change} | {row.median_steps:g} |")
        before = results
    return "\n".join(lines) + "\n"


def main(out: Path, limit: int | None) -> None:
    """Measures and writes the page."""
    console = Console()
    out.mkdir(parents=True, exist_ok=True)
    text = page(measure(out, limit, console))
    replace_whole(out / "steps.md", text.encode())
    console.print(text)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit("saccade: name a folder: python -m saccade.benchmarks.from_paper OUT [LIMIT]")
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else None)
