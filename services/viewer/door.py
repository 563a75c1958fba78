"""The door of the viewer: the two ports that others reach, in front of the two ports of Rerun's server.

It reads the head of every request and refuses what may not pass (`shared/admission.py`). Then it only forwards bytes. A
page gets its data from the port that it came from, so a browser sends it the page's own cookie. The second port is for
Rerun viewers that are not a browser.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
from collections.abc import Awaitable, Callable
from urllib.parse import quote

from saccade.shared.admission import Head, Rules, head_of, open_port
from saccade.shared.config import ViewerConfig
from saccade.shared.errors import SaccadeError

Address = tuple[str, int]
Guest = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]

MOST = 64  # connections that were let in, at the same time; more are refused
MOST_WAITING = 64  # connections of which nobody knows yet who it is; the oldest makes room for a new one
LENGTH_DIGITS = 18  # of a body's length
BYTES = 64 * 1024  # the longest head, and what a direction of a connection holds in memory, about
HEAD_S = 10.0  # how long to wait for a head
ANSWER_S = 20.0  # how long to wait for Rerun's server to be connected
FULL = "too many connections: close other pages of this viewer"
END = b"\r\n\r\n"
HTTP2 = b"PRI * HTTP/2.0\r\n\r\n"  # how a connection of HTTP/2 without TLS begins
REPLACED = ("connection", "content-security-policy", "access-control-")  # headers of the page that are ours to set
REASONS = {302: "Found", 400: "Bad Request", 403: "Forbidden", 405: "Method Not Allowed", 411: "Length Required",
           502: "Bad Gateway", 503: "Service Unavailable"}


class Door:
    """Listens at the viewer's two ports, and forwards to Rerun's `pages` and `data`, from `open` until `close`.

    Raises SaccadeError if a port cannot be opened.
    """

    def __init__(self, config: ViewerConfig, data_port: int, pages: Address, data: Address) -> None:
        self._rules = Rules(config.port, config.token)
        self._pages, self._data = pages, data
        self._sockets: list[socket.socket] = []
        try:
            self._sockets.append(open_port("viewer", config.address, config.port, "viewer.port"))
            self._sockets.append(open_port("viewer", config.address, data_port, "viewer.data_port"))
        except SaccadeError:
            self.close()
            raise
        self._waiting: dict[asyncio.StreamWriter, None] = {}  # in the order in which they came
        self._let_in: set[asyncio.StreamWriter] = set()
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="door", daemon=True)

    def open(self) -> None:
        """Lets others in from now on."""
        self._thread.start()

    def close(self) -> None:
        """Ends every connection. May be called twice, and before `open`."""
        if len(self._sockets) == 2 and self._thread.is_alive():
            with contextlib.suppress(RuntimeError):  # it has ended already
                self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join(HEAD_S)
        for listening in self._sockets:
            listening.close()

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._serve())

    async def _serve(self) -> None:
        page, data = self._sockets
        await asyncio.start_server(self._guest(has_page=True), sock=page, limit=BYTES)
        await asyncio.start_server(self._guest(has_page=False), sock=data, limit=BYTES)
        await self._stop.wait()

    def _guest(self, *, has_page: bool) -> Guest:
        async def meet(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            self._waiting[writer] = None
            if len(self._waiting) > MOST_WAITING:
                oldest = next(iter(self._waiting))
                del self._waiting[oldest]
                oldest.close()
            try:
                with contextlib.suppress(OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, TimeoutError):
                    await self._meet(reader, writer, has_page=has_page)
            finally:
                self._waiting.pop(writer, None)
                self._let_in.discard(writer)
                writer.close()

        return meet

    async def _meet(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, has_page: bool) -> None:
        data = await asyncio.wait_for(reader.readuntil(END), HEAD_S)
        if data == HTTP2:
            if self._rules.admits_native(str(writer.get_extra_info("peername")[0])) and self._enter(writer):
                await self._forward(self._data, data, reader, writer)
            else:
                await _answer(writer, 403, "only a browser gets in from another host: for a Rerun viewer use ssh -L")
            return
        try:
            head = head_of(data)
            refusal = head and self._rules.refusal(head)
        except ValueError:  # an address that cannot be taken apart
            head = refusal = None
        if head is None:
            await _answer(writer, 400, "this is no request of a browser")
        elif refusal:
            await _answer(writer, 403, refusal)
        elif "transfer-encoding" in head.headers or (length := _length(head)) is None:
            await _answer(writer, 411, "a request needs a length")
        elif not self._enter(writer):
            await _answer(writer, 503, FULL)
        elif has_page and head.method in ("GET", "HEAD"):
            await self._show(head, reader, writer)
        elif has_page and head.method != "POST":
            await _answer(writer, 405, "the viewer only shows")
        else:
            await self._forward(self._data, _alone(head), reader, writer, length)

    def _enter(self, writer: asyncio.StreamWriter) -> bool:
        """Counts a connection among those that were let in. Returns False if there are too many."""
        if len(self._let_in) >= MOST:
            return False
        self._waiting.pop(writer, None)
        self._let_in.add(writer)
        return True

    async def _show(self, head: Head, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """A file of the page; the bare address leads to the recording, and takes the token out of sight."""
        if head.target.partition("?")[0] != "/" or ("url" in head.query and "token" not in head.query):
            await self._forward(self._pages, _alone(head), reader, writer, 0, page=True)
            return
        data = quote(f"rerun+http://{head.host_and_port}/proxy", safe="")
        kept = f"Set-Cookie: {self._rules.cookie}={self._rules.token}; Path=/; HttpOnly; SameSite=Lax\r\n"
        await _answer(writer, 302, "", f"Location: /?url={data}&theme=dark&hide_welcome_screen\r\n" +
                      (kept if self._rules.token else ""))

    async def _forward(self, to: Address, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter,
                       length: int | None = None, *, page: bool = False) -> None:
        """One request with a body of `length` bytes, or everything without it. Ends when one of the two sides does."""
        try:
            inner, out = await asyncio.wait_for(asyncio.open_connection(*to, limit=BYTES), ANSWER_S)
        except (OSError, TimeoutError):
            await _answer(writer, 502, "Rerun's server does not answer: start the viewer again")
            return
        try:
            out.write(head)
            ways = [asyncio.ensure_future(_pump(reader, out, length)),
                    asyncio.ensure_future(_pump_answer(inner, writer) if page else _pump(inner, writer))]
            try:
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for way in ways:
                    way.cancel()
                await asyncio.gather(*ways, return_exceptions=True)
        finally:
            out.close()


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, length: int | None = None) -> None:
    """Forwards bytes until the reader's end. What comes after `length` bytes is dropped: only the first request of a
    connection was looked at."""
    left = length
    while data := await reader.read(BYTES):
        if left is not None:
            data = data[:left]
            left -= len(data)
        if data:
            writer.write(data)
            await writer.drain()


async def _pump_answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """An answer of the page's server, with our own headers."""
    first, *lines = (await reader.readuntil(END)).removesuffix(END).split(b"\r\n")
    kept = [line for line in lines if not line.lower().startswith(tuple(name.encode() for name in REPLACED))]
    ours = [b"Connection: close", f"Content-Security-Policy: {policy()}".encode()]
    writer.write(b"\r\n".join([first, *kept, *ours]) + END)
    await _pump(reader, writer)


async def _answer(writer: asyncio.StreamWriter, status: int, text: str, headers: str = "") -> None:
    body = f"{status} {text}\n".encode() if text else b""
    writer.write(f"HTTP/1.1 {status} {REASONS[status]}\r\n{headers}Content-Type: text/plain; charset=utf-8\r\n"
                 f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n".encode() + body)
    await writer.drain()


def _length(head: Head) -> int | None:
    """The length of a request's body. None if it is not told in digits."""
    told = head.headers.get("content-length", "0")
    return int(told) if told.isascii() and told.isdigit() and len(told) <= LENGTH_DIGITS else None


def _alone(head: Head) -> bytes:
    """The head of a request that is the only one of its connection, without the cookies."""
    kept = (f"{name}: {value}" for name, value in head.headers.items()
            if name not in ("connection", "keep-alive", "upgrade", "cookie", "authorization"))
    return "\r\n".join([f"{head.method} {head.target} HTTP/1.1", *kept, "connection: close"]).encode("latin-1") + END


def policy() -> str:
    """The page's content security policy: the page may connect only to the server that it came from."""
    return ("default-src 'self' 'unsafe-inline' blob: data:; "
            "script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:; connect-src 'self' blob: data:")
