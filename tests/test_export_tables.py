"""Tables say what the run's messages said, and whatever cannot be exported is one clear error."""

from __future__ import annotations

import io
import json
import sys
import tracemalloc

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from rich.console import Console

from saccade.app.log import tables
from saccade.app.log.export import export_foxglove, export_tables
from saccade.app.log.fields import kinds, value_of
from saccade.shared.bus.messages import ArraySpec, field_types
from saccade.shared.bus.topics import FRAME, PLAN, TOPICS
from saccade.shared.bus.wire import encode
from saccade.shared.errors import SaccadeError
from saccade.shared.log.recording import RunLog
from saccade.tests.fakes.logs import CENTERS, SIZE, START_NS, of, story, write
from saccade.tests.samples import sample

RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A log and its messages."""
    messages = list(story())
    return write(tmp_path_factory.mktemp("run") / "run.mcap", messages), messages


def fixed(kind):
    return all(isinstance(side, int) for side in kind.shape)


@pytest.mark.parametrize("topic", TOPICS.values(), ids=lambda t: t.name)
def test_a_table_has_a_typed_column_for_every_field(tmp_path, topic):
    message = sample(topic.type)
    log = write(tmp_path / "run.mcap", [(topic, "mug" if topic.parts else None, message)] * 3)
    [path] = export_tables(log, tmp_path / "tables")
    table = pq.read_table(path)
    assert path == tmp_path / "tables" / f"{topic.name}.parquet"
    assert table.column_names[:1 + topic.parts] == (["log_time", "part"] if topic.parts else ["log_time"])
    assert table.column("log_time").cast(pa.int64()).to_pylist() == [START_NS + i * 10 ** 6 for i in range(3)]
    types = {int: pa.int64(), float: pa.float64(), bool: pa.bool_(), str: pa.string(), list[str]: pa.list_(pa.string())}
    columns = set(table.column_names) - {"log_time", "part"}
    for name, kind in kinds(topic.type).items():
        value = value_of(message, name)
        if not isinstance(kind, ArraySpec):
            assert table.schema.field(name).type == types[kind]
            assert table.column(name).to_pylist() == [value] * 3
        if isinstance(kind, ArraySpec) and not fixed(kind):
            assert table.column(f"{name}_shape").to_pylist() == [list(value.shape)] * 3
            columns.remove(f"{name}_shape")
        if isinstance(kind, ArraySpec) and kind.dtype != "u1":
            assert table.schema.field(name).type.value_type == pa.from_numpy_dtype(np.dtype(kind.dtype))
            assert pa.types.is_fixed_size_list(table.schema.field(name).type) == fixed(kind)
            assert table.column(name).to_pylist() == [value.ravel().tolist()] * 3
        if not isinstance(kind, ArraySpec) or kind.dtype != "u1":
            columns.remove(name)
    assert not columns


def test_tables_leave_out_what_is_large_or_absent_but_tell_its_shape(run, tmp_path):
    log, messages = run
    paths = export_tables(log, tmp_path / "tables")
    assert {path.stem for path in paths} == {topic.name for topic, _, _ in messages}
    belief = pq.read_table(tmp_path / "tables" / "belief.parquet")
    assert belief.column("part").to_pylist() == ["mug", "can"] * 6
    assert belief.column("particles_m").null_count == len(belief)
    assert belief.column("particles_m_shape").to_pylist() == [[50, 3]] * 12
    assert belief.column("goal_log_posterior_shape").to_pylist()[:3] == [None, None, [6, 7]]
    assert json.loads(belief.schema.field("covariance_m2").metadata[b"shape"].replace(b"x", b"")) == 33
    frame = pq.read_table(tmp_path / "tables" / "frame.parquet")
    assert "rgb" not in frame.column_names
    assert frame.column("rgb_shape").to_pylist() == [[*SIZE, 3]] * 6
    truth = pq.read_table(tmp_path / "tables" / "truth.parquet")
    assert truth.column("centers_m").to_pylist()[0] == CENTERS.ravel().tolist()


def test_tables_are_written_in_row_groups(run, tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "ROW_GROUP", 5)
    export_tables(run[0], tmp_path / "tables")
    file = pq.ParquetFile(tmp_path / "tables" / "belief.parquet")
    assert [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)] == [5, 5, 2]
    assert file.read().column("step").to_pylist() == [0, 0, 1, 1, 2, 2] * 2


def both(log, folder, **options):
    return {"mcap": lambda: export_foxglove(log, folder / "out.mcap", **options),
            "tables": lambda: export_tables(log, folder / "out.mcap", **options)}


@pytest.fixture
def cut_log(tmp_path):
    """A log that lost its end after the first two thirds, and an entry in it that is no message."""
    messages = list(story(episodes=3))
    log = RunLog(tmp_path / "cut.mcap", world="table")
    log.write(PLAN, None, b"nonsense", log_time_ns=START_NS)
    for i, (topic, part, message) in enumerate(messages):
        log.write(topic, part, encode(message), log_time_ns=START_NS + i)
        if i == len(messages) * 2 // 3:
            log.flush()
            whole = log.path.stat().st_size
    log.close()
    log.path.write_bytes(log.path.read_bytes()[:whole + 100])
    return log.path, messages[:len(messages) * 2 // 3 + 1]


@pytest.mark.parametrize("kind", ["mcap", "tables"])
def test_a_cut_log_is_exported_up_to_the_cut_and_that_is_said(cut_log, tmp_path, kind):
    log, messages = cut_log
    said = io.StringIO()
    result = both(log, tmp_path, console=Console(file=said))[kind]()
    assert "cut or damaged" in said.getvalue()
    assert "1 entries" in said.getvalue()
    frames = len(of(messages, FRAME))
    assert 6 <= frames < 9
    if kind == "mcap":
        assert result["/camera/image"] == frames
        with (tmp_path / "out.mcap").open("rb") as stream:
            [told] = [m.metadata for m in make_reader(stream).iter_metadata() if m.name == "export"]
        assert "cut or damaged" in told["cut"]
    else:
        metadata = pq.read_metadata(tmp_path / "out.mcap" / "frame.parquet")
        assert metadata.num_rows == frames
        assert b"cut or damaged" in metadata.metadata[b"cut"]
        assert b"1 entries" in metadata.metadata[b"refused"]


@pytest.mark.parametrize("kind", ["mcap", "tables"])
def test_a_whole_log_is_exported_in_silence(run, tmp_path, kind):
    said = io.StringIO()
    both(run[0], tmp_path, console=Console(file=said))[kind]()
    assert said.getvalue() == ""


@pytest.mark.parametrize("kind", ["mcap", "tables"])
def test_what_cannot_be_exported_is_one_clear_error_and_leaves_nothing(run, tmp_path, kind):
    log, foreign = run[0], run[0].with_name("export.mcap")
    if not foreign.exists():
        export_foxglove(log, foreign)
    (tmp_path / "text").write_text("hello")
    with pytest.raises(SaccadeError, match="not an MCAP"):
        both(tmp_path / "text", tmp_path)[kind]()
    with pytest.raises(SaccadeError, match="cannot be read"):
        both(tmp_path / "absent", tmp_path)[kind]()
    with pytest.raises(SaccadeError, match="cannot be written"):
        both(log, tmp_path / "text")[kind]()
    with pytest.raises(SaccadeError, match="no messages of Saccade"):
        both(foreign, tmp_path)[kind]()  # an export is no log
    assert [p.name for p in tmp_path.iterdir()] == ["text"]
    (tmp_path / "out.mcap").write_text("precious")
    with pytest.raises(SaccadeError, match="is there already"):
        both(log, tmp_path)[kind]()
    assert (tmp_path / "out.mcap").read_text() == "precious"


@pytest.mark.parametrize(("kind", "package", "module"), [
    ("mcap", "foxglove", "foxglove"), ("mcap", "google", "plottable"), ("tables", "pyarrow", "tables")])
def test_a_missing_package_is_named_with_the_command_that_installs_it(run, tmp_path, monkeypatch, kind, package,
                                                                      module):
    for name in [n for n in sys.modules if n == package or n.startswith(f"{package}.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, f"saccade.app.log.{module}", raising=False)
    with pytest.raises(SaccadeError, match=rf"package {package}.*pip install 'saccade\[export\]'"):
        both(run[0], tmp_path)[kind]()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["mcap", "tables"])
def test_memory_does_not_grow_with_the_log(tmp_path, kind):
    def peak(count):
        noise = (RNG.integers(0, 256, (60, 80, 3), dtype=np.uint8) for _ in range(count))
        frames = ((FRAME, None, sample(FRAME.type, episode=i // 20, step=i % 20, rgb=rgb, depth_m=None))
                  for i, rgb in enumerate(noise))
        folder = tmp_path / str(count)
        log = write(folder / "run.mcap", frames)
        tracemalloc.start()
        try:
            both(log, folder)[kind]()
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(1)  # what is imported stays
    assert peak(1000) < 1.4 * peak(250)  # 14 and 4 MB of images


def test_every_field_of_every_message_is_of_a_known_kind():
    for topic in TOPICS.values():
        assert list(kinds(topic.type)) == list(field_types(topic.type))
        assert all(isinstance(kind, ArraySpec) or kind in (str, int, float, bool, list[str])
                   for kind in kinds(topic.type).values())
