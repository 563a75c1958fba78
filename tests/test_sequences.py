"""What sequence numbers tell: what was lost, what came late, what was said twice."""

from __future__ import annotations

from saccade.shared.bus.sequences import Sequences
from saccade.shared.bus.topics import PERCEPT, STATUS
from saccade.tests.samples import sample


def take(sequences: Sequences, *numbers: tuple[int, int], part: str = "mug") -> list:
    """What is said of percepts of (episode, seq)."""
    return [sequences.take(PERCEPT, part, sample(PERCEPT.type, run="r", episode=e, seq=s)) for e, s in numbers]


def test_gaps_are_counted_per_key_and_closed_by_what_comes_late():
    sequences = Sequences()
    assert take(sequences, (0, 4), (0, 5), (0, 9)) == [0, 0, 3]
    assert take(sequences, (0, 0), (0, 3), part="can") == [0, 2]
    assert sequences.missing == {("percept", "mug"): 3, ("percept", "can"): 2}
    assert take(sequences, (0, 7), (0, 7), (0, 9), (0, 6), (0, 8)) == [0, None, None, 0, 0]
    assert sequences.missing == {("percept", "can"): 2}


def test_an_episode_begins_with_0_unless_nothing_was_heard_before_it():
    assert take(Sequences(), (3, 4)) == [0]
    assert take(Sequences(from_start=True), (3, 4)) == [4]
    sequences = Sequences()
    assert take(sequences, (0, 7), (1, 2), (0, 7), (1, 3)) == [0, 2, None, 0]
    assert sequences.first_missing == 1


def test_the_first_message_of_a_later_episode_is_known():
    sequences = Sequences()
    messages = [sample(PERCEPT.type, run="r", episode=e, seq=s) for e, s in ((0, 0), (0, 1), (1, 0), (1, 1))]
    begins = []
    for message in messages:
        begins.append(sequences.begins(PERCEPT, "mug", message))
        sequences.take(PERCEPT, "mug", message)
    assert begins == [False, False, True, False]


def test_a_status_counts_anew_in_a_process_that_was_started_again():
    sequences = Sequences()
    lost = [sequences.take(STATUS, "belief", sample(STATUS.type, seq=seq)) for seq in (7, 8, 0, 1, 3)]
    assert lost == [0, 0, 0, 0, 1]
    assert sequences.missing == {}


def test_a_number_far_ahead_takes_no_memory_and_what_is_before_it_may_still_come():
    sequences = Sequences(from_start=True)
    assert take(sequences, (0, 0), (0, 2 ** 62)) == [0, 2 ** 62 - 1]
    assert sequences.missing == {("percept", "mug"): 2 ** 62 - 1}
    assert take(sequences, (0, 1), (0, 1), (0, 2 ** 61), (0, 2)) == [0, None, 0, 0]
    assert sequences.missing == {("percept", "mug"): 2 ** 62 - 4}
    assert take(sequences, (0, 2 ** 62 + 5)) == [4]


def test_what_was_missing_before_a_publisher_counts_anew_stays_missing():
    sequences = Sequences()

    def at(seq, step):
        return sequences.take(PERCEPT, "mug", sample(PERCEPT.type, run="r", episode=0, seq=seq, step=step))

    assert [at(0, 0), at(3, 3), at(0, 9), at(2, 11)] == [0, 2, 0, 1]
    assert sequences.missing == {("percept", "mug"): 3}
    assert [at(1, 10), at(1, 10)] == [0, None]
    assert sequences.missing == {("percept", "mug"): 2}
