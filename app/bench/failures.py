"""Explains why scenes failed. Each of them is run again, compared with the truth, and sorted by the first thing that
went wrong."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rich.console import Console

from saccade.app.bench.repeat import Again, replay
from saccade.app.bench.workers import in_processes
from saccade.app.look.picture import Story, draw_story
from saccade.app.run.display import say
from saccade.shared.bus.messages import Message, Truth
from saccade.shared.bus.topics import Topic
from saccade.shared.files import writing
from saccade.shared.world.geometry import direction, rotation_angle, unit, viewing_grid
from saccade.shared.world.task import SUCCESS_ROTATION_RAD, SUCCESS_TRANSLATION_M

FOUND_M = 0.08  # if the error of the target's position is larger, the target was not found
DIRECTION_RAD = 0.5  # if the error of the goal's direction is larger, the direction is wrong
SMALL_DPI, COLOURS = 60, 255  # there may be many pictures; one takes about 20 kB

CLASSES = {
    "target": ("Wrong target", "The goal image was taken for another object, or for none."),
    "lost": ("Target not found", f"At the end the target was believed more than {100 * FOUND_M:.0f} cm from where it "
                                 "was."),
    "direction": ("Wrong direction of the goal", "At the end the likeliest direction of the goal's view was more than "
                                                 f"{DIRECTION_RAD} rad from the true one, seen from the target."),
    "miss": ("Near miss", "Target and direction were right at the end, and the camera had been within "
                          f"{DIRECTION_RAD} rad of the goal's direction, seen from the target, but never within "
                          f"{100 * SUCCESS_TRANSLATION_M:.1f} cm and {SUCCESS_ROTATION_RAD} rad of its view: a wrong "
                          "range, or the attitude."),
    "travel": ("Out of steps on the way", "Target and direction were right at the end, but the camera had never been "
                                          f"within {DIRECTION_RAD} rad of the goal's direction: it was still on its "
                                          "way, or could not get there."),
    "other": ("Not failed when run again", "The episode did not end as in the results: other code or another machine."),
}


@dataclass(frozen=True)
class Distance:
    """The distance from a camera to the goal's view: between the positions (metres), between the attitudes (radians),
    and between the directions as seen from the target (radians)."""

    position_m: float
    attitude_rad: float
    direction_rad: float

    @property
    def tolerances(self) -> float:
        """The larger of the errors of position and attitude, in units of the success tolerance. A view below 1 is a
        success."""
        return max(self.position_m / SUCCESS_TRANSLATION_M, self.attitude_rad / SUCCESS_ROTATION_RAD)


@dataclass(frozen=True)
class Diagnosis:
    """What a failed episode shows when it is compared with the truth. A value is None if the agent has no such
    belief."""

    scene: str
    target: str
    success: bool
    declared: bool
    steps: int
    inferred: str | None  # the object that the agent took as the goal image's; empty for none
    position_error_m: float | None
    direction_error_rad: float | None
    nearest: Distance  # the step that was nearest to the goal's view
    least_direction_rad: float  # the smallest of all steps


    @property
    def cause(self) -> str:
        """The key in CLASSES of the first thing that went wrong."""
        if self.success:
            return "other"
        if self.inferred is not None and self.inferred != self.target:
            return "target"
        if self.position_error_m is not None and self.position_error_m > FOUND_M:
            return "lost"
        if self.direction_error_rad is not None and self.direction_error_rad > DIRECTION_RAD:
            return "direction"
        return "miss" if self.least_direction_rad <= DIRECTION_RAD else "travel"


def diagnose(story: Story, ways: Sequence[Distance]) -> Diagnosis:
    """Compares what was believed at the end of an episode with the truth. `ways` holds the distance to the goal's view
    at each step."""
    truth, result = story.truth, story.result
    assert truth is not None  # every episode that ran to its end has one
    assert result is not None
    belief = story.beliefs.get(truth.target)
    position_error = direction_error = None
    if belief is not None:
        position_error = float(np.linalg.norm(belief.mean_m - truth.target_center_m))
        direction_error = np.pi  # the agent knows nothing about the direction
        if belief.goal_log_posterior is not None:
            elevation, azimuth = viewing_grid()
            row, column = np.unravel_index(np.argmax(belief.goal_log_posterior), belief.goal_log_posterior.shape)
            goal = truth.goal_world_from_camera[:3, 3] - truth.target_center_m
            direction_error = _angle(direction(azimuth[column], elevation[row]), goal)
    return Diagnosis(result.scene, result.target, result.success, result.declared, result.steps,
                     None if story.plan is None else story.plan.target, position_error, direction_error,
                     min(ways, key=lambda way: way.tolerances), min(way.direction_rad for way in ways))


def investigate(agent: str, config_text: str, number: int, picture: str) -> Diagnosis:
    """Runs a scene again, writes its picture, and returns what it shows."""
    ways: list[Distance] = []

    def measure(_topic: Topic, _part: str | None, message: Message) -> None:
        if isinstance(message, Truth):
            ways.append(distance(message))

    story = replay(agent, config_text, number, measure)
    draw_story(story, Path(picture), dpi=SMALL_DPI)
    with Image.open(picture) as drawn:
        small = drawn.convert("RGB").quantize(COLOURS, method=Image.Quantize.MAXCOVERAGE)
    with writing(Path(picture), "picture"):
        small.save(picture, optimize=True)
    return diagnose(story, ways)


def distance(truth: Truth) -> Distance:
    """Returns how far the camera is from the goal's view."""
    camera, goal, center = truth.world_from_camera, truth.goal_world_from_camera, truth.target_center_m
    return Distance(float(np.linalg.norm(camera[:3, 3] - goal[:3, 3])),
                    float(rotation_angle(camera[:3, :3], goal[:3, :3])),
                    _angle(camera[:3, 3] - center, goal[:3, 3] - center))


