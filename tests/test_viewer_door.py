"""The viewer's door: whom it lets in, at both ports, and whom it refuses."""

from __future__ import annotations

import http.client
import signal
import socket
import sys
from contextlib import ExitStack, suppress
from urllib.parse import parse_qs, urlsplit

import pytest
import rerun as rr
import yaml

from saccade.deploy.director import main as direct
from saccade.services.viewer.door import HTTP2, MOST, MOST_WAITING, Door
from saccade.services.viewer.server import Server, free_port, url_of
from saccade.shared.admission import Head, Rules, head_of, is_loopback
from saccade.shared.config import PACKAGE, Config, ViewerConfig
from saccade.tests.test_viewer_server import WAIT_S, answer_at, configured, until

READ = "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages"
GRPC_WEB = {"Content-Type": "application/grpc-web+proto", "X-Grpc-Web": "1"}


@pytest.fixture(scope="module")
def server():
    with Server(configured()) as server:
        yield server


@pytest.mark.parametrize(("header", "host"), [
    ("localhost:9090", "localhost"), ("[::1]:9090", "::1"), ("", None), ("a b", None), ("x;script-src *", None),
    ("[", None), ("localhost:x", None), ("evil.example/localhost", None), ("me@localhost", None), ("é", None)])
def test_a_host_is_a_name_and_nothing_else(header, host):
    assert Head("GET", "/", {"host": header}).host == host


def test_what_is_no_request_is_none():
    assert head_of(b"GET /x?a=1&a=2 HTTP/1.1\r\nHost: localhost\r\n\r\n").query == {"a": "2"}
    for lines in ("GET / HTTP/1.1\r\nHost: localhost\r\nHost: evil", "GET http://x/ HTTP/1.1", "GET /",
                  "GET / HTTP/2.0", "GET / HTTP/1.1\r\nHost : localhost", "GET / HTTP/1.1\r\nno colon",
                  "GET / HTTP/1.1\r\n Host: x", "GET / HTTP/1.1\r\nA: b\nHost: localhost"):
        assert head_of(f"{lines}\r\n\r\n".encode()) is None


