"""The viewer's server: who can reach it, what it keeps, and that it goes when its owner goes."""

from __future__ import annotations

import http.client
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from ipaddress import ip_address
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import psutil
import pytest
import rerun as rr

from saccade.services.viewer.live import connected
from saccade.services.viewer.server import Server, free_port, listens, url_of, with_free_ports
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError

WAIT_S = 30
MEBI = 2 ** 20
SHOWN = ("from saccade.tests.test_viewer_server import Server, configured, time\n"
         "with Server(configured()) as s: print(s.data_url, s._home.path, flush=True); time.sleep(600)")


def configured(**values):
    """A viewer's configuration with free ports."""
    return with_free_ports(Config().with_values({f"viewer.{key}": value for key, value in values.items()})).viewer


@pytest.fixture
def server():
    with Server(configured()) as server:
        yield server


def answer(server: Server, path: str, **headers: str) -> http.client.HTTPResponse:
    return answer_at(urlsplit(server.url).port, path, **headers)


def answer_at(port: int, path: str, **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=WAIT_S)
    connection.request("GET", path, headers=headers)
    return connection.getresponse()


def test_the_bare_address_shows_the_recording_and_the_page_speaks_to_nobody_else(server):
    port = urlsplit(server.url).port
    sent = answer(server, "/")
    assert sent.status == 302
    assert f"rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{port}%2Fproxy" in sent.headers["Location"]
    assert sent.headers["Set-Cookie"] is None
    assert f"localhost%3A{port}" in answer(server, "/", Host=f"localhost:{port}").headers["Location"]
    assert "localhost%3A80%2F" in answer(server, "/", Host="localhost").headers["Location"]
    page = answer(server, sent.headers["Location"])
    assert page.status == 200
    assert b"re_viewer.js" in page.read()
    allowed = page.headers["Content-Security-Policy"].split("connect-src")[1].split()
    assert allowed == ["'self'", "blob:", "data:"]
    assert page.headers["Access-Control-Allow-Origin"] is None
    assert answer(server, "/re_viewer.js").headers["Content-Type"].startswith("text/javascript")
    assert len(answer(server, "/re_viewer_bg.wasm").read()) > 10 * MEBI
    assert answer(server, "/nothing").status == 404


def until(done) -> bool:
    end_s = time.monotonic() + WAIT_S
    while not (well := done()) and time.monotonic() < end_s:
        time.sleep(0.1)
    return well


def test_it_listens_on_the_loopback_alone_and_tells_nobody_that_it_is_used(server):
    mine = psutil.Process()
    children = [p for p in mine.children(recursive=True) if "--serve-web" in p.cmdline()]
    listening = {c.laddr.ip for p in (mine, *children) for c in p.net_connections() if c.status == psutil.CONN_LISTEN}
    assert len(children) == 1
    assert all(ip_address(address).is_loopback for address in listening)
    if sys.platform == "linux":  # Rerun's own ports are where a page of another site does not find them
        assert "127.0.0.1" not in {c.laddr.ip for c in children[0].net_connections() if c.status == psutil.CONN_LISTEN}
    home = Path(children[0].environ()["HOME"])
    assert json.loads((home / ".config" / "rerun" / "analytics.json").read_text())["analytics_enabled"] is False


def test_what_it_keeps_is_bounded():
    """Eight times as much as it may keep is logged."""
    with Server(configured(memory_mb=32)) as server:
        child = next(p for p in psutil.Process().children() if "--serve-web" in p.cmdline())
        recording = rr.RecordingStream("saccade")
        with connected(recording, server):
            rng, before = np.random.default_rng(0), child.memory_info().rss
            for step in range(256):
                recording.set_time("step", sequence=step)
                recording.log("noise", rr.Tensor(rng.integers(0, 256, MEBI, dtype=np.uint8)))
            recording.flush()
            assert server.running
            assert child.memory_info().rss - before < 128 * MEBI


