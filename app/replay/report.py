"""Prints what replays found: differences, losses, and how far messages moved."""

from __future__ import annotations

import json
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from saccade.app.log.check import abbreviated, missing
from saccade.app.log.cut import require_steps
from saccade.app.replay.comparison import At, Comparison
from saccade.app.replay.displacement import Moved
from saccade.app.replay.replay import Outcome, Replay, prepare, replay_here, replay_on_bus
from saccade.app.run.display import say
from saccade.services.replayer.core import Keys, Pace, steps_between
from saccade.shared.bus.topics import FRAME, TOPICS, Topic
from saccade.shared.config import weights_folder
from saccade.shared.errors import SaccadeError
from saccade.shared.log.folder import LOG_NAME
from saccade.shared.log.reading import RunReader

TOLD = 10  # at most so many differences are printed
PICTURE_NAME, TABLE_NAME = "moved.png", "moved.txt"


def replays_of(logs: Sequence[Path], *, into: str, rate: str, start: str | None, end: str | None,
               episode: int | None, topics: str | None, step: bool, perception: Path | None,
               values: dict[str, Any]) -> list[Replay]:
    """Makes the replays that the command line asks for. Raises SaccadeError if an option makes no sense."""
    names = [name.strip() for name in into.split(",") if name.strip()]
    chosen = None if topics is None else [_topic(name.strip()) for name in topics.split(",")]
    swap = _weights(perception) | values
    replays = []
    for path in logs:
        log = path / LOG_NAME if path.is_dir() else path
        which, first, last = _range(log, episode, start, end)
        replays.append(prepare(log, names, swap, pace=Pace(_rate(rate)), topics=chosen, episode=which, start_step=first,
                               end_step=last, one_by_one=step))
    return replays


def _rate(text: str) -> float | None:
    if text == "max":
        return None
    try:
        rate = float(text)
    except ValueError:
        rate = 0.0
    if not 0.1 <= rate <= 100:
        raise SaccadeError(f"--rate {text}: give a number from 0.1 to 100, or max")
    return rate


def _range(log: Path, episode: int | None, start: str | None, end: str | None) -> tuple[int | None, int, int | None]:
    """Returns (episode, first step, last step). The two ends are steps, or both are seconds from the start of the
    log."""
    ends = [text for text in (start, end) if text is not None]
    try:
        if ends and all(text.endswith("s") for text in ends):
            times_s = [None if text is None else float(text[:-1]) for text in (start, end)]
            return steps_between(log, FRAME, *times_s, episode=episode)
        first, last = int(start or 0), None if end is None else int(end)
    except ValueError as error:
        raise SaccadeError(f"--start and --end: give two steps such as 3, or two times such as 2.5s, not "
                           f"{' and '.join(ends)}") from error
    if ends or episode is not None:
        require_steps(log, episode, first, last)
    return episode, first, last


def _topic(name: str) -> Topic:
    if name not in TOPICS:
        raise SaccadeError(f"--topics {name}: choose from {', '.join(TOPICS)}")
    return TOPICS[name]


def _weights(perception: Path | None) -> dict[str, str]:
    """Returns the keys of the configuration for other perception weights: a folder, or the name of one in weights/."""
    folder = weights_folder(perception)
    if folder is None:
        return {}
    manifest = folder / "manifest.json"
    if not manifest.is_file():
        raise SaccadeError(f"--perception {perception}: {manifest} is not there: give a folder with weights")
    architecture = json.loads(manifest.read_text()).get("architecture", "default")
    return {"perception.weights": str(folder.resolve()), "perception.architecture": architecture}


def replay_all(replays: Sequence[Replay], *, bus: str, out: Path | None, swapped: bool, loops: int,
               console: Console) -> bool:
    """Plays the logs into new folders and prints the results. On the bus they run side by side, each on a bus of its
    own; within this process they run one after the other. Returns whether every replay agrees with its recording.
    Raises SaccadeError if the folder is not new."""
    folder = out or Path("replays") / time.strftime("%Y%m%d-%H%M%S")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SaccadeError(f"{folder} is there already: a replay needs a new folder, name another one")
    return all([_pass(replays, bus, folder / str(i) if loops > 1 else folder, swapped, console)
                for i in range(loops)])