def read_data(port: int, path: str = READ, **headers: str | None) -> tuple[int, str]:
    """What a browser gets that asks this port for the recording's data: the status and the type."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=WAIT_S)
    given = {"Host": f"localhost:{port}", "Origin": f"http://localhost:{port}", **GRPC_WEB, **headers}
    connection.request("POST", path, b"\0" * 5, {name: value for name, value in given.items() if value is not None})
    answered = connection.getresponse()
    connection.close()
    return answered.status, answered.headers["Content-Type"]


def test_what_is_not_of_this_machine_is_refused_at_both_ports(server):
    """DNS rebinding comes with a Host of its own, a page of another site with an Origin of its own."""
    page_port = urlsplit(server.url).port
    for port in (page_port, server.data_port):
        own = f"http://localhost:{page_port}"
        assert read_data(port) == (200, "application/grpc-web+proto")
        assert read_data(port, Host=f"127.0.0.1:{port}", Origin=f"http://127.0.0.1:{port}")[0] == 200
        assert read_data(port, Host=f"[::1]:{port}", Origin=f"http://[::1]:{page_port}")[0] == 200
        assert read_data(port, Origin=own)[0] == 200
        assert read_data(port, Origin=None)[0] == 200
        for host in ("evil.example", f"evil.example:{port}", "localhost.evil.example", "192.168.1.7", "0.0.0.0", "a b"):
            assert read_data(port, Host=host, Origin=f"http://{host}") == (403, "text/plain; charset=utf-8")
            assert read_data(port, Host=host, Origin=None)[0] == 403
            assert answer_at(port, "/", Host=host).status == 403
            assert answer_at(port, "/re_viewer.js", Host=host).status == 403
        for origin in ("http://evil.example", "null", "http://localhost:1", "https://rerun.io", f"{own}.evil.example",
                       f"http://evil.example:{page_port}"):
            assert read_data(port, Origin=origin) == (403, "text/plain; charset=utf-8")
            assert answer_at(port, "/", Host=f"localhost:{port}", Origin=origin).status == 403


def test_each_request_of_a_connection_is_looked_at(server):
    """Only the first request of a connection is answered, whatever comes behind it."""
    for port in (urlsplit(server.url).port, server.data_port):
        with socket.create_connection(("127.0.0.1", port), timeout=WAIT_S) as guest:
            guest.sendall(f"POST /nothing HTTP/1.1\r\nHost: localhost:{port}\r\nContent-Length: 0\r\n\r\n"
                          f"GET /favicon.ico HTTP/1.1\r\nHost: evil.example\r\n\r\n".encode())
            assert b"".join(iter(lambda: guest.recv(4096), b"")).count(b"HTTP/1.1 ") == 1
        assert raw(port, f"POST / HTTP/1.1\r\nHost: localhost:{port}\r\nTransfer-Encoding: chunked\r\n\r\n") == "411"
        assert raw(port, "GET / HTTP/1.1\r\nHost: localhost\r\nHost: localhost\r\n\r\n") == "400"
        assert raw(port, f"GET /{'x' * 200_000} HTTP/1.1\r\n") == "nothing"


def raw(port: int, request: str) -> str:
    """The status of what is answered to these bytes."""
    with socket.create_connection(("127.0.0.1", port), timeout=WAIT_S) as guest, suppress(ConnectionError):
        guest.sendall(request.encode())
        return (guest.recv(4096).decode("latin-1").split() or ["", "nothing"])[1]
    return "nothing"


def test_guests_are_limited_and_leave_no_trace(server):
    """Those who were let in take all places, and those who say nothing take none; when they have gone there is room
    again."""
    port = urlsplit(server.url).port
    welcome = f"GET / HTTP/1.1\r\nHost: localhost:{port}\r\n\r\n"
    with ExitStack() as stack:
        for _ in range(MOST_WAITING + 10):
            stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=WAIT_S))
        assert raw(port, welcome) == "302"

        def is_full() -> bool:
            """One more comes as a Rerun viewer begins, and stays; the server behind may still be starting."""
            guest = stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=WAIT_S))
            guest.sendall(HTTP2 + b"SM\r\n\r\n")
            return raw(port, welcome) == "503"

        tries = next((n for n in range(4 * MOST) if is_full()), 0)
        assert tries >= MOST - 1
    assert until(lambda: raw(port, welcome) == "302")


def test_no_request_takes_a_place_for_good():
    """With a token, as when other hosts reach the viewer; nobody is behind the door."""
    port, data_port = free_port("127.0.0.1"), free_port("127.0.0.1")
    nobody = ("127.0.0.1", 9)
    door = Door(ViewerConfig(port=port, token="A" * 24), data_port, nobody, nobody)
    door.open()
    try:
        host = f"Host: h:{port}\r\n"
        for length in ("9" * 5000, "9" * 19, "\u00b2", "-1", "1_0"):
            assert raw(port, f"POST /?token={'A' * 24} HTTP/1.1\r\n{host}Content-Length: {length}\r\n\r\n") == "411"
        for _ in range(MOST + 1):
            assert raw(port, f"GET //[x HTTP/1.1\r\n{host}\r\n") == "403"
        assert raw(port, f"GET //[x?token={'A' * 24} HTTP/1.1\r\n{host}\r\n") == "502"
        assert raw(port, f"GET /?token={'A' * 24} HTTP/1.1\r\n{host}\r\n") == "302"
        assert until(lambda: not door._waiting and not door._let_in)
    finally:
        door.close()


@pytest.mark.parametrize(("header", "told"), [("localhost:", "localhost:80"), ("localhost", "localhost:80"),
                                              ("[::1]:", "[::1]:80"), ("localhost:9090", "localhost:9090")])
def test_a_port_is_always_told(header, told):
    assert Head("GET", "/", {"host": header}).host_and_port == told


def test_opened_to_other_hosts_it_asks_for_the_token_that_its_address_has():
    with Server(configured(address="0.0.0.0")) as server:
        port, token = urlsplit(server.url).port, parse_qs(urlsplit(server.url).query)["token"][0]
        assert server.url == f"http://localhost:{port}/?token={token}"
        assert server.page == f"http://localhost:{port}"
        assert len(token) >= 20
        for asked in (port, server.data_port):
            for path in ("/", "/re_viewer.js", "/?token=", "/?token=wrong", f"/?token={token[:-1]}"):
                refused = answer_at(asked, path, Host=f"studio.local:{asked}")
                assert refused.status == 403
                assert b"open the whole address that Saccade printed" in refused.read()
            studio = {"Host": f"studio.local:{asked}", "Origin": f"http://studio.local:{port}"}
            assert read_data(asked)[0] == 403
            assert read_data(asked, **studio)[0] == 403
            assert read_data(asked, **studio, Cookie=f"saccade-{port}=wrong; saccade-1={token}")[0] == 403
            assert read_data(asked, **studio, Cookie=f"other=1; saccade-{port}={token}")[0] == 200
            assert read_data(asked, f"{READ}?token={token}", **studio)[0] == 200
            assert read_data(asked, Origin="http://evil.example", Cookie=f"saccade-{port}={token}")[0] == 403
        welcome = answer_at(port, f"/?token={token}", Host=f"studio.local:{port}")
        assert welcome.status == 302
        assert f"studio.local%3A{port}" in welcome.headers["Location"]
        assert token not in welcome.headers["Location"]
        assert welcome.headers["Set-Cookie"] == f"saccade-{port}={token}; Path=/; HttpOnly; SameSite=Lax"
        cookie = welcome.headers["Set-Cookie"].split(";")[0]
        assert answer_at(port, welcome.headers["Location"], Host=f"studio.local:{port}", Cookie=cookie).status == 200
    with Server(configured(address="0.0.0.0")) as another:
        assert token not in another.url


def test_published_on_the_loopback_alone_it_needs_no_token_and_knows_no_other_name():
    """As Docker Compose does it: within the container it listens at every address."""
    config = configured(address="0.0.0.0", published="127.0.0.1")
    with Server(config) as server:
        port = urlsplit(server.url).port
        assert server.url == f"http://localhost:{port}"
        assert config.token is None
        assert answer_at(port, "/", Host=f"localhost:{port}").status == 302
        assert read_data(port)[0] == read_data(server.data_port)[0] == 200
        assert answer_at(port, "/", Host=f"studio.local:{port}").status == 403
        assert read_data(server.data_port, Host="evil.example", Origin=None)[0] == 403
    assert configured(address="0.0.0.0", published="192.168.1.7").token
    assert configured(address="0.0.0.0").token
    assert configured(address="::").token
    assert configured().token is configured(address="localhost").token is None


def test_containers_need_a_token_where_their_ports_are_published_to_others(monkeypatch):
    """What the director prints, and what the viewer reads in its configuration; Compose publishes at 127.0.0.1."""
    directed: list[Config] = []
    monkeypatch.setattr("saccade.deploy.director.direct", lambda config, *_: directed.append(config))
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    services = yaml.safe_load((PACKAGE / "compose.yaml").read_text())["services"]
    published = next(word for word in services["director"]["command"] if word.startswith("--view-published="))
    assert {port.split(":")[0] for port in services["viewer"]["ports"]} == {published.partition("=")[2]}
    for argument in ([published], [], ["--view-published=192.168.1.7"]):
        direct(["--view-port=9090", *argument])
    compose, cluster, opened = (config.viewer for config in directed)
    assert (url_of(compose), compose.token) == ("http://localhost:9090", None)
    assert url_of(cluster) == f"http://localhost:9090/?token={cluster.token}"
    assert None not in (cluster.token, opened.token)
    assert cluster.token != opened.token


def test_a_viewer_that_is_no_browser_gets_in_from_this_machine_alone(server):
    rules = Rules(9090, "secret")
    assert [rules.admits_native(peer) for peer in ("127.0.0.1", "::1", "::ffff:127.0.0.1", "192.168.1.7", "x")] == [
        True, True, True, False, False]
    assert Rules(9090, None).admits_native("172.17.0.1")  # it is published on the loopback alone
    recording = rr.RecordingStream("saccade")
    recording.connect_grpc(f"rerun+http://127.0.0.1:{server.data_port}/proxy")  # HTTP/2, as `rerun --connect`
    recording.log("said", rr.TextLog("hello"))
    recording.flush()
    recording.disconnect()


@pytest.mark.skipif(sys.platform != "linux", reason="needs an address of this machine that is not a loopback one")
def test_a_viewer_that_is_no_browser_is_refused_from_another_host():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):
        probe.connect(("192.0.2.1", 9))  # sends nothing
        address = probe.getsockname()[0]
    if "address" not in locals() or is_loopback(address):
        pytest.skip("this machine has the loopback address alone")
    with Server(configured(address="0.0.0.0")) as server, socket.create_connection(
            (address, server.data_port), timeout=WAIT_S, source_address=(address, 0)) as guest:
        guest.sendall(HTTP2)
        assert guest.recv(4096).startswith(b"HTTP/1.1 403 Forbidden")
