"""A cut or damaged log gives back every whole record, and a log that was removed is noticed."""

from __future__ import annotations

import random
import shutil
import zlib
from pathlib import Path

import numpy as np
import pytest
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Header, Message
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from saccade.app.log.check import missing
from saccade.app.log.recover import recover
from saccade.app.log.salvage import Salvage
from saccade.shared.bus.topics import ACTION, PERCEPT
from saccade.shared.bus.wire import encode
from saccade.shared.errors import SaccadeError
from saccade.shared.log.reading import RunReader
from saccade.shared.log.recording import RECOVERED, RecordingStopped, RunLog
from saccade.tests.samples import sample

CHUNKS, EACH = 5, 3


def chunked(path: Path) -> tuple[list[int], list]:
    """A log of a few chunks, where each ends, and its entries."""
    log = RunLog(path, world="test", configuration='{"seed": 1}', metadata={"versions": {"x": "1"}})
    ends, entries = [], []
    for chunk in range(CHUNKS):
        for i in range(EACH):
            step = chunk * EACH + i
            topic, part = (ACTION, None) if i else (PERCEPT, "mug")
            payload = encode(sample(topic.type, run="r", episode=0, step=step, seq=step))
            log._flushed_s = np.inf  # chunks close here only
            log.write(topic, part, payload, sequence=step, log_time_ns=1000 + step)
            entries.append((topic, part, payload, 1000 + step))
        log.flush()
        ends.append(path.stat().st_size)
    log.close()
    return ends, entries


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    return path, *chunked(path)


def read(path: Path) -> list:
    """The entries of a log, which must be whole: to its own reader, and to mcap's, which needs an index."""
    reader = RunReader(path)
    entries = [tuple(entry) for entry in reader.entries()]
    assert reader.cut is None
    with path.open("rb") as stream:
        assert make_reader(stream, validate_crcs=True).get_summary().statistics.message_count == len(entries)
    return entries


def salvaged(path: Path) -> list[tuple[str, int, bytes]]:
    channels, found = {}, []
    for record in Salvage(path).records():
        if isinstance(record, Channel):
            channels[record.id] = record.topic
        elif isinstance(record, Message):
            found.append((channels[record.channel_id], record.log_time, record.data))
    return found


def test_cut_anywhere_it_keeps_exactly_the_whole_chunks(log, tmp_path):
    """At every byte; the new log is written where the number of messages changes and at some others."""
    path, ends, entries = log
    whole = path.read_bytes()
    expected = [(t.key("test", p), time, payload) for t, p, payload, time in entries]
    cut, before = tmp_path / "cut.mcap", None
    assert len(whole) < 20_000
    for length in range(len(whole) + 1):
        cut.write_bytes(whole[:length])
        found = salvaged(cut)
        assert found == expected[:len(found)]
        assert len(found) >= EACH * sum(end <= length for end in ends)
        if len(found) != before or length % 250 == 0:
            before, out = len(found), tmp_path / f"{length}.mcap"
            if not found:
                with pytest.raises(SaccadeError, match=r"nothing to recover|nothing was recorded"):
                    recover(cut, out)
                assert not out.exists()
                continue
            recover(cut, out)
            assert read(out) == entries[:len(found)]
            assert cut.read_bytes() == whole[:length]


def test_what_was_cut_off_is_told_and_the_rest_kept(log, tmp_path):
    path, ends, entries = log
    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[:ends[2] - 200])
    report = recover(tmp_path / "cut.mcap", tmp_path / "out.mcap")
    assert report.messages == 2 * EACH
    assert not report.ended
    assert [line for line in report.lines() if line.startswith("lost behind the cut: ")]
    reader = RunReader(tmp_path / "out.mcap")
    assert [tuple(e) for e in reader.entries()] == entries[:2 * EACH]
    assert reader.configuration == '{"seed": 1}'
    assert reader.metadata["versions"] == {"x": "1"}
    assert reader.metadata[RECOVERED]["log"] == "cut.mcap"
    recover(path, tmp_path / "same.mcap")
    assert read(tmp_path / "same.mcap") == entries
    assert RunReader(tmp_path / "same.mcap").metadata.get(RECOVERED, {}).get("lost", "") == ""


