"""The bus: bytes in, bytes out, by topic and part. Zenoh between processes, and a twin within one.

Every endpoint is named: nothing is scouted, and nothing listens beyond the address given.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import queue
import re
import socket
import threading
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Protocol

from saccade.shared.bus.outbox import PAGE_BYTES, Kept, Since
from saccade.shared.bus.topics import ROOT, Topic, parse_key
from saccade.shared.bus.wire import MessageError, stamp_of
from saccade.shared.errors import SaccadeError

if TYPE_CHECKING:
    import zenoh

Deliver = Callable[[Topic, str | None, bytes], None]  # runs on the bus's thread: must only put its arguments somewhere
Answer = Callable[[Iterable[Topic], Since | None, int], list[Kept]]
Met = Callable[[frozenset[str]], None]

ROUTER_WAIT_VARIABLE, ROUTER_S = "SACCADE_ROUTER_S", 10.0
RECALL_S = 3.0  # for an answer to be whole: a publisher that hangs must not hang who asks it


class Bus(Protocol):
    """Messages of one key arrive in the order in which they were published. What was lost on the way, while a process
    or the router was away, its publisher still knows: `recall`."""

    def publish(self, topic: Topic, part: str | None, payload: bytes) -> None:
        """Sends wire bytes to whoever subscribes."""

    def subscribe(self, topics: Iterable[Topic] | None, deliver: Deliver) -> None:
        """Calls `deliver(topic, part, payload)` for every message of these topics, or of all."""

    def answer(self, topics: Iterable[Topic], answer: Answer) -> None:
        """Lets `answer(topics, since, limit_bytes)` tell others what was published on these topics."""

    def recall(self, topics: Iterable[Topic], since: Since | None = None, limit_bytes: int = PAGE_BYTES) -> list[Kept]:
        """What the publishers of these topics keep from (run, episode, step) on, or of their newest episode: each
        one's messages in their order, at most about `limit_bytes` of each. Empty where nobody answers."""

    def join(self, group: str, member: str, met: Met) -> None:
        """Is a member of a group until `close`; calls `met(members)` at once and whenever one comes or goes, be it
        killed."""

    def close(self) -> None:
        """Leaves the bus. May be called twice."""


class LocalBus:
    """The twin within one process: `publish` returns when every subscriber has its bytes."""

    def __init__(self) -> None:
        self._subscribers: list[tuple[frozenset[str] | None, Deliver]] = []
        self._answers: list[tuple[frozenset[str], Answer]] = []
        self._groups: dict[str, dict[str, Met]] = {}

    def publish(self, topic: Topic, part: str | None, payload: bytes) -> None:
        """Delivers at once, on the caller's thread."""
        for names, deliver in list(self._subscribers):
            if names is None or topic.name in names:
                deliver(topic, part, payload)

    def subscribe(self, topics: Iterable[Topic] | None, deliver: Deliver) -> None:
        """From now on; nothing published before is repeated."""
        self._subscribers.append((None if topics is None else frozenset(t.name for t in topics), deliver))

    def answer(self, topics: Iterable[Topic], answer: Answer) -> None:
        """From now on."""
        self._answers.append((frozenset(t.name for t in topics), answer))

    def recall(self, topics: Iterable[Topic], since: Since | None = None, limit_bytes: int = PAGE_BYTES) -> list[Kept]:
        """Asks at once, on the caller's thread."""
        topics = tuple(topics)
        return [kept for names, answer in list(self._answers)
                if (asked := [t for t in topics if t.name in names]) for kept in answer(asked, since, limit_bytes)]

    def join(self, group: str, member: str, met: Met) -> None:
        """Tells everyone, on the caller's thread."""
        self._groups.setdefault(group, {})[member] = met
        self._tell(group)

    def members(self, group: str) -> frozenset[str]:
        """Who is in a group now."""
        return frozenset(self._groups.get(group, ()))

    def leave(self, group: str, member: str) -> None:
        """What the end of a process does on a real bus."""
        del self._groups[group][member]
        self._tell(group)

    def _tell(self, group: str) -> None:
        members = self._groups[group]
        for met in list(members.values()):
            met(frozenset(members))

    def close(self) -> None:
        """Forgets the subscribers."""
        self._subscribers.clear()
        self._answers.clear()


