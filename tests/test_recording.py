"""A log gives back what was written, also when the recorder was killed, the file cut or the disk full."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader

from saccade.app.log.check import missing
from saccade.shared.bus.messages import field_types
from saccade.shared.bus.topics import ACTION, BELIEF, FRAME, GOAL, PERCEPT, RESULT, STATUS, TOPICS, TRUTH
from saccade.shared.bus.wire import encode
from saccade.shared.errors import SaccadeError
from saccade.shared.log.migrations import FORMAT
from saccade.shared.log.reading import RunReader
from saccade.shared.log.recording import RecordingStopped, RunLog, json_schema
from saccade.tests.samples import sample


def write(path: Path, messages, **options) -> RunLog:
    log = RunLog(path, world="test", **options)
    for topic, part, message in messages:
        log.write(topic, part, encode(message), sequence=message.seq)
    return log


def steps(count: int, *topics, first: int = 0) -> list:
    return [(t, "mug" if t.parts else None, sample(t.type, run="r", episode=0, step=i, seq=i, **options(t)))
            for i in range(first, first + count) for t in topics]


def options(topic) -> dict:
    return {"object": "mug"} if topic.parts and topic != STATUS else {"done": False} if topic == TRUTH else {}


def test_every_topic_comes_back_as_it_was(tmp_path):
    messages = steps(3, *TOPICS.values())
    write(tmp_path / "run.mcap", messages, configuration='{"seed": 1}', metadata={"versions": {"x": "1"}}).close()
    reader = RunReader(tmp_path / "run.mcap")
    assert [(e.topic, e.part, e.payload) for e in reader.entries()] == [(t, p, encode(m)) for t, p, m in messages]
    assert [(t, p, encode(m)) for t, p, m in reader] == [(t, p, encode(m)) for t, p, m in messages]
    assert (reader.cut, reader.refused, reader.world) == (None, 0, "test")
    assert reader.metadata == {"log": {"format": str(FORMAT)}, "versions": {"x": "1"}}
    assert json.loads(reader.configuration) == {"seed": 1}


def test_any_mcap_tool_can_read_it(tmp_path):
    write(tmp_path / "run.mcap", steps(5, FRAME, PERCEPT)).close()
    with (tmp_path / "run.mcap").open("rb") as stream:
        summary = make_reader(stream, validate_crcs=True).get_summary()
    assert {c.topic: c.message_encoding for c in summary.channels.values()} == {
        "saccade/test/frame": "msgpack", "saccade/test/percept/mug": "msgpack"}
    assert {s.name: s.encoding for s in summary.schemas.values()} == {"Frame": "jsonschema", "Percept": "jsonschema"}
    assert summary.statistics.message_count == 10
    assert {c.compression for c in summary.chunk_indexes} == {"zstd"}


@pytest.mark.parametrize("topic", TOPICS.values(), ids=lambda t: t.name)
def test_schemas_name_every_field_with_dtype_and_shape(topic):
    schema = json_schema(topic.type)
    assert set(schema["required"]) == {"type", "version", *field_types(topic.type)}
    assert schema["properties"]["step"] == {"type": "integer"}
    text = json.dumps(schema)
    assert text.count('"x-dtype"') == text.count('"x-shape"') == sum("ArraySpec" in str(h) for h in
                                                                    field_types(topic.type).values())


def test_entries_that_are_no_messages_are_kept_and_counted(tmp_path):
    log = write(tmp_path / "run.mcap", steps(2, ACTION))
    log.write(ACTION, None, b"nonsense")
    log.close()
    reader = RunReader(tmp_path / "run.mcap")
    assert len(list(reader)) == 2
    assert reader.refused == 1
    assert [e.payload for e in reader.entries()][-1] == b"nonsense"


def test_a_cut_file_is_read_up_to_the_cut(tmp_path):
    messages = steps(400, FRAME)
    log = RunLog(tmp_path / "run.mcap", world="test")
    for i, (topic, part, message) in enumerate(messages):
        log.write(topic, part, encode(message))
        if i % 50 == 49:
            log._flushed_s = -1e9  # as if FLUSH_S had passed
            log.flush_if_due()
    log.close()
    whole = (tmp_path / "run.mcap").read_bytes()
    counts = []
    for length in range(len(whole) - 1, 9, -max(1, len(whole) // 97)):
        (tmp_path / "cut.mcap").write_bytes(whole[:length])
        reader = RunReader(tmp_path / "cut.mcap")
        read = [encode(m) for _, _, m in reader]
        assert "cut or damaged" in reader.cut
        assert read == [encode(m) for _, _, m in messages[:len(read)]]
        assert len(read) % 50 == 0
        counts.append(len(read))
    assert counts == sorted(counts, reverse=True)
    assert counts[0] == 400
    assert len(set(counts)) > 4


def test_a_damaged_file_is_read_up_to_the_damage(tmp_path):
    log = write(tmp_path / "run.mcap", steps(200, ACTION))
    log._flushed_s = -1e9
    log.flush_if_due()
    size = log.path.stat().st_size
    for topic, part, message in steps(200, BELIEF):
        log.write(topic, part, encode(message))
    log.close()
    data = bytearray(log.path.read_bytes())
    data[size + 200] ^= 0xFF
    log.path.write_bytes(data)
    reader = RunReader(log.path)
    assert sum(t == ACTION for t, _, _ in reader) == 200
    assert "cut or damaged" in reader.cut


@pytest.mark.parametrize(("content", "message"), [(b"", "empty"), (b"hello, text", "not an MCAP"), (None, "cannot")])
def test_what_is_no_log_is_one_clear_error(tmp_path, content, message):
    if content is not None:
        (tmp_path / "run.mcap").write_bytes(content)
    with pytest.raises(SaccadeError, match=message):
        RunReader(tmp_path / "run.mcap")


def test_a_folder_that_cannot_be_written_is_one_clear_error(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "run.mcap", tmp_path / "file"):
        with pytest.raises(SaccadeError, match="cannot be written"):
            RunLog(path, world="test")


def test_a_full_disk_stops_the_recording_once_and_keeps_what_there_is(tmp_path):
    child = subprocess.run([sys.executable, "-c", FILL, str(tmp_path / "run.mcap")], capture_output=True, text=True)
    assert child.returncode == 0, child.stderr
    written = int(child.stdout)
    reader = RunReader(tmp_path / "run.mcap")
    read = [m.step for _, _, m in reader]
    assert read == list(range(len(read)))
    assert 0 < len(read) <= written
    assert reader.cut
    assert (tmp_path / "run.mcap").stat().st_size <= 300_000


FILL = """
import resource, sys, pathlib
import numpy as np
from saccade.shared.bus.wire import encode
from saccade.shared.log.recording import RecordingStopped, RunLog
from saccade.shared.bus.topics import FRAME
from saccade.tests.samples import sample
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))
log, noise = RunLog(pathlib.Path(sys.argv[1]), world="test"), np.random.default_rng(0)
written = stopped = 0
for step in range(200):
    rgb = noise.integers(0, 256, (60, 60, 3), dtype=np.uint8)
    message = sample(FRAME.type, step=step, seq=step, rgb=rgb, depth_m=np.zeros((60, 60), np.float32))
    try:
        log.write(FRAME, None, encode(message))
        log._flushed_s = -1e9
        log.flush_if_due()
        written += not stopped
    except RecordingStopped as error:
        assert "keeps what was recorded" in str(error)
        stopped += 1
