"""Files that claim more than they hold, and files of others: one line, within bounded memory, nothing is written."""

from __future__ import annotations

import json
import os
import resource
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Header, Message, Metadata
from mcap.writer import MCAP0_MAGIC, Writer

from saccade.app.api import open as open_log
from saccade.app.log.check import between, in_stretches, missing
from saccade.app.log.info import gather
from saccade.app.log.recover import recover
from saccade.app.replay.comparison import Comparison
from saccade.shared.bus.topics import ACTION, FRAME, PERCEPT, TRUTH
from saccade.shared.bus.wire import MAX_SMALL_BYTES, encode
from saccade.shared.errors import SaccadeError
from saccade.shared.log import records as log_records
from saccade.shared.log.reading import RunReader, is_whole
from saccade.shared.log.recording import LONGEST_KEY, MOST_KEYS, RunLog
from saccade.shared.log.records import MAX_CHUNK_BYTES
from saccade.tests.front_door import call
from saccade.tests.samples import sample

GOLDEN = Path(__file__).with_name("fixtures") / "golden.mcap"
FAR = 2 ** 62
MEMORY_BYTES = 1_500_000_000  # of address space: loading the libraries takes a good part of it
WAIT_S = 300


def saccade(*arguments: object) -> subprocess.CompletedProcess:
    """The command, with room for what is sane and no more."""
    return subprocess.run(
        [sys.executable, "-m", "saccade", *map(str, arguments)], capture_output=True, text=True, timeout=WAIT_S,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES)))


def log_of(path: Path, *messages, configuration: str = "{}") -> Path:
    log = RunLog(path, world="table", configuration=configuration)
    for topic, part, message in messages:
        log.write(topic, part, encode(message), sequence=message.seq)
    log.close()
    return path


@pytest.fixture
def far(tmp_path):
    """A log of three messages, of which the last is of a step and has a number that nobody will reach."""
    def new(topic, step, part=None, **changes):
        return topic, part, sample(topic.type, run="r", episode=0, step=step, seq=step, **changes)

    return log_of(tmp_path / "far.mcap", new(FRAME, 0), new(PERCEPT, 0, "mug", object="mug"), new(FRAME, FAR),
                  configuration=json.dumps({"scene": {"names": ["mug"]}}))


def test_a_step_that_is_far_away_costs_no_memory(far, tmp_path):
    done = saccade("log", "check", far)
    assert (done.returncode, done.stderr) == (1, "")
    assert f"saccade/table/frame: not there in episode 0 of r, step 1-{FAR - 1}\n" in done.stdout
    assert f"saccade/table/percept/mug: not there in episode 0 of r, step 1-{FAR}\n" in done.stdout
    assert f"saccade/table/frame: {FAR - 1} messages lost, by their sequence numbers\n" in done.stdout
    done = saccade("log", "info", far)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"0:0 to 0:{FAR}" in done.stdout
    done = saccade("log", "recover", far, "--out", tmp_path / "recovered.mcap")
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "recovered.mcap").is_file()


def test_stretches_are_told_by_their_ends():
    assert list(between({0, 1, 5, FAR}, 0, FAR + 1)) == [(2, 4), (6, FAR - 1), (FAR + 1, FAR + 1)]
    assert list(between({3}, 4, 4)) == [(4, 4)]
    assert list(between(set(), 0, -1)) == []
    assert in_stretches([(1, 2), (3, 3), (7, FAR)]) == f"1-3, 7-{FAR}"


def test_many_episodes_that_lack_many_keys_are_listed_up_to_a_limit(tmp_path, monkeypatch):
    monkeypatch.setattr("saccade.app.log.check.MOST_ABSENT", 10)
    messages = [(topic, None, sample(topic.type, run="r", episode=i, step=0, seq=0, **changes)) for i in range(20)
                for topic, changes in (((ACTION, {}), (TRUTH, {"done": False}))[i % 2],)]
    report = missing(log_of(tmp_path / "a.mcap", *messages))
    assert len(report.absent) == 10
    assert "more steps lack something: they are not listed" in list(report.lines())


def foreign_file(path: Path, *, profile="ros2", topics=("/tf", "/camera/image", "/a\x1b[31mb"), finish=True) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile=profile)
        for topic in topics:
            channel = writer.register_channel(topic, "cdr", 0)
            writer.add_message(channel, 1, b"x", 1)
        writer.finish() if finish else writer.flush()
    return path


