"""The viewer's server: who can reach it, what it keeps, and that it goes when its owner goes."""

from __future__ import annotations

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import psutil
import pytest
import rerun as rr

from saccade.services.viewer.door import host_of
from saccade.services.viewer.live import connected
from saccade.services.viewer.server import Server, free_port, listens, url_of, with_free_ports
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError

WAIT_S = 30
MEBI = 2 ** 20


def configured(**values):
    """A viewer's configuration with free ports."""
    return with_free_ports(Config().with_values({f"viewer.{key}": value for key, value in values.items()})).viewer


@pytest.fixture
def server():
    with Server(configured()) as server:
        yield server


def answer(server: Server, path: str, **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection(server.url.removeprefix("http://"), timeout=WAIT_S)
    connection.request("GET", path, headers=headers)
    return connection.getresponse()


def test_the_bare_address_shows_the_recording_and_the_page_speaks_to_nobody_else(server):
    sent = answer(server, "/")
    assert sent.status == 302
    assert f"rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{server.data_port}%2Fproxy" in sent.headers["Location"]
    assert f"studio.local%3A{server.data_port}" in answer(server, "/", Host="studio.local:9090").headers["Location"]
    page = answer(server, sent.headers["Location"])
    assert page.status == 200
    assert b"re_viewer.js" in page.read()
    allowed = page.headers["Content-Security-Policy"].split("connect-src")[1].split()
    assert allowed == ["'self'", f"http://127.0.0.1:{server.data_port}", "blob:", "data:"]
    assert answer(server, "/re_viewer.js").headers["Content-Type"].startswith("text/javascript")
    assert answer(server, "/nothing").status == 404


@pytest.mark.parametrize(("header", "host"), [
    ("localhost:9090", "localhost"), ("[::1]:9090", "[::1]"), ("", "here"), ("a b", "here"), ("x;script-src *", "here"),
    ("[", "here"), ("evil.example\r\nX: y", "evil.examplex")])
def test_a_host_is_a_name_and_nothing_else(header, host):
    assert host_of(header, "here") == host


def test_it_listens_on_the_loopback_alone_and_tells_nobody_that_it_is_used(server):
    mine = psutil.Process()
    children = [p for p in mine.children(recursive=True) if "--serve-web" in p.cmdline()]
    listening = {c.laddr.ip for p in (mine, *children) for c in p.net_connections() if c.status == psutil.CONN_LISTEN}
    assert len(children) == 1
    assert listening == {"127.0.0.1"}
    home = Path(children[0].environ()["HOME"])
    assert json.loads((home / ".config" / "rerun" / "analytics.json").read_text())["analytics_enabled"] is False


def test_opened_to_other_hosts_its_page_may_come_from_any_of_its_names():
    with Server(configured(address="0.0.0.0")) as server:
        assert server.url.startswith("http://localhost:")
        asked = {"Access-Control-Request-Method": "POST", "Access-Control-Request-Headers": "x-grpc-web"}
        connection = http.client.HTTPConnection("127.0.0.1", server.data_port, timeout=WAIT_S)
        ours = f"http://studio.local:{urlsplit(server.url).port}"
        for origin, allowed in ((ours, ours), ("http://elsewhere.example", None)):
            connection.request("OPTIONS", "/", headers=asked | {"Origin": origin})
            answer = connection.getresponse()
            answer.read()
            assert answer.headers["Access-Control-Allow-Origin"] == allowed


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
        with pytest.raises(SaccadeError, match=f"Rerun's server does not start on port {port}"):
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
    code = ("from saccade.tests.test_viewer_server import Server, configured, time\n"
            "with Server(configured()) as s: print(s.data_port, flush=True); time.sleep(600)")
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as viewer:
        port = int(viewer.stdout.readline())
        socket.create_connection(("127.0.0.1", port), timeout=WAIT_S).close()
        os.kill(viewer.pid, signal.SIGKILL)
        viewer.wait()
    end_s = time.monotonic() + WAIT_S
    while listens("127.0.0.1", port) and time.monotonic() < end_s:
        time.sleep(0.1)
    assert not listens("127.0.0.1", port)
