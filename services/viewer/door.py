"""A small web server in front of Rerun's page.

The plain address of the viewer shows the recording. A content security policy lets the page connect to its own server
only.
"""

from __future__ import annotations

import http.client
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import quote, urlsplit

from saccade.shared.config import ViewerConfig
from saccade.shared.errors import SaccadeError

ANSWER_S = 20.0  # how long to wait for Rerun's server
KEPT = ("Content-Type", "Content-Encoding", "rerun-final-length")  # headers that are passed on with the page's files


def open_door(config: ViewerConfig, host: str, pages: int, data_port: int) -> ThreadingHTTPServer:
    """Opens a web server at the viewer's address.

    `/` redirects a browser to the recording, whose data comes from `data_port`. Every other path is passed on to the
    server at host:pages. Raises SaccadeError if the port cannot be opened.
    """
    try:
        door = ThreadingHTTPServer((config.address, config.port), _handler(host, pages, data_port))
    except OSError as error:
        raise SaccadeError(f"viewer: port {config.port} of {config.address} cannot be opened ({error.strerror}): "
                           "choose another with viewer.port") from error
    door.daemon_threads = True
    return door


def _handler(page_host: str, pages: int, data_port: int) -> type[BaseHTTPRequestHandler]:
    class Door(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_HEAD(self) -> None:
            self.do_GET()

        def do_GET(self) -> None:
            host = host_of(self.headers.get("Host", ""), page_host)
            if self.path == "/":
                data = quote(f"rerun+http://{host}:{data_port}/proxy", safe="")
                self._answer(302, b"", {"Location": f"/?url={data}&theme=dark&hide_welcome_screen"})
                return
            connection = http.client.HTTPConnection(page_host, pages, timeout=ANSWER_S)
            try:
                connection.request("GET", self.path)
                answer = connection.getresponse()
                kept = {name: answer.headers[name] for name in KEPT if name in answer.headers}
                self._answer(answer.status, answer.read(), kept | {"Content-Security-Policy": policy(host, data_port)})
            except (OSError, http.client.HTTPException):
                self.send_error(502, "the viewer's server does not answer")
            finally:
                connection.close()

        def _answer(self, status: int, body: bytes, headers: dict[str, str]) -> None:
            self.send_response(status)
            for name, value in (headers | {"Content-Length": str(len(body))}).items():
                self.send_header(name, value)
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            """Logs nothing: a line for every file of a page would be of no use."""

    return Door


def host_of(header: str, otherwise: str) -> str:
    """The name by which the browser knows this machine, from its Host header. `otherwise` if that is not a name."""
    try:
        host = urlsplit(f"//{header}").hostname or ""
    except ValueError:
        host = ""
    if not host or not all(letter.isalnum() or letter in "-.:" for letter in host):
        host = otherwise
    return f"[{host}]" if ":" in host else host


def policy(host: str, data_port: int) -> str:
    """The page's content security policy: the page may connect only to this server and to the recording's data."""
    return ("default-src 'self' 'unsafe-inline' blob: data:; "
            "script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:; "
            f"connect-src 'self' http://{host}:{data_port} blob: data:")