COMMANDS = [("log", "info", "FILE"), ("log", "check", "FILE"), ("log", "recover", "FILE", "--out", "o.mcap"),
            ("log", "cut", "FILE", "--out", "o.mcap"), ("log", "export", "FILE", "--out", "o.mcap"),
            ("replay", "FILE", "--into", "planner", "--out", "o"), ("film", "FILE", "o.mp4"), ("picture", "FILE"),
            ("view", "FILE", "--save", "o.rrd"), ("echo", "action", "--log", "FILE"), ("hz", "action", "--log", "FILE"),
            ("topics", "--log", "FILE")]


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: " ".join(command[:2]))
@pytest.mark.parametrize("kind", ["ros2", "text", "record"])
def test_what_is_no_log_is_one_line_for_every_command(monkeypatch, capsys, tmp_path, command, kind):
    monkeypatch.chdir(tmp_path)
    if command[1] == "export":
        pytest.importorskip("foxglove")
    if kind == "ros2":
        foreign_file(Path("x.mcap"))
        words = (r"x.mcap is an MCAP of profile 'ros2' with the topics /a\x1b[31mb, /camera/image (and 1 more), "
                 "not a log of Saccade: ")
    elif kind == "text":
        Path("x.mcap").write_text("some text that is long enough to be read as records, if one tried")
        words = "x.mcap is not an MCAP file"
    else:
        Path("x.mcap").write_bytes(MCAP0_MAGIC + struct.pack("<BQ", Opcode.CHUNK, 2 ** 60) + bytes(100))
        words = "x.mcap"
    code, out, err = call(monkeypatch, capsys, *("x.mcap" if word == "FILE" else word for word in command))
    if kind == "record" and command[0] in ("echo", "hz"):  # what is cut is read up to there
        assert "is cut or damaged" in out + err
    else:
        assert (code, out) == (2, "")
        assert err.startswith("saccade: ")
        assert words in err
        assert err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["x.mcap"]


@pytest.mark.parametrize(("profile", "topics", "finish", "words"), [
    ("ros2", ("saccade/table/frame",), True, "of profile 'ros2' with the topic saccade/table/frame, not"),
    ("", ("saccade/table/frame",), False, "is an MCAP with the topic saccade/table/frame, not"),
    ("", ("/tf",), True, "is an MCAP with the topic /tf, not"), ("", ("/tf", "/x"), False, "the topics /tf, /x, not"),
    ("ros1", (), True, "is an MCAP of profile 'ros1' without any topic, not"), ("", (), True, "without any topic")])
def test_other_files_are_told_as_what_they_are(tmp_path, profile, topics, finish, words):
    path = foreign_file(tmp_path / "x.mcap", profile=profile, topics=topics, finish=finish)
    for read in (open_log, RunReader, missing, lambda log: recover(log, tmp_path / "o.mcap")):
        with pytest.raises(SaccadeError, match=words):
            read(path)


def test_a_channel_that_someone_added_to_a_log_is_left_alone(tmp_path):
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic in ("/tf", "saccade/table/action", "saccade/table/percept/m\x1bg"):
            writer.add_message(writer.register_channel(topic, "msgpack", 0), 1, encode(sample(ACTION.type)), 1)
        writer.finish()
    reader = RunReader(tmp_path / "a.mcap")
    assert [entry.topic for entry in reader.entries()] == [ACTION]
    assert reader.others == 2


def file_of(path: Path, *records) -> Path:
    builder = RecordBuilder()
    Header("", "x").write(builder)
    for record in records:
        if isinstance(record, bytes):
            builder.write(record)
        else:
            record.write(builder)
    path.write_bytes(MCAP0_MAGIC + builder.end())
    return path


def chunk_of(data: bytes, size: int | None = None, compression: str = "zstd", compressed: bytes | None = None) -> Chunk:
    return Chunk(compression=compression, data=zstandard.compress(data) if compressed is None else compressed,
                 message_start_time=0, message_end_time=0, uncompressed_crc=0 if size else zlib.crc32(data),
                 uncompressed_size=size or len(data))


def bomb() -> bytes:
    """Four gigabytes of zeros in a few hundred kilobytes."""
    packer = zstandard.ZstdCompressor(level=1).compressobj(size=4 * 1024 ** 3)
    return b"".join(packer.compress(bytes(1024 ** 2)) for _ in range(4096)) + packer.flush()


def hostile(name: str, path: Path) -> Path:
    log, key = Metadata("log", {"format": "3"}), Channel(1, "saccade/table/action", "msgpack", {}, 0)
    good = RecordBuilder()
    key.write(good)
    Message(1, 1, encode(sample(ACTION.type, run="r", seq=0, step=0)), 1, 0).write(good)
    first = chunk_of(good.end())
    if name == "length":
        return file_of(path, log, first, struct.pack("<BQ", Opcode.METADATA, 2 ** 60), bytes(50))
    if name == "text":  # within a record, a text that would be longer than it
        return file_of(path, log, first, struct.pack("<BQI", Opcode.METADATA, 4, 2 ** 32 - 1))
    if name == "bomb":
        return file_of(path, log, first, chunk_of(b"", 4 * 1024 ** 3, compressed=bomb()))
    if name == "lying bomb":
        return file_of(path, log, first, chunk_of(b"", 1000, compressed=bomb()))
    if name == "lz4":
        return file_of(path, log, first, chunk_of(b"", 2 ** 63, "lz4", b"\x04\x22\x4d\x18" + bytes(20)))
    if name == "metadata":
        return file_of(path, log, first, *(Metadata(f"m{i}", {"a": "b"}) for i in range(100_000)))
    if name == "channels":  # a name that would do something to a terminal
        return file_of(path, log, Channel(2, "saccade/table/percept/\x1b[2J\nx", "msgpack", {}, 0), first)
    return file_of(path, log, first, b"\x0c" + bytes(8), b"\x0c" + bytes(8), *[b"\x0c" + bytes(8)] * 50_000)


