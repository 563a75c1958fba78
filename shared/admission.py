"""The ports that a browser comes to, and who may use them: the Host, the Origin and the token of an HTTP request.

A page of another site must not read the run, not even under a name that its owner lets point to this machine (DNS
rebinding). A browser cannot forge the headers Host and Origin, so they tell whose page asks. They tell nothing about a
program on another host, so a viewer that is open to other hosts needs a token too.
"""

from __future__ import annotations

import ipaddress
import secrets
import socket
from dataclasses import dataclass
from urllib.parse import parse_qs, urlsplit

from saccade.shared.config import ViewerConfig
from saccade.shared.errors import SaccadeError

TOKEN_BYTES = 18
ONCE = ("host", "origin", "cookie", "content-length")  # a request with two of these is malformed


@dataclass(frozen=True)
class Head:
    """The head of an HTTP/1.1 request. The names of `headers` are in lower case."""

    method: str
    target: str
    headers: dict[str, str]

    @property
    def query(self) -> dict[str, str]:
        """The last value of each name in the target's query."""
        return {name: values[-1] for name, values in parse_qs(self.target.partition("?")[2]).items()}

    @property
    def host(self) -> str | None:
        """The name in the Host header, without the port; None if that is not a name."""
        try:
            split = urlsplit(f"//{self.headers.get('host', '')}")
            name, _ = split.hostname, split.port
        except ValueError:
            return None
        if not name or split.netloc != self.headers["host"] or "@" in split.netloc:
            return None
        return name if name.isascii() and all(letter.isalnum() or letter in "-.:" for letter in name) else None

    @property
    def host_and_port(self) -> str:
        """The Host header of a request that is not refused, always with a port."""
        header = self.headers["host"]
        return header if urlsplit(f"//{header}").port else f"{header.removesuffix(':')}:80"


def head_of(data: bytes) -> Head | None:
    """The head in these bytes, which end with an empty line; None if it is malformed."""
    first, *lines = data.decode("latin-1").removesuffix("\r\n\r\n").split("\r\n")
    words, headers = first.split(" "), {}
    if len(words) != 3 or words[2] not in ("HTTP/1.1", "HTTP/1.0") or not words[1].startswith("/"):
        return None
    for line in lines:
        name, colon, value = line.partition(":")
        name = name.lower()
        if not colon or not name or name != name.strip() or (name in ONCE and name in headers) or "\n" in line:
            return None
        headers[name] = value.strip()
    return Head(words[0], words[1], headers)


@dataclass(frozen=True)
class Rules:
    """What is asked of a request. `page_port`: where the page is. `token`: None if no other host reaches the viewer."""

    page_port: int
    token: str | None

    @property
    def cookie(self) -> str:
        """The name of the cookie that holds the token. Cookies belong to a host, not to a port."""
        return f"saccade-{self.page_port}"

    def refusal(self, head: Head) -> str | None:
        """Why a request is refused, in one line that says what to do; None if it may pass."""
        host, origin = head.host, head.headers.get("origin")
        if host is None or (self.token is None and not is_loopback(host)):
            return "the viewer answers on this machine only, and not under this name: open it as localhost"
        if origin is not None and not self._is_own(origin, host, head.headers["host"]):
            return "a page of another site may not read the viewer: open the viewer's own page"
        if self.token is not None and not secrets.compare_digest(self._given(head).encode(), self.token.encode()):
            return "the token is missing or wrong: open the whole address that Saccade printed when the run started"
        return None

    def admits_native(self, peer: str) -> bool:
        """Whether a Rerun viewer that is not a browser may come from this address. It speaks HTTP/2 without TLS, which
        no browser does, so it has no Origin; and it cannot give a token."""
        return self.token is None or is_loopback(peer)

    def _is_own(self, origin: str, host: str, netloc: str) -> bool:
        name = f"[{host}]" if ":" in host else host
        return origin in (f"http://{netloc}", f"https://{netloc}", f"http://{name}:{self.page_port}")

    def _given(self, head: Head) -> str:
        if "token" in head.query:
            return head.query["token"]
        cookies = (cookie.strip().partition("=") for cookie in head.headers.get("cookie", "").split(";"))
        return next((value for name, _, value in cookies if name == self.cookie), "")


def is_loopback(name: str) -> bool:
    """Whether a name or an address is this machine's own, whoever resolves it."""
    if name == "localhost":
        return True
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        return False
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return (mapped or address).is_loopback


def with_token(config: ViewerConfig) -> ViewerConfig:
    """The configuration with a new token if other hosts reach the viewer, without one if not."""
    is_open = not is_loopback(config.published or config.address)
    return config.model_copy(update={"token": secrets.token_urlsafe(TOKEN_BYTES) if is_open else None})


def open_port(service: str, address: str, port: int, key: str) -> socket.socket:
    """A socket that listens at a port. `key` is that of the configuration which names the port. Raises SaccadeError if
    it cannot be opened."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    try:
        return socket.create_server((address, port), family=family,
                                    dualstack_ipv6=address == "::" and socket.has_dualstack_ipv6())
    except OSError as error:
        raise SaccadeError(f"{service}: port {port} of {address} cannot be opened ({error.strerror}): "
                           f"choose another with {key}") from error