def _angle(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.arccos(np.clip(unit(a) @ unit(b), -1.0, 1.0)))


def failed_scenes(again: Again, out: Path, *, jobs: int, console: Console) -> list[tuple[Diagnosis, Path]]:
    """Returns a diagnosis and a picture for every failed scene of a results file, in the file's order. The pictures are
    written below `out`."""
    failed = [record["scene"] for record in again.results.records if not record["success"]]
    folder = out / "failures" / again.results.path.stem
    if failed:
        with writing(folder, "report"):
            folder.mkdir(parents=True, exist_ok=True)
    pictures = {scene: folder / f"{_file_name(scene, number)}.png" for number, scene in enumerate(failed)}
    work = {scene: (*again.arguments(scene), str(pictures[scene])) for scene in failed}
    found = {}
    for scene, diagnosis in in_processes(investigate, work, jobs):
        found[scene] = diagnosis
        say(console, f"{len(found)} of {len(failed)}: {scene}: {CLASSES[diagnosis.cause][0].lower()}")
    return [(found[scene], pictures[scene]) for scene in failed]


def _file_name(scene: str, number: int) -> str:
    """The scene's id where it can be the name of a file, else its number among those that failed."""
    return scene if re.fullmatch(r"[\w+-][\w.+-]{0,99}", scene) else f"failed-{number}"


def section(title: str, scenes: int, cases: Sequence[tuple[Diagnosis, str]]) -> list[str]:
    """Returns the Markdown for one results file of `scenes` scenes. A case is a diagnosis and the address of its
    picture."""
    lines = [f"## {title}", "", f"{len(cases)} of {scenes} scenes failed."]
    if not cases:
        return [*lines, ""]
    lines += ["", "| what went wrong first | scenes | of the failed | of all |", "| --- | ---: | ---: | ---: |"]
    groups = {key: [case for case in cases if case[0].cause == key] for key in CLASSES}
    for key, group in groups.items():
        if group or key != "other":
            lines.append(f"| {CLASSES[key][0]} | {len(group)} | {100 * len(group) / len(cases):.1f} % | "
                         f"{100 * len(group) / scenes:.1f} % |")
    for key, group in groups.items():
        if group:
            lines += ["", f"### {CLASSES[key][0]}", "", CLASSES[key][1]]
            for diagnosis, picture in group:
                lines += ["", f"**{diagnosis.scene}**: {describe(diagnosis)}", "", f"![{diagnosis.scene}]({picture})"]
    return [*lines, ""]


def describe(d: Diagnosis) -> str:
    """Returns the figures of a diagnosis as one line."""
    parts = [] if d.inferred is None else [f"target inferred: {d.inferred or 'none'}"]
    if d.position_error_m is not None:
        parts.append(f"believed {100 * d.position_error_m:.1f} cm off")
    if d.direction_error_rad is not None:
        parts.append(f"goal's direction {d.direction_error_rad:.2f} rad off")
    near = d.nearest
    parts.append(f"nearest {100 * near.position_m:.1f} cm and {near.attitude_rad:.2f} rad from the goal's view")
    said = "said that it was there" if d.declared else "did not say that it was there"
    return "; ".join([*parts, f"{d.steps} steps, {said}"]) + "."