@pytest.mark.parametrize("name", ["length", "text", "bomb", "lying bomb", "lz4", "metadata", "channels",
                                  "empty records"])
def test_a_hostile_log_takes_bounded_memory_and_few_lines(tmp_path, name):
    path = hostile(name, tmp_path / "x.mcap")
    assert path.stat().st_size < 16 * 1024 * 1024
    for command, codes in ((("info", path), {0}), (("check", path), {1}),
                           (("recover", path, "--out", tmp_path / "o.mcap"), {0})):
        done = saccade("log", *command)
        assert done.returncode in codes, done.stdout + done.stderr
        assert "Traceback" not in done.stderr
        assert len(done.stdout) < 10_000
        assert "\x1b[2J" not in done.stdout
    assert [entry.topic for entry in RunReader(tmp_path / "o.mcap").entries()] == [ACTION]


def test_a_chunk_that_is_too_large_is_damage_before_it_is_opened(tmp_path, monkeypatch):
    opened = []
    monkeypatch.setattr(zstandard, "decompress", lambda *arguments: opened.append(arguments))
    chunk = chunk_of(b"", MAX_CHUNK_BYTES + 1, compressed=b"")
    path = file_of(tmp_path / "x.mcap", Metadata("log", {"format": "3"}), chunk)
    reader = RunReader(path)
    assert list(reader.entries()) == []
    assert "is cut or damaged" in reader.cut
    assert opened == []


def test_a_chunk_that_swells_is_judged_by_itself(monkeypatch):
    """Those that swell have a limit together; the others are opened as well behind them as before them."""
    monkeypatch.setattr(log_records, "MOST_OPENED_BYTES", 3_000_000)
    opener, swollen, honest = log_records.Opener(sums=True), chunk_of(bytes(1_000_000)), chunk_of(os.urandom(1000))
    taken = []
    for chunk in (swollen, honest) * 5:
        try:
            taken.append(len(opener.data(chunk)))
        except ValueError:
            taken.append(None)
    assert taken == [1_000_000, 1000] * 3 + [None, 1000] * 2


@pytest.mark.parametrize("configuration", ["[" * 100_000, "\0" * 1000, "[1]", '{"bus": 7, "scene": [1]}', "{"])
def test_a_configuration_that_is_none_does_not_keep_a_log_from_being_looked_at(tmp_path, configuration):
    path = log_of(tmp_path / "a.mcap", (ACTION, None, sample(ACTION.type, run="r", episode=0, step=0, seq=0)),
                  configuration=configuration)
    assert missing(path).complete
    assert gather(path).keys.found
    with pytest.raises(SaccadeError):
        print(open_log(path).config)
    done = saccade("replay", path, "--into", "planner", "--bus", "local", "--out", tmp_path / "o")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr


def test_a_log_takes_so_many_keys_and_no_strange_ones(tmp_path, monkeypatch):
    log = RunLog(tmp_path / "a.mcap", world="table")
    payload = encode(sample(PERCEPT.type))
    for part in ("a\nb", "x" * LONGEST_KEY, *map(str, range(MOST_KEYS + 10))):
        log.write(PERCEPT, part, payload)
    log.close()
    assert log.messages == MOST_KEYS
    assert f"{MOST_KEYS} keys at most" in log.refusal(PERCEPT, "other", payload)
    assert log.refusal(PERCEPT, "0", payload) is None
    assert "messages of percept of at most 1048576 bytes" in log.refusal(PERCEPT, "0", bytes(MAX_SMALL_BYTES + 1))
    assert log.refusal(FRAME, None, bytes(MAX_SMALL_BYTES + 1)) is not None  # there is no room for another key
    assert [entry.part for entry in RunReader(log.path).entries()] == [str(i) for i in range(MOST_KEYS)]


def test_whether_a_log_has_its_end_is_known_without_reading_it(tmp_path):
    whole = GOLDEN.read_bytes()
    for length in (0, 8, 20, len(whole) - 100, len(whole) - 1):
        (tmp_path / "cut.mcap").write_bytes(whole[:length])
        assert not is_whole(tmp_path / "cut.mcap")
    assert is_whole(GOLDEN)
    assert not is_whole(tmp_path / "absent.mcap")
    log = RunLog(tmp_path / "early.mcap", world="table")
    log._file.end_early("No space left on device")
    assert not is_whole(log.path)


def test_a_recorded_message_that_is_no_valid_one_is_a_difference():
    comparison, message = Comparison(), sample(ACTION.type, step=1)
    comparison.recorded(ACTION, None, encode(message)[:-1])
    told, = comparison.replayed(ACTION, None, encode(message))
    assert (told.field, comparison.beyond, comparison.equal) == ("message", 1, False)
