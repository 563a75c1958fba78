"""Whether a log is complete: gaps in the sequence numbers, steps without one of their topics, damage."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from shared.reading import RunReader
from shared.sequences import Sequences
from shared.topics import TOPICS, TRUTH


@dataclass
class Missing:
    """What a log lacks. `lost`: messages per key, by sequence number; `heartbeats`, of which nobody keeps a copy, apart
    from them and no reason to call a log incomplete. `absent`: (run, episode, step, key) of topics
    that every step should have. `repeated`: messages that are there twice. `cut`: why the file is not whole."""

    messages: int = 0
    repeated: int = 0
    heartbeats: int = 0
    lost: dict[str, int] = field(default_factory=dict)
    absent: list[tuple[str, int, int, str]] = field(default_factory=list)
    refused: int = 0
    cut: str | None = None

    @property
    def complete(self) -> bool:
        """Nothing is missing."""
        return not (self.lost or self.absent or self.repeated or self.refused or self.cut)


def missing(path: Path) -> Missing:
    """Reads a log and reports gaps. The last step of an episode that is done needs no answer to its frame."""
    report, reader, sequences = Missing(), RunReader(path), Sequences(from_start=True)
    steps: dict[tuple[str, int, int], set[str]] = {}
    done: set[tuple[str, int, int]] = set()
    keys: set[str] = set()
    for topic, part, message in reader:
        report.messages += 1
        key = topic.key(reader.world, part)
        lost = sequences.take(topic, part, message)
        report.repeated += lost is None
        report.heartbeats += 0 if topic.in_step else lost
        if topic.in_step and not topic.latched:
            at = (message.run, message.episode, message.step)
            keys.add(key)
            steps.setdefault(at, set()).add(key)
            if topic == TRUTH and message.done:
                done.add(at)
    for run, episode in {at[:2] for at in steps}:
        for step in range(max(at[2] for at in steps if at[:2] == (run, episode)) + 1):
            at = (run, episode, step)
            if at not in done:
                report.absent += [(*at, key) for key in sorted(keys - steps.get(at, set()))]
    report.absent.sort()
    report.lost = {TOPICS[name].key(reader.world, part): lost for (name, part), lost in sequences.missing.items()}
    report.refused, report.cut = reader.refused, reader.cut
    return report
