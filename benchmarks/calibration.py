"""`python -m saccade.benchmarks.calibration OUT [--objects SET] [--agent AGENT] [--suite SUITE] [--limit N] [--seed N]
[--before FILE]` compares what an agent believes with the truth, step by step.

Three probabilities are compared. A percept says that its object is in the image; an object of which less than 0.3 is
seen, but something, counts neither way. A belief says that its object is on the table. And the belief about the target
gives a probability that the camera is within the tolerance of the goal. OUT is the file of the results; the picture of
the reliability curves lies beside it, with those of results from before if a file of them is named.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track

from saccade.app.bench.bench import RUN, cores, prepare
from saccade.app.look.picture import new_figure, save
from saccade.app.palette import COLOURS
from saccade.app.run.registry import agent_of
from saccade.services.planner.goal import Preference, aim, infer_preference
from saccade.services.simulator.suites import SUITES
from saccade.shared.bus.messages import Belief, Message, Percept, Truth
from saccade.shared.bus.topics import GOAL_PERCEPT, PERCEPT, Topic
from saccade.shared.config import load
from saccade.shared.errors import SaccadeError
from saccade.shared.files import parse_json, read_text, write_json
from saccade.shared.log.provenance import commit
from saccade.shared.loop.local import run_local
from saccade.shared.render.objects import load_mesh
from saccade.shared.world.geometry import direction, viewing_grid
from saccade.shared.world.sight import IN_VIEW, seen_shares
from saccade.shared.world.task import success
from saccade.shared.world.workspace import NO_BOXES, Boxes

BINS = 10
MAX_BYTES = 1024 * 1024
DRAWN = 200  # goal poses that are drawn from a belief
KINDS = {"percept": "the object is in the image", "belief": "the object is on the table",
         "within": "the camera is within the tolerance"}


class Told(NamedTuple):
    """A probability, and whether it was so."""

    probability: float
    was: bool


def within_tolerance(belief: Belief, preference: Preference, rng: np.random.Generator) -> float:
    """Probability by the belief about the target that the camera is within the tolerance of the goal's pose: the share
    of poses that are, drawn from the posteriors of the goal's direction and of the target's place, and from the
    preferred range."""
    if belief.goal_log_posterior is None:
        return 0.0
    share = np.exp(belief.goal_log_posterior.astype(np.float64)).ravel()
    elevation, azimuth = viewing_grid()
    cells = rng.choice(len(share), DRAWN, p=share / share.sum())
    rows, columns = np.unravel_index(cells, belief.goal_log_posterior.shape)
    places = rng.multivariate_normal(belief.mean_m, belief.covariance_m2, DRAWN, method="eigh")
    ranges = rng.normal(belief.goal_range_m or preference.range_m, preference.range_std_m, DRAWN)
    towards = np.array([direction(azimuth[c], elevation[r]) for r, c in zip(rows, columns, strict=True)])
    there = [success(belief.world_from_camera, aim(place + r * way, place, preference.pixel, preference.intrinsics_px))
             for place, r, way in zip(places, ranges, towards, strict=True)]
    return belief.presence * float(np.mean(there))


class Listener:
    """Collects what one episode tells. `sizes_m` are the objects' sizes [3]."""

    def __init__(self, sizes_m: dict[str, Any], range_std_m: float, rng: np.random.Generator):
        self.sizes_m, self.range_std_m, self.rng = sizes_m, range_std_m, rng
        self.truths: dict[int, Truth] = {}
        self.percepts: list[Percept] = []
        self.beliefs: list[Belief] = []
        self.goals: dict[str, Percept] = {}

    def hear(self, topic: Topic, _part: str | None, message: Message, _payload: bytes | None) -> None:
        """Takes one message of the run."""
        if isinstance(message, Truth):
            self.truths[message.step] = message
        elif isinstance(message, Belief):
            self.beliefs.append(message)
        elif isinstance(message, Percept) and topic == GOAL_PERCEPT:
            self.goals[message.object] = message
        elif isinstance(message, Percept) and topic == PERCEPT:
            self.percepts.append(message)

    def told(self) -> dict[str, list[Told]]:
        """What was told in the episode, and what was so."""
        preference = infer_preference(self.goals, self.range_std_m)
        shares = {step: self._shares(truth) for step, truth in self.truths.items()}
        percepts = [Told(p.presence, share > 0) for p in self.percepts
                    if (share := shares[p.step].get(p.object, 0.0)) == 0 or share >= IN_VIEW]
        beliefs = [Told(b.presence, b.object in self.truths[b.step].names) for b in self.beliefs]
        within = [Told(within_tolerance(b, preference, self.rng),
                       success(b.world_from_camera, self.truths[b.step].goal_world_from_camera))
                  for b in self.beliefs if b.object == preference.target]
        return {"percept": percepts, "belief": beliefs, "within": within}

    def _shares(self, truth: Truth) -> dict[str, float]:
        """The share of each object on the table that is seen."""
        boxes = Boxes(truth.centers_m, truth.world_from_objects(), np.array([self.sizes_m[n] for n in truth.names]))
        return dict(zip(truth.names, seen_shares(truth.world_from_camera, boxes, NO_BOXES).tolist(), strict=True))


