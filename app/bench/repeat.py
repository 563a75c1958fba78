"""Runs scenes of a results file again, so that they can be looked at. The same configuration, scenes and seeds give the
same episodes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from saccade.app.bench.bench import MAX_FILE_BYTES, RECORD_KEYS, RUN, SCENES_ENDING, cores, record_of
from saccade.app.bench.suites import suite_file
from saccade.app.look.picture import Story
from saccade.app.run.registry import weight_hashes
from saccade.services.simulator.fields import MAX_ID
from saccade.services.simulator.scenes import Scene, load_scenes
from saccade.services.simulator.suites import SUITES
from saccade.shared.bus.messages import Message
from saccade.shared.bus.topics import Topic
from saccade.shared.config import PACKAGE, Config, validate
from saccade.shared.errors import SaccadeError, is_text, told
from saccade.shared.files import parse_json, read_text
from saccade.shared.loop.local import run_local

TOLD_AT_MOST = 2  # a label names at most so many settings; with more it has the file's name instead
FACTS = ("agent", "objects", "config", "weights", "scenes", "commit", "machine")

Take = Callable[[Topic, str | None, Message], None]


@dataclass(frozen=True)
class Results:
    """A results file of `saccade bench`. Its `label` differs from the labels of the other files of a report."""

    path: Path
    facts: dict[str, Any]
    records: list[dict[str, Any]]
    label: str = ""

    @property
    def agent(self) -> str:
        """The agent's name."""
        return self.facts["agent"]

    @property
    def objects(self) -> str:
        """The object set."""
        return self.facts["objects"]

    @property
    def suite(self) -> str:
        """The name of the scenes: that of the suite if there is one, else that of the file."""
        return self.facts["scenes"].get("suite") or self.facts["scenes"]["file"]


def read_results(path: Path) -> Results:
    """Reads a results file. Raises SaccadeError if it is not one of `saccade bench`, or if it holds no result."""
    text = read_text(path, "results", "give a file that `saccade bench` has written", MAX_FILE_BYTES)
    try:
        tree = parse_json(text)
        records, facts = tree["results"], {key: tree[key] for key in FACTS}
        if not records:
            raise ValueError("no result is in it")
        for record in records:
            _check(record)
    except (ValueError, KeyError, TypeError) as error:
        raise SaccadeError(f"results {path} are not of `saccade bench` ({error}): give a file that it has written"
                           ) from error
    told = told_otherwise(Config().model_dump(mode="json"), facts["config"])
    scenes = facts["scenes"].get("suite") or facts["scenes"]["file"]
    label = ", ".join((facts["agent"], facts["objects"], scenes, *(told if len(told) <= TOLD_AT_MOST else [path.stem])))
    return Results(path, facts, records, label)


def _check(record: dict[str, Any]) -> None:
    """Raises ValueError for a record that lacks something, or whose names cannot be told."""
    if missing := sorted(set(RECORD_KEYS) - record.keys()):
        raise ValueError(f"a result has no {missing[0]}")
    for key in ("scene", "target"):
        if not isinstance(record[key], str) or not is_text(record[key]) or len(record[key]) > MAX_ID:
            raise ValueError(f"the {key} {told(record[key])} of a result is no name")


def told_otherwise(base: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Returns the keys, with their values, in which the configuration `other` differs from `base` for the agent or its
    world. The scenes, the bus and the seed are not compared."""
    mine, theirs = (_flat({key: value for key, value in tree.items() if key not in ("scene", "bus", "seed")})
                    for tree in (base, other))
    return [f"{key}={theirs[key]}" for key in theirs if key in mine and theirs[key] != mine[key]]


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key, value in tree.items():
        result |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return result


@dataclass(frozen=True)
class Again:
    """What is needed to run scenes of a results file again."""

    results: Results
    config: Config
    scenes: tuple[Scene, ...]

    def arguments(self, scene_id: str) -> tuple[str, str, int]:
        """Returns the arguments of `replay` for that scene."""
        number = next(k for k, scene in enumerate(self.scenes) if scene.id == scene_id)
        return self.results.agent, self.config.model_dump_json(), number


def prepare_again(results: Results, folder: Path, weights: Path | None = None) -> Again:
    """Finds the scenes (or draws them into `folder`) and the weights. Raises SaccadeError if they are not the same as
    in the results."""
    config = validate(results.facts["config"], str(results.path))
    folder_of_weights = weights or config.perception.weights
    if folder_of_weights is not None:
        path = folder_of_weights if weights is not None else PACKAGE / folder_of_weights
        config = config.with_values({"perception.weights": str(path.resolve())})
    file = _scenes_file(results, config, folder)
    config = config.with_values({"scene.file": str(file.resolve())})
    if weight_hashes(results.agent, config) != results.facts["weights"]:
        raise SaccadeError(f"{config.weights} does not hold the weights of {results.path}: give them with --weights")
    return Again(results, config, tuple(load_scenes(file, config.scene.names)))


def _scenes_file(results: Results, config: Config, folder: Path) -> Path:
    """Returns the file of the scenes: at its place in the repository, beside the results, or in the present folder. If
    it is nowhere, the suite is drawn again. Raises SaccadeError if no file holds the same scenes."""
    wanted = results.facts["scenes"]

    def candidates() -> Iterator[Path]:
        yield from (PACKAGE / wanted["file"], results.path.with_name(Path(wanted["file"]).name),
                    Path(wanted["file"]))
        if wanted.get("suite") in SUITES:
            yield suite_file(wanted["suite"], config, folder / f"drawn{SCENES_ENDING}")

    for path in candidates():
        if path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == wanted["sha256"]:
            return path
    raise SaccadeError(f"the scenes of {results.path} are not to be found: put {wanted['file']} beside it")


def replay(agent: str, config_text: str, number: int, take: Take | None = None) -> Story:
    """Runs episode `number` within this process. `take` sees its messages. The last view in the story is the one that
    was reached."""
    config, pairs = cores(agent, config_text)
    story = Story(number)

    def hear(topic: Topic, part: str | None, message: Message, _payload: bytes | None) -> None:
        story.take(part, message)
        if take is not None:
            take(topic, part, message)

    run_local(pairs, config.names, RUN, (number,), hear)
    simulator: Any = pairs[0][1]  # no frame is published after the last move
    story.last_rgb, story.last_step = simulator.world.render(simulator.state.camera), simulator.state.step
    story.goal_is_known = story.goal_rgb is not None
    return story


def same_as(story: Story, record: Mapping[str, Any]) -> bool:
    """Whether an episode ended as the record says."""
    ended = story.result
    return ended is not None and all(record[key] == value for key, value in record_of(ended).items())
