"""The bus, which carries encoded messages by topic and part. `ZenohBus` connects processes; `LocalBus` works within one
process.

Every endpoint is given by its address. The bus never searches the network for others, and it listens only at the given
address.
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
from typing import TYPE_CHECKING, Protocol

from saccade.shared.bus.outbox import KEPT_BYTES, PAGE_BYTES, Kept, Since
from saccade.shared.bus.topics import ROOT, Topic, parse_key
from saccade.shared.bus.wire import MessageError, stamp_of
from saccade.shared.errors import SaccadeError
from saccade.shared.files import parse_json

if TYPE_CHECKING:
    import zenoh

Deliver = Callable[[Topic, str | None, bytes], None]  # runs on the bus's thread, so it may only store its arguments
Answer = Callable[[Iterable[Topic], Since | None, int], list[Kept]]
Met = Callable[[frozenset[str]], None]

ROUTER_WAIT_VARIABLE, ROUTER_S = "SACCADE_ROUTER_S", 10.0
MAX_QUESTION_BYTES, MOST_QUESTIONS = 16 * 1024, 1000  # of one question; and how many wait for their answer
RECALL_S = 3.0  # a whole answer must come within this time, so that a publisher that hangs does not block others


class Bus(Protocol):
    """Carries encoded messages between services. Messages of one key arrive in the order in which they were published.

    A message can be lost while a process or the router is away. Its publisher still keeps it for a while, and `recall`
    asks for it.
    """

    def publish(self, topic: Topic, part: str | None, payload: bytes) -> None:
        """Sends an encoded message to all subscribers."""

    def subscribe(self, topics: Iterable[Topic] | None, deliver: Deliver) -> None:
        """Calls `deliver(topic, part, payload)` for every message of these topics, or of all topics if `topics` is
        None."""

    def answer(self, topics: Iterable[Topic], answer: Answer) -> None:
        """Calls `answer(topics, since, limit_bytes)` when others ask what was published on these topics, and sends them
        the result."""

    def recall(self, topics: Iterable[Topic], since: Since | None = None, limit_bytes: int = PAGE_BYTES) -> list[Kept]:
        """Asks the publishers of these topics for the messages that they keep, and returns them.

        With `since` (run, episode, step) these are the messages from this step on, without it those of each publisher's
        newest episode. The messages of one publisher are in their order, and take at most about `limit_bytes`. The list
        is empty if nobody answers.
        """

    def join(self, group: str, member: str, met: Met) -> None:
        """Joins a group until `close`. Calls `met(members)` at once, and again whenever a member comes or goes, even if
        it was killed."""

    def close(self) -> None:
        """Leaves the bus. It may be called twice."""


class LocalBus:
    """The bus within one process. `publish` returns when every subscriber has the bytes."""

    def __init__(self) -> None:
        self._subscribers: list[tuple[frozenset[str] | None, Deliver]] = []
        self._answers: list[tuple[frozenset[str], Answer]] = []
        self._groups: dict[str, dict[str, Met]] = {}

    def publish(self, topic: Topic, part: str | None, payload: bytes) -> None:
        """Delivers at once, on the thread of the caller."""
        for names, deliver in list(self._subscribers):
            if names is None or topic.name in names:
                deliver(topic, part, payload)

    def subscribe(self, topics: Iterable[Topic] | None, deliver: Deliver) -> None:
        """Subscribes from now on. Messages that were published before are not repeated."""
        self._subscribers.append((None if topics is None else frozenset(t.name for t in topics), deliver))

    def answer(self, topics: Iterable[Topic], answer: Answer) -> None:
        """Answers questions from now on."""
        self._answers.append((frozenset(t.name for t in topics), answer))

    def recall(self, topics: Iterable[Topic], since: Since | None = None, limit_bytes: int = PAGE_BYTES) -> list[Kept]:
        """Asks at once, on the thread of the caller."""
        topics = tuple(topics)
        return [kept for names, answer in list(self._answers)
                if (asked := [t for t in topics if t.name in names]) for kept in answer(asked, since, limit_bytes)]

    def join(self, group: str, member: str, met: Met) -> None:
        """Joins the group and tells all its members, on the thread of the caller."""
        self._groups.setdefault(group, {})[member] = met
        self._tell(group)

    def members(self, group: str) -> frozenset[str]:
        """The present members of a group."""
        return frozenset(self._groups.get(group, ()))

    def leave(self, group: str, member: str) -> None:
        """Removes a member from a group. On a real bus this happens when its process ends."""
        del self._groups[group][member]
        self._tell(group)

    def _tell(self, group: str) -> None:
        members = self._groups[group]
        for met in list(members.values()):
            met(frozenset(members))

    def close(self) -> None:
        """Forgets all subscribers and answers."""
        self._subscribers.clear()
        self._answers.clear()


class ZenohBus:
    """One Zenoh session in one world. With `listen` it is the router's session, otherwise a client of the router at
    `endpoint`.

    If the router goes away, the client finds it again when it comes back. Nobody waits for an `onlooker`: it misses the
    messages for which it is too slow. Raises SaccadeError if the endpoint is in use (`listen`) or malformed, if a
    client is given port 0, or if the router does not answer within `timeout_s` seconds. The default is 10 seconds, or
    the value of SACCADE_ROUTER_S.
    """

    def __init__(self, endpoint: str, *, world: str, listen: bool = False, onlooker: bool = False,
                 timeout_s: float | None = None) -> None:
        import zenoh  # here, so that a run within one process does not need it

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
        """Sends an encoded message. It blocks while the network is congested, because in lockstep a lost message would
        stop the run. Raises ValueError if the topic has parts and `part` is missing."""
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
        """Declares one Zenoh subscriber for each topic. For all topics it declares a single one, so that the order of
        arrival is kept."""
        keys = [f"{ROOT}/{self._world}/**"] if topics is None else [t.key(self._world) for t in topics]

        def receive(sample: zenoh.Sample) -> None:
            # the bytes are copied at once, so that a slow reader does not keep the shared memory in use
            try:
                _, topic, part = parse_key(str(sample.key_expr))
            except SaccadeError:
                return
            deliver(topic, part, sample.payload.to_bytes())

        self._subscribers += [self._session.declare_subscriber(key, receive) for key in keys]

    def answer(self, topics: Iterable[Topic], answer: Answer) -> None:
        """Answers on a thread of its own, because Zenoh's thread must not wait."""
        def ask(topic: Topic, query: zenoh.Query) -> None:
            if self._questions.qsize() < MOST_QUESTIONS:  # what is beyond gets an empty answer, and is asked again
                self._questions.put((topic, query))

        self._queryables += [self._session.declare_queryable(topic.key(self._world), functools.partial(ask, topic))
                             for topic in topics]
        threading.Thread(target=self._answer_all, args=(answer,), name="answers", daemon=True).start()

    def _answer_all(self, answer: Answer) -> None:
        while (asked := self._questions.get()) is not None:
            topic, query = asked
            # The service that asked may be gone, or its question may be anything. The next one must be answered.
            with contextlib.suppress(Exception):
                since, limit_bytes = _asked(query.payload.to_bytes() if query.payload else b"")
                for kept in answer((topic,), since, limit_bytes):
                    query.reply(topic.key(self._world, kept.part), kept.payload,
                                attachment=str(kept.published_ns).encode())
            del asked, query  # Zenoh ends a query when its object is deleted

    def recall(self, topics: Iterable[Topic], since: Since | None = None, limit_bytes: int = PAGE_BYTES) -> list[Kept]:
        """Asks for one topic after the other. An answer that does not begin like a message is left out."""
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
            return  # there is no router at present

    def join(self, group: str, member: str, met: Met) -> None:
        """Joins by a liveliness token of Zenoh. The others notice within milliseconds that a process was killed, and
        within seconds that it was suspended."""
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
        """Undeclares everything before it closes the session, because a callback that is left can keep a process from
        ending."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        self._questions.put(None)
        entities: tuple[zenoh.Subscriber | zenoh.LivelinessToken | zenoh.Queryable | zenoh.Publisher, ...] = (
            *self._subscribers, *self._tokens, *self._queryables, *self._publishers.values())
        for entity in entities:
            entity.undeclare()
        with contextlib.suppress(self._zenoh.ZError):  # the other side is suspended; nobody waits for it
            self._session.close()


def _asked(payload: bytes) -> tuple[Since | None, int]:
    """Returns what a question asks for: since when, and how many bytes at most. Raises ValueError, TypeError or
    KeyError if it is not a question."""
    if not payload:
        return None, 0
    if len(payload) > MAX_QUESTION_BYTES:
        raise ValueError(f"a question of {len(payload)} bytes")
    question = parse_json(payload.decode())
    limit_bytes, since = question["limit"], question["since"]
    if type(limit_bytes) is not int:
        raise ValueError("its limit is not a whole number")
    limit_bytes = min(max(limit_bytes, 0), KEPT_BYTES)
    if since is None:
        return None, limit_bytes
    run, episode, step = since
    if [type(value) for value in since] != [str, int, int]:
        raise ValueError("it does not say since when")
    return (run, episode, step), limit_bytes


def free_endpoint(endpoint: str) -> str:
    """Returns the endpoint, with port 0 replaced by a port that is free now. Raises SaccadeError if nothing can listen
    at this address."""
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