def reliability(told: Sequence[Told]) -> dict[str, Any]:
    """The expected calibration error, and for each bin of probabilities that has any: how many, the mean probability,
    and how often it was so."""
    probability = np.array([each.probability for each in told])
    was = np.array([each.was for each in told])
    number = np.minimum((probability * BINS).astype(int), BINS - 1)
    bins = [{"count": int(chosen.sum()), "told": float(probability[chosen].mean()), "was": float(was[chosen].mean())}
            for n in range(BINS) if (chosen := number == n).any()]
    error = sum(each["count"] * abs(each["told"] - each["was"]) for each in bins) / len(told)
    return {"count": len(told), "expected_calibration_error": error, "bins": bins}


def measure(options: argparse.Namespace, console: Console) -> dict[str, Any]:
    """The results. Raises SaccadeError if weights, meshes or OpenGL are missing."""
    values = {"scene.objects": options.objects, "seed": options.seed, "simulator.until": "declared",
              "simulator.max_steps": options.steps} | dict(SUITES[options.suite].values)
    config = load(None, agent_of(options.agent).preset).with_values(values)
    plan = prepare(options.agent, config, options.out, suite=options.suite, limit=options.limit)
    resolved, pairs = cores(options.agent, plan.config.model_dump_json())
    sizes_m = {name: load_mesh(options.objects, name).size_m for name in resolved.names}
    told: dict[str, list[Told]] = {kind: [] for kind in KINDS}
    for number in track(plan.chosen, "scenes", console=console):
        listener = Listener(sizes_m, resolved.planner.range_std_m, np.random.default_rng([options.seed, number]))
        run_local(pairs, resolved.names, RUN, (number,), listener.hear)
        for kind, each in listener.told().items():
            told[kind] += each
    return {"objects": options.objects, "agent": options.agent, "suite": options.suite, "seed": options.seed,
            "scenes": len(plan.chosen), "commit": commit()} | {kind: reliability(each) for kind, each in told.items()}


def draw(curves: dict[str, dict[str, Any]], out: Path) -> None:
    """Draws the reliability curves of results, by their names; the size of a point tells how many probabilities are in
    its bin."""
    figure = new_figure((12.0, 4.2))
    for axes, (kind, title) in zip(figure.subplots(1, len(KINDS)), KINDS.items(), strict=True):
        axes.plot([0, 1], [0, 1], color="grey", linewidth=0.8)
        for (name, results), colour in zip(curves.items(), COLOURS, strict=False):
            bins, count, error = (results[kind][key] for key in ("bins", "count", "expected_calibration_error"))
            told, was = ([each[key] for each in bins] for key in ("told", "was"))
            axes.plot(told, was, color=colour, label=f"{name}: expected calibration error {error:.3f}")
            axes.scatter(told, was, color=colour, s=[10 + 200 * each["count"] / count for each in bins])
        axes.set(xlabel="probability that was told", title=title, xlim=(-0.03, 1.03), ylim=(-0.03, 1.03))
        axes.legend(fontsize=7, loc="upper left")
    figure.axes[0].set_ylabel("how often it was so")
    save(figure, out)


def _read(path: Path) -> dict[str, Any]:
    """Results from before. Raises SaccadeError if they are none of this benchmark."""
    text = read_text(path, "results", "name another file", MAX_BYTES)
    try:
        results = parse_json(text)
    except ValueError as error:
        raise SaccadeError(f"results {path} are damaged ({error}): name another file") from error
    if not (isinstance(results, dict) and results.keys() >= KINDS.keys()):
        raise SaccadeError(f"results {path} are not of this benchmark: name another file")
    return results


def main() -> None:
    """Measures, writes the results and their picture, and tells them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--objects", default="ycb")
    parser.add_argument("--agent", default="sceneccn")
    upright = [name for name, suite in SUITES.items() if suite.place is None]
    parser.add_argument("--suite", default="paper-like", choices=upright)
    parser.add_argument("--limit", type=int, default=25)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--before", type=Path)
    options, console = parser.parse_args(), Console()
    try:
        curves = {} if options.before is None else {"before": _read(options.before)}
        curves["now"] = results = measure(options, console)
        write_json(options.out, results, "results")
        draw(curves, options.out.with_suffix(".png"))
    except SaccadeError as error:
        parser.exit(2, f"saccade: {error}\n")
    for kind, title in KINDS.items():
        console.print(f"{title}: {results[kind]['count']} probabilities, expected calibration error "
                      f"{results[kind]['expected_calibration_error']:.3f}")


if __name__ == "__main__":
    main()