@pytest.mark.parametrize("chunk", [0, 2])
def test_behind_a_damaged_chunk_it_goes_on(log, tmp_path, chunk):
    """Also where keys stand in the damaged one alone: the index at the end repeats them."""
    path, ends, entries = log
    data = bytearray(path.read_bytes())
    start = ends[chunk - 1] if chunk else data.index(b"zstd")
    data[start + 120] ^= 0xFF
    (tmp_path / "bad.mcap").write_bytes(data)
    report = recover(tmp_path / "bad.mcap", tmp_path / "out.mcap")
    kept = entries[:chunk * EACH] + entries[(chunk + 1) * EACH:]
    assert read(tmp_path / "out.mcap") == kept
    assert [(s.reason.split(" (")[0], s.messages) for s in report.skipped] == [("damaged chunk", EACH)]
    assert report.ended
    assert not report.after_cut
    assert missing(tmp_path / "out.mcap").lost
    assert "bytes, 3 messages" in "".join(report.lines())


def test_where_a_length_is_damaged_it_finds_the_next_chunk(log, tmp_path):
    path, ends, entries = log
    data = bytearray(path.read_bytes())
    data[ends[1] + 3] ^= 0x55  # in the third chunk's length
    (tmp_path / "bad.mcap").write_bytes(data)
    report = recover(tmp_path / "bad.mcap", tmp_path / "out.mcap")
    assert read(tmp_path / "out.mcap") == entries[:2 * EACH] + entries[3 * EACH:]
    assert len(report.skipped) == 1


def test_bytes_flipped_anywhere_never_give_a_message_that_was_not_there(log, tmp_path):
    path, _, entries = log
    expected = [(t.key("test", p), time, payload) for t, p, payload, time in entries]
    data, dice = path.read_bytes(), random.Random(0)
    for trial in range(400):
        bad = bytearray(data)
        for _ in range(dice.choice((1, 1, 2, 8))):
            bad[dice.randrange(len(bad))] ^= dice.randrange(1, 256)
        (tmp_path / "bad.mcap").write_bytes(bad)
        try:
            recover(tmp_path / "bad.mcap", out := tmp_path / f"{trial}.mcap")
        except SaccadeError:
            continue
        rest, found = iter(expected), salvaged(out)
        assert all(entry in rest for entry in found), trial  # the same, in the same order
        with out.open("rb") as stream:
            assert make_reader(stream, validate_crcs=True).get_summary().statistics.message_count == len(found)


@pytest.mark.parametrize("content", [b"", b"hello, text", bytes(5000), bytes(range(256)) * 40, b"\x06" * 3000])
def test_what_holds_no_message_is_one_clear_error(tmp_path, content):
    (tmp_path / "run.mcap").write_bytes(content)
    with pytest.raises(SaccadeError, match=r"nothing to recover|nothing was recorded"):
        recover(tmp_path / "run.mcap", tmp_path / "out.mcap")
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]


@pytest.mark.parametrize("compression", CompressionType)
def test_logs_of_other_writers_too(tmp_path, compression):
    """The damage here is inside the second chunk's data, whatever it is compressed with."""
    path = tmp_path / "run.mcap"
    ends = []
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression, chunk_size=1)
        writer.start()
        channel = writer.register_channel("saccade/table/action", "msgpack", 0)
        for i in range(6):
            ends.append(stream.tell())
            writer.add_message(channel, i, bytes([i]) * 3000, i, i)
        writer.finish()
    data = bytearray(path.read_bytes())
    data[ends[2] + 60] ^= 0xFF
    path.write_bytes(data)
    assert recover(path, tmp_path / "out.mcap").messages == 5
    with (tmp_path / "out.mcap").open("rb") as stream:
        found = [(c.topic, m.log_time, m.data) for _, c, m in make_reader(stream).iter_messages()]
    assert len(found) == 5
    assert all(data == bytes([time]) * 3000 for _, time, data in found)


def test_a_recording_that_ended_early_is_recovered_as_whole(tmp_path):
    log = RunLog(tmp_path / "run.mcap", world="test")
    log.write(ACTION, None, encode(sample(ACTION.type, seq=0)))
    log.flush()
    log._file.end_early("No space left on device")
    log._file.close()
    assert "No space" in missing(tmp_path / "run.mcap").cut
    report = recover(tmp_path / "run.mcap", tmp_path / "out.mcap")
    assert list(report.lines()) == ["the recording had ended early: No space left on device"]
    assert len(read(tmp_path / "out.mcap")) == 1