def test_a_port_that_is_taken_is_said_in_one_line():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        config = Config().with_values({"viewer.port": port})
        with pytest.raises(SaccadeError, match=f"viewer: port {port} of 127.0.0.1 cannot be opened"):
            Server(config.viewer)
        assert with_free_ports(config).viewer.port == free_port("127.0.0.1", port) > port
        with pytest.raises(SaccadeError, match=rf"port {port} of 127.0.0.1 cannot be opened .* viewer.data_port"):
            Server(configured(data_port=port))
    assert configured(port=port, data_port=port).port > port  # the page and its data have two
    assert url_of(configured(address="0.0.0.0")).startswith("http://localhost:")


def test_without_rerun_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr("saccade.services.viewer.server.find_spec", lambda name: None)
    with pytest.raises(SaccadeError, match=r"pip install 'saccade\[viewer\]'"):
        Server(configured())


@pytest.mark.skipif(sys.platform != "linux", reason="sessions' niceness is Linux's")
@pytest.mark.parametrize("own_session", [True, False])
def test_who_looks_on_comes_last_and_its_terminal_does_not(own_session):
    code = ("import os\nfrom saccade.services.viewer.priority import SESSION, come_last\n"
            "def nice(): return (SESSION.read_text().split() or [None])[-1] if SESSION.exists() else None\n"
            "before = nice()\ncome_last()\nprint(os.sched_getscheduler(0) == os.SCHED_IDLE, before, nice())")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, start_new_session=own_session)
    idle, before, after = done.stdout.split()
    assert idle == "True"
    assert after == ("19" if own_session and before != "None" else before)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a killed process leaves its children")
def test_a_viewer_that_is_killed_takes_its_server_along():
    with subprocess.Popen([sys.executable, "-c", SHOWN], stdout=subprocess.PIPE, text=True) as viewer:
        data, _ = viewer.stdout.readline().split()
        rerun = urlsplit(data.removeprefix("rerun+"))
        socket.create_connection((rerun.hostname, rerun.port), timeout=WAIT_S).close()
        os.kill(viewer.pid, signal.SIGKILL)
        viewer.wait()
    assert until(lambda: not listens(rerun.hostname, rerun.port))


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no locks on folders")
def test_the_folder_of_a_killed_viewer_is_removed_by_the_next_and_no_other(tmp_path, monkeypatch):
    """What is in use, what is another user's, and what is no folder stays."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    viewers, folders = [], []
    try:
        for _ in range(2):  # one after the other, or both may choose the same free port
            viewers.append(subprocess.Popen([sys.executable, "-c", SHOWN], stdout=subprocess.PIPE, text=True))
            folders.append(Path(viewers[-1].stdout.readline().split()[1]))
        killed, used = folders
        assert {killed.parent, used.parent} == {tmp_path}
        viewers[0].kill()
        viewers[0].wait()
        (tmp_path / "other").mkdir()
        (tmp_path / "saccade-viewer-file").touch()
        (tmp_path / "saccade-viewer-link").symlink_to(tmp_path / "other")
        kept = {"other", "saccade-viewer-file", "saccade-viewer-link", used.name}
        if os.getuid() == 0:
            (tmp_path / "saccade-viewer-theirs").mkdir()
            os.chown(tmp_path / "saccade-viewer-theirs", 1234, 1234)
            kept.add("saccade-viewer-theirs")
        assert killed.is_dir()
        with Server(configured()) as server:
            assert {path.name for path in tmp_path.iterdir()} == kept | {server._home.path.name}
            assert (used / "log").is_file()
        assert {path.name for path in tmp_path.iterdir()} == kept
    finally:
        for viewer in viewers:
            viewer.kill()
            viewer.communicate()


def test_a_server_that_does_not_start_leaves_no_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr("saccade.services.viewer.server.binary", lambda: shutil.which("false"))
    monkeypatch.setattr("saccade.services.viewer.server.Server._environment", lambda _: dict(os.environ))
    with pytest.raises(SaccadeError, match=r"Rerun's server does not start at 127\..*: it said 'nothing'"):
        Server(configured())
    assert list(tmp_path.iterdir()) == []
