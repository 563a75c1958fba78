"""Old logs can be read: for each change of the log's format there is one small function, the oldest first.

A function takes the fields of a message as they are in the MessagePack map (arrays are still extension types). It
returns them as the next format has them.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from saccade.shared.bus import messages as m
from saccade.shared.bus.topics import Topic
from saccade.shared.bus.wire import packed_array, scan
from saccade.shared.errors import SaccadeError

Fields = dict[str, Any]
Change = Callable[[Topic, str | None, Fields], Fields]

OLDEST = 1  # the format of logs that do not name one
# Fields that older logs lack, and that services tell now; they become None.
ADDED = {m.Percept: ("mask_bits",), m.Plan: ("best_eyes_m", "best_g"), m.Belief: ("count_probabilities",)}

SINCE = {"events": 7}  # topics that older formats do not have, and the format since which they exist


def count_in_episodes() -> Change:
    """Format 1 to 2: sequence numbers count from 0 in every episode, no longer through the whole run."""
    first: dict[tuple[str, str | None, str, int], int] = {}

    def change(topic: Topic, part: str | None, fields: Fields) -> Fields:
        if not topic.in_step:
            return fields
        start = first.setdefault((topic.name, part, fields["run"], fields["episode"]), fields["seq"])
        return fields | {"seq": fields["seq"] - start}

    return change


def with_masks_and_candidates() -> Change:
    """Format 2 to 3: percepts have a mask of where the object is seen, and plans have their best candidates."""
    def change(topic: Topic, part: str | None, fields: Fields) -> Fields:
        if topic.type not in (m.Percept, m.Plan):
            return fields
        return fields | {"version": 2} | dict.fromkeys(ADDED[topic.type])

    return change


def with_poses() -> Change:
    """Format 3 to 4: percepts may have a pose in place of a latent pose."""
    def change(topic: Topic, part: str | None, fields: Fields) -> Fields:
        return fields | {"version": 3, "camera_from_object": None} if topic.type is m.Percept else fields

    return change


def with_several_rotations() -> Change:
    """Format 4 to 5: percepts may have several rotations."""
    def change(topic: Topic, part: str | None, fields: Fields) -> Fields:
        if topic.type is not m.Percept:
            return fields
        return fields | {"version": 4} | dict.fromkeys(("rotations", "log_probability", "deviation_rad"))

    return change


def with_places_and_instances() -> Change:
    """Format 5 to 6: a goal may tell the workspace, and the truth may hold several of a kind, in any pose."""
    added: dict[type[m.Message], Fields] = {
        m.Goal: dict.fromkeys(("workspace_m", "shell_m", "table_m", "obstacle_centers_m", "obstacle_sizes_m",
                               "obstacle_yaws_rad")),
        m.Truth: dict.fromkeys(("instances", "rotations", "sizes_m", "in_view", "events")) | {"target_instance": 1}}

    def change(topic: Topic, part: str | None, fields: Fields) -> Fields:
        return fields | {"version": 2} | added[topic.type] if topic.type in added else fields

    return change


def with_motion_and_comparisons() -> Change:
    """Format 6 to 7: a belief may tell how the goal's camera was rolled, how an object moves, and, as a percept may,
    how well the present view agrees with the goal image. The topic `events` is new."""
    added: dict[type[m.Message], Fields] = {
        m.Percept: {"version": 5, "goal_agreement": None, "goal_aside_rad": None},
        m.Belief: {"version": 2, "goal_rotations": None, "goal_rotations_log_probability": None, "velocity_m": None,
                   "since_step": 0, "goal_agreement": None}}

    def change(topic: Topic, part: str | None, fields: Fields) -> Fields:
        return fields | added.get(topic.type, {})

    return change


def with_beliefs_of_instances() -> Change:
    """Format 7 to 8: percepts and beliefs may be of several of a kind, and have numbers."""
    added: dict[type[m.Message], Fields] = {
        m.Percept: {"version": 6, "further": []},
        m.Belief: {"version": 3, "instance": 1, "further": [], "count_probabilities": None},
        m.Plan: {"version": 3, "target_instance": 1}}

    def change(topic: Topic, part: str | None, fields: Fields) -> Fields:
        if topic.type is m.Events:
            numbers = np.ones(len(fields["objects"]), np.uint8)
            return fields | {"version": 2, "instances": packed_array(numbers)}
        return fields | added.get(topic.type, {})

    return change


def with_the_way_to_the_goal() -> Change:
    """Format 8 to 9: comparisons with the goal image tell the way up and the size, too."""
    def change(topic: Topic, part: str | None, fields: Fields) -> Fields:
        if topic.type is not m.Percept:
            return fields
        added = {"version": 7, "goal_above_rad": None, "goal_log_larger": None}
        return fields | added | {"further": [each | added for each in fields["further"]]}

    return change


CHANGES: tuple[Callable[[], Change], ...] = (count_in_episodes, with_masks_and_candidates, with_poses,
                                             with_several_rotations, with_places_and_instances,
                                             with_motion_and_comparisons, with_beliefs_of_instances,
                                             with_the_way_to_the_goal)
FORMAT = OLDEST + len(CHANGES)


class Migration:
    """Brings the messages of a log to the present format. Raises SaccadeError if the format of the log is not known."""

    def __init__(self, version: int, path: Path) -> None:
        if not OLDEST <= version <= FORMAT:
            raise SaccadeError(f"log {path} has format {version}, this Saccade reads {OLDEST} to {FORMAT}: update it")
        self._changes = [make() for make in CHANGES[version - OLDEST:]]

    def __call__(self, topic: Topic, part: str | None, payload: bytes) -> bytes:
        """Returns the encoded message in the present format. A payload that is not a message stays as it is."""
        if not self._changes:
            return payload
        try:
            scan(payload)
            fields = msgpack.unpackb(payload)
            for change in self._changes:
                fields = change(topic, part, fields)
            return msgpack.packb(fields)
        except Exception:  # msgpack raises many kinds of errors for other bytes; decoding reports them
            return payload