def test_the_input_and_what_is_there_are_left_alone(log, tmp_path):
    path, *_ = log
    before = path.read_bytes()
    with pytest.raises(SaccadeError, match="is there already"):
        recover(path, path)
    assert path.read_bytes() == before
    with pytest.raises(SaccadeError, match="not a file"):
        recover(tmp_path, tmp_path / "out.mcap")
    with pytest.raises(SaccadeError, match="cannot be read"):
        recover(tmp_path / "absent", tmp_path / "out.mcap")


@pytest.mark.parametrize(("remove", "what"), [
    (lambda path: shutil.rmtree(path.parent), "the log's folder is gone"),
    (lambda path: path.unlink(), "the log's file is gone"),
    (lambda path: (path.unlink(), path.write_text("another")), "the log's file is gone")])
@pytest.mark.parametrize("notice", ["flush", "close"])
def test_a_log_that_is_removed_while_it_is_written_is_told_once(tmp_path, remove, what, notice):
    log = RunLog(tmp_path / "run" / "run.mcap", world="test")
    log.write(ACTION, None, encode(sample(ACTION.type)))
    log.flush()
    remove(log.path)
    with pytest.raises(RecordingStopped, match=f"{what}.*what is recorded from now on is lost"):
        getattr(log, notice)()
    log.write(ACTION, None, encode(sample(ACTION.type)))
    log.flush()
    log.close()


def test_a_log_whose_folder_is_moved_goes_on_there(tmp_path):
    log = RunLog(tmp_path / "run" / "run.mcap", world="test")
    log.write(ACTION, None, encode(sample(ACTION.type, seq=0)))
    (tmp_path / "run").rename(tmp_path / "elsewhere")
    log.flush()
    log.close()
    assert len(read(tmp_path / "elsewhere" / "run.mcap")) == 1


@pytest.mark.parametrize("finished", [True, False])
def test_messages_whose_key_stood_in_a_damaged_chunk_are_kept(log, tmp_path, finished):
    """Also where the recording was not finished: there is no index that repeats the keys."""
    path, ends, entries = log
    data = bytearray(path.read_bytes() if finished else path.read_bytes()[:ends[-1]])
    data[data.index(b"zstd") + 120] ^= 0xFF
    (tmp_path / "bad.mcap").write_bytes(data)
    report = recover(tmp_path / "bad.mcap", tmp_path / "out.mcap")
    assert (report.nameless, report.messages) == (0, (CHUNKS - 1) * EACH)
    assert read(tmp_path / "out.mcap") == entries[EACH:]
    with (tmp_path / "out.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert {schema.name for schema in summary.schemas.values()} == {"Action", "Percept"}
    assert {channel.schema_id == 0 for channel in summary.channels.values()} == {False}


def test_a_key_that_is_damaged_outside_of_its_chunk_is_not_taken_for_another(log, tmp_path):
    """The chunk itself is damaged too: its messages and those that need its key are left out."""
    path, ends, entries = log
    data = bytearray(path.read_bytes()[:ends[-1]])
    data[data.index(b"zstd") + 120] ^= 0xFF
    data[data.index(b"saccade/test/action") + 18] ^= 0x01
    (tmp_path / "bad.mcap").write_bytes(data)
    report = recover(tmp_path / "bad.mcap", tmp_path / "out.mcap")
    assert read(tmp_path / "out.mcap") == [entry for entry in entries[EACH:] if entry[0] == PERCEPT]
    assert report.nameless == (CHUNKS - 1) * (EACH - 1)


def test_a_key_that_another_chunk_has_is_found_behind_its_messages(tmp_path):
    """Logs of other writers repeat their keys: where the first chunk is damaged, a later one tells them."""
    key = Channel(1, "saccade/test/action", "msgpack", {}, 0)
    payload = encode(sample(ACTION.type, run="r", episode=0, step=0, seq=0))
    builder = RecordBuilder()
    Header("", "x").write(builder)
    for number, records in enumerate(([], [key])):
        content = RecordBuilder()
        for record in (Message(1, number, payload, number, number), *records):
            record.write(content)
        data = content.end()
        Chunk(compression="", data=data, message_start_time=0, message_end_time=1, uncompressed_crc=zlib.crc32(data),
              uncompressed_size=len(data)).write(builder)
    (tmp_path / "a.mcap").write_bytes(MCAP0_MAGIC + builder.end())
    report = recover(tmp_path / "a.mcap", tmp_path / "out.mcap")
    assert (report.messages, report.nameless) == (2, 0)
    assert [entry[3] for entry in read(tmp_path / "out.mcap")] == [0, 1]