log.close()
assert stopped == 1
print(written + 1)
"""


@pytest.fixture
def tiny_disk(tmp_path):
    """A file system of one megabyte; needs root."""
    folder = tmp_path / "disk"
    folder.mkdir()
    try:
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no right to mount a small file system; the file size limit is tested instead")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_disk_that_is_really_full(tiny_disk):
    (tiny_disk / "ballast").write_bytes(bytes(600_000))
    log = RunLog(tiny_disk / "run.mcap", world="test")

    def fill() -> None:
        for topic, part, message in steps(2000, FRAME):
            log.write(topic, part, encode(message) + os.urandom(2000))
            log._flushed_s = -1e9
            log.flush_if_due()

    with pytest.raises(RecordingStopped, match="No space left"):
        fill()
    log.close()
    reader = RunReader(tiny_disk / "run.mcap")
    assert len(list(reader.entries())) > 50
    assert "No space left" in reader.cut


def test_missing_steps_and_topics_are_reported(tmp_path):
    messages = [entry for entry in steps(4, FRAME, PERCEPT, ACTION, TRUTH)
                if (entry[0], entry[2].step) not in ((ACTION, 1), (PERCEPT, 2))]
    messages.append((TRUTH, None, sample(TRUTH.type, run="r", episode=0, step=4, seq=4, done=True)))
    write(tmp_path / "run.mcap", messages).close()
    report = missing(tmp_path / "run.mcap")
    assert report.absent == [("r", 0, "saccade/test/action", 1, 1), ("r", 0, "saccade/test/percept/mug", 2, 2)]
    assert report.lost == {"saccade/test/action": 1, "saccade/test/percept/mug": 1}
    assert not report.complete
    write(tmp_path / "late.mcap", steps(3, FRAME, first=2)).close()
    assert missing(tmp_path / "late.mcap").lost == {"saccade/test/frame": 2}
    assert [at[3:] for at in missing(tmp_path / "late.mcap").absent] == [(0, 1)]
    write(tmp_path / "good.mcap", steps(4, FRAME, PERCEPT, ACTION, TRUTH)).close()
    assert missing(tmp_path / "good.mcap").complete


def test_what_holds_for_an_episode_is_missed_where_another_has_it(tmp_path):
    """Only an episode that is over owes a result."""
    def episode(number, *latched, done=True):
        truth = sample(TRUTH.type, run="r", episode=number, step=0, seq=0, done=done)
        return [(TRUTH, None, truth)] + [(topic, None, sample(topic.type, run="r", episode=number, step=0, seq=0))
                                         for topic in latched]

    messages = episode(0, GOAL, RESULT) + episode(1, RESULT) + episode(2, GOAL) + episode(3, GOAL, done=False)
    write(tmp_path / "run.mcap", messages).close()
    absent = missing(tmp_path / "run.mcap").absent
    assert absent == [("r", 1, "saccade/test/goal", 0, 0), ("r", 2, "saccade/test/result", 0, 0)]