class ZenohBus:
    """One Zenoh session in one world: the router's own (`listen`), or a client of the router at `endpoint`.

    Raises SaccadeError if the endpoint is in use (listen), malformed, or does not answer within `timeout_s` seconds,
    which are 10 unless SACCADE_ROUTER_S says otherwise.
    A router that goes away later is found again when it comes back. For an `onlooker` nobody waits: what it is too slow
    for it misses.
    """

    def __init__(self, endpoint: str, *, world: str, listen: bool = False, onlooker: bool = False,
                 timeout_s: float | None = None) -> None:
        import zenoh  # here, so that in-process runs do without it

        from saccade.shared.bus.session import open_session

        self._world = world
        self._zenoh = zenoh
        self._lock = threading.Lock()
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._subscribers: list[zenoh.Subscriber] = []
        self._queryables: list[zenoh.Queryable] = []
        self._tokens: list[zenoh.LivelinessToken] = []
        self._questions: queue.SimpleQueue[tuple[Topic, zenoh.Query] | None] = queue.SimpleQueue()
        self._closed = False
        self.endpoint = endpoint
        if not listen and endpoint.endswith(":0"):
            raise SaccadeError(f"bus at {endpoint}: port 0 is for the launcher only; name the port of a running bus")
        timeout_s = timeout_s or float(os.environ.get(ROUTER_WAIT_VARIABLE, ROUTER_S))
        self._session = open_session(endpoint, listen=listen, onlooker=onlooker, timeout_s=timeout_s)

    def publish(self, topic: Topic, part: str | None, payload: bytes) -> None:
        """Blocks while the network is congested: in lockstep a lost message would stop the world."""
        if topic.parts and not part:
            raise ValueError(f"{topic.name} is published with a part")
        key = topic.key(self._world, part)
        with self._lock:
            if self._closed:
                return
            publisher = self._publishers.get(key)
            if publisher is None:
                publisher = self._publishers[key] = self._session.declare_publisher(
                    key, congestion_control=self._zenoh.CongestionControl.BLOCK, express=True)
        try:
            publisher.put(payload)
        except self._zenoh.ZError:
            if not self._closed:  # another thread may close the session while this one publishes
                raise

    def subscribe(self, topics: Iterable[Topic] | None, deliver: Deliver) -> None:
        """One Zenoh subscriber per topic; for all topics one alone, so that their order of arrival is kept."""
        keys = [f"{ROOT}/{self._world}/**"] if topics is None else [t.key(self._world) for t in topics]

        def receive(sample: zenoh.Sample) -> None:
            # copies at once, so that shared memory is free again however slow the reader
            try:
                _, topic, part = parse_key(str(sample.key_expr))
            except SaccadeError:
                return
            deliver(topic, part, sample.payload.to_bytes())

        self._subscribers += [self._session.declare_subscriber(key, receive) for key in keys]

    def answer(self, topics: Iterable[Topic], answer: Answer) -> None:
        """Answers on a thread of its own: Zenoh's must not wait."""
        def ask(topic: Topic, query: zenoh.Query) -> None:
            self._questions.put((topic, query))

        self._queryables += [self._session.declare_queryable(topic.key(self._world), functools.partial(ask, topic))
                             for topic in topics]
        threading.Thread(target=self._answer_all, args=(answer,), name="answers", daemon=True).start()

    def _answer_all(self, answer: Answer) -> None:
        while (asked := self._questions.get()) is not None:
            topic, query = asked
            with contextlib.suppress(self._zenoh.ZError, ValueError, TypeError, KeyError):  # who asks is gone, or mad
                question: dict[str, Any] = {"since": None, "limit": 0}
                if query.payload:
                    question = json.loads(query.payload.to_bytes())
                since = None
                if question["since"]:
                    run, episode, step = question["since"]
                    since = str(run), int(episode), int(step)
                for kept in answer((topic,), since, int(question["limit"])):
                    query.reply(topic.key(self._world, kept.part), kept.payload,
                                attachment=str(kept.published_ns).encode())
            del asked, query  # a query ends when it is forgotten

    def recall(self, topics: Iterable[Topic], since: Since | None = None, limit_bytes: int = PAGE_BYTES) -> list[Kept]:
        """Asks one topic after the other; what does not begin like a message is left out."""
        question = json.dumps({"since": since, "limit": limit_bytes})
        return [kept for topic in topics for kept in self._recall(topic, question)]

    def _recall(self, topic: Topic, question: str) -> Iterable[Kept]:
        try:
            replies = self._session.get(topic.key(self._world), payload=question, timeout=RECALL_S,
                                        target=self._zenoh.QueryTarget.ALL,
                                        consolidation=self._zenoh.ConsolidationMode.NONE)
            for sample in (reply.ok for reply in replies):
                with contextlib.suppress(SaccadeError, MessageError, ValueError):
                    if sample is not None and sample.attachment is not None:
                        _, _, part = parse_key(str(sample.key_expr))
                        payload = sample.payload.to_bytes()
                        run, episode, step, _ = stamp_of(payload)
                        yield Kept(topic, part, payload, (run, episode, step), int(sample.attachment.to_bytes()))
        except self._zenoh.ZError:
            return  # no router at present

    def join(self, group: str, member: str, met: Met) -> None:
        """By liveliness: a process that was killed is gone within milliseconds, one that was stopped within seconds."""
        members: set[str] = set()
        key = f"{ROOT}/{self._world}/@members/{group}"

        def receive(sample: zenoh.Sample) -> None:
            name = str(sample.key_expr).rsplit("/", 1)[-1]
            (members.add if sample.kind == self._zenoh.SampleKind.PUT else members.discard)(name)
            met(frozenset(members))

        liveliness = self._session.liveliness()
        self._tokens.append(liveliness.declare_token(f"{key}/{member}"))
        self._subscribers.append(liveliness.declare_subscriber(f"{key}/*", receive, history=True))

    def close(self) -> None:
        """Undeclares before it closes: a callback left behind can keep a process from ending."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        self._questions.put(None)
        entities: tuple[zenoh.Subscriber | zenoh.LivelinessToken | zenoh.Queryable | zenoh.Publisher, ...] = (
            *self._subscribers, *self._tokens, *self._queryables, *self._publishers.values())
        for entity in entities:
            entity.undeclare()
        with contextlib.suppress(self._zenoh.ZError):  # someone it was connected to is suspended: not waited for
            self._session.close()


def free_endpoint(endpoint: str) -> str:
    """The endpoint with port 0 replaced by a port that is free now."""
    match = re.fullmatch(r"(\w+)/(\[[0-9a-fA-F:]+\]|[^\[\]:]+):0", endpoint)
    if match is None:
        return endpoint
    host = match[2].strip("[]")
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.bind((host, 0))
            return f"{match[1]}/{match[2]}:{probe.getsockname()[1]}"
    except OSError as error:
        raise SaccadeError(f"bus at {endpoint}: cannot listen there: {error.strerror or error}") from error
