"""Serves the page that guides a hand. It needs nothing from outside, and answers this machine only unless
`viewer.address` says otherwise; then a browser needs the token.

Each connection has one request. How many there are at a time, how long they last and how much they send is limited.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from pathlib import Path
from typing import NamedTuple

from saccade.services.guide.core import Guide
from saccade.shared.admission import Head, Rules, head_of, open_port
from saccade.shared.config import ViewerConfig

PAGE = Path(__file__).with_name("page.html")
MOST = 32  # connections at the same time; more are closed at once
HEAD_BYTES, ANSWER_S = 16 * 1024, 10.0  # the longest head of a request, and how long a connection lasts at most
REASONS = {200: "OK", 302: "Found", 400: "Bad Request", 403: "Forbidden", 404: "Not Found", 405: "Method Not Allowed"}
POLICY = ("default-src 'none'; img-src 'self' blob: data:; connect-src 'self'; script-src 'unsafe-inline'; "
          "style-src 'unsafe-inline'")
END = b"\r\n\r\n"


class Answer(NamedTuple):
    """An answer to a request: its status, the type of its content, the content, and further lines of the head."""

    status: int
    kind: str
    content: bytes
    lines: str = ""


class PageServer:
    """Serves the page at `viewer.guide_port` from the start until `close`. Raises SaccadeError if the port cannot be
    opened."""

    def __init__(self, config: ViewerConfig, guide: Guide) -> None:
        self._guide, self._rules, self._page = guide, Rules(config.guide_port, config.token), PAGE.read_bytes()
        self.port = config.guide_port
        self._socket = open_port("guide", config.address, self.port, "viewer.guide_port")
        self._connections = 0
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends every connection."""
        with contextlib.suppress(RuntimeError):  # it has ended already
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(ANSWER_S)
        self._socket.close()

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._serve())

    async def _serve(self) -> None:
        await asyncio.start_server(self._meet, sock=self._socket, limit=HEAD_BYTES)
        await self._stop.wait()

    async def _meet(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._connections >= MOST:
            writer.close()
            return
        self._connections += 1
        try:
            with contextlib.suppress(OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, TimeoutError):
                async with asyncio.timeout(ANSWER_S):
                    head = head_of(await reader.readuntil(END))
                    writer.write(_encoded(self.answer(head), body=head is None or head.method != "HEAD"))
                    await writer.drain()
        finally:
            self._connections -= 1
            writer.close()

    def answer(self, head: Head | None) -> Answer:
        """The answer to a request."""
        try:
            refusal = head and self._rules.refusal(head)
        except ValueError:  # an address that cannot be taken apart
            head = refusal = None
        if head is None:
            return _told(400, "this is no request of a browser")
        if refusal:
            return _told(403, refusal)
        if head.method not in ("GET", "HEAD"):
            return _told(405, "the page only shows")
        path = head.target.partition("?")[0]
        if path == "/" and "token" in head.query and self._rules.token:  # takes the token out of sight
            kept = f"{self._rules.cookie}={self._rules.token}; Path=/; HttpOnly; SameSite=Lax"
            return Answer(302, "text/plain", b"", f"Location: /\r\nSet-Cookie: {kept}\r\n")
        if path == "/":
            return Answer(200, "text/html; charset=utf-8", self._page)
        if path == "/state.json":
            return Answer(200, "application/json", self._guide.state())
        image = {"/image.jpg": self._guide.image, "/goal.jpg": self._guide.goal_image}.get(path)
        content = image() if image else None
        return _told(404, "there is nothing here") if content is None else Answer(200, "image/jpeg", content)


def _told(status: int, text: str) -> Answer:
    return Answer(status, "text/plain; charset=utf-8", f"{status} {text}\n".encode())


def _encoded(answer: Answer, *, body: bool) -> bytes:
    head = (f"HTTP/1.1 {answer.status} {REASONS[answer.status]}\r\n{answer.lines}Content-Type: {answer.kind}\r\n"
            f"Content-Length: {len(answer.content)}\r\nCache-Control: no-store\r\nX-Content-Type-Options: nosniff\r\n"
            f"Content-Security-Policy: {POLICY}\r\nConnection: close\r\n\r\n")
    return head.encode() + (answer.content if body else b"")