def _pass(replays: Sequence[Replay], bus: str, folder: Path, swapped: bool, console: Console) -> bool:
    folders = [folder if len(replays) == 1 else folder / f"{i}-{r.log.parent.name}" for i, r in enumerate(replays)]

    def one(replay: Replay, place: Path) -> tuple[Outcome, Moved]:
        moved = Moved()
        take = moved.take if swapped else None
        with Keys(enabled=len(replays) == 1) as keys:
            run = replay_on_bus if bus == "zenoh" else replay_here
            return run(replay, place, keys, partial(say, console), take), moved

    if bus == "zenoh" and len(replays) > 1:
        with ThreadPoolExecutor(len(replays)) as pool:
            results = list(pool.map(one, replays, folders))
    else:
        results = [one(replay, place) for replay, place in zip(replays, folders, strict=True)]
    cuts = [_cut(replay.log) for replay in replays]
    for replay, place, (outcome, moved), cut in zip(replays, folders, results, cuts, strict=True):
        tell(replay, outcome, console)
        if swapped:
            _tell_moved(moved, place, console)
        if cut is not None:
            say(console, f"  {cut}; nothing behind it was compared: `saccade log recover` makes a log of what is left")
        say(console, f"the replay's log is in {place}")
    return all(outcome.comparison.equal for outcome, _ in results) and not any(cuts)


def _cut(log: Path) -> str | None:
    """Why a log is not whole. None if it is, as one is that was cut or recovered by Saccade."""
    reader = RunReader(log)
    for _ in reader.entries():
        pass
    return reader.cut


def tell(replay: Replay, outcome: Outcome, console: Console) -> None:
    """Prints the result of one replay in a few lines."""
    comparison, note = outcome.comparison, partial(say, console)
    count = sum(outcome.played.values())
    note(f"{replay.log}: {count} messages played into {', '.join(replay.into)}; {comparison.compared} answers "
         f"compared, {comparison.unequal} differ in a byte, {comparison.beyond} beyond what is tolerated")
    for difference in [d for d in comparison.differences if not d.tolerated][:TOLD]:
        note(f"  {difference}")
    if comparison.beyond > TOLD:
        note(f"  ... {comparison.beyond} messages in all")
    unpaired = _unpaired(replay, comparison)
    only_now = [at for at in comparison.only_replayed if at[0] not in unpaired]
    for what, only in (("only in the recording", comparison.only_recorded), ("only now", only_now)):
        for topic, part, episode, step in only[:TOLD]:
            note(f"  {what}: {topic}{f'/{part}' if part else ''} of step {step} of episode {episode}")
        if len(only) > TOLD:
            note(f"  ... {len(only)} messages are {what}")
    for line in not_compared(comparison.not_compared):
        note(f"  {line}")
    for name in sorted(set(unpaired.values())):
        note(f"  nothing of {name} is in what was played: either the recorded run had no such service, or the log "
             "has lost its messages; what it says now is in the replay's log")
    if not comparison.compared and len(set(unpaired.values())) < len(replay.into):
        remedy = ("give a log that is whole" if comparison.not_compared
                  else "play more of the log, or more of its topics")
        note(f"  nothing could be compared: {remedy}")
    if replay.pace.rate is not None and outcome.late_s > 0.1:
        note(f"  the services were too slow for {replay.pace.rate:g} x: up to {outcome.late_s:.1f} s behind")
    _tell_losses(outcome, console)


def _unpaired(replay: Replay, comparison: Comparison) -> dict[str, str]:
    """By topic, the services that speak now and of which the recording holds nothing."""
    now = {at[0] for at in comparison.only_replayed}
    made = {service.name: {topic.name for topic in service.outputs} for service in replay.services}
    return {topic: name for name, topics in made.items() if topics & now and not topics & comparison.topics
            for topic in topics}


def not_compared(ats: Sequence[At]) -> Iterator[str]:
    """A line for each episode with messages that were not compared, because the log lacks a part of their steps."""
    steps: dict[int, set[int]] = defaultdict(set)
    counts: dict[int, int] = defaultdict(int)
    for _, _, episode, step in ats:
        steps[episode].add(step)
        counts[episode] += 1
    for episode, of_episode in sorted(steps.items()):
        where = f"episode {episode}, step {abbreviated(sorted(of_episode))}"
        yield f"not compared: {counts[episode]} messages of {where}, of which the log has lost a part"


def _tell_losses(outcome: Outcome, console: Console) -> None:
    report = missing(outcome.log)
    if outcome.statuses:
        table = Table("process", "received", "published", "refused", "skipped", "lost on the way")
        for name, status in sorted(outcome.statuses.items()):
            table.add_row(name, *(str(n) for n in (status.received, status.published, status.refused, status.skipped,
                                                   status.gaps)))
        console.print(table)
    lost = report.count
    say(console, f"loss: {lost} of {report.messages} messages of the replay's log"
        + (f"; {report.cut}" if report.cut else ""))


def _tell_moved(moved: Moved, place: Path, console: Console) -> None:
    table = moved.table()
    console.print(table)
    with (place / TABLE_NAME).open("w") as file:
        Console(file=file, width=110).print(table)
    moved.draw(place / PICTURE_NAME)
    say(console, f"how far things moved: {place / TABLE_NAME}, {place / PICTURE_NAME}")
