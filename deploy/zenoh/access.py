"""Zenoh's access control: which service may publish and read which topic. It is derived from the services'
declarations."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from saccade.app.run.registry import AGENTS, WORLDS, service_of
from saccade.services.viewer import SHOWN
from saccade.shared.bus.topics import BELIEF, FRAME, PLAN, RESULT, ROOT, STATUS, TRUTH, Topic
from saccade.shared.loop.service import Service

SAID = ["put", "reply"]  # messages of a service that publishes a topic
ASKED = ["query"]  # messages of a service that reads it
SUBSCRIBED, ANSWERABLE = ["declare_subscriber"], ["declare_queryable"]
ANY = [f"{ROOT}/**"]
MET = ["liveliness_token", "liveliness_query", "declare_liveliness_subscriber"]
READERS: dict[str, tuple[Topic, ...] | None] = {  # have no declaration; None means every topic
    "recorder": None,
    "director": (TRUTH, FRAME, PLAN, BELIEF, STATUS, RESULT),  # the frame where a camera knows no truth
    "viewer": SHOWN,
}


def declared() -> dict[str, Service]:
    """The declarations, by name, of all services of all agents and worlds that are processes of their own."""
    names = {name for agent in AGENTS.values() for name in agent.services}
    names |= {name for world in WORLDS.values() for name in (world.source, *world.judges)}
    return {name: service_of(name) for name in sorted(names)}


def users() -> list[str]:
    """The names of all who are on the bus, as the router knows them."""
    return sorted({*declared(), *READERS})


def access_control() -> dict[str, Any]:
    """The section `access_control` of the router's configuration. What is not declared is denied."""
    rules, policies = [], []
    for user in users():
        of_user = list(_rules(user))
        rules += of_user
        policies.append({"rules": [rule["id"] for rule in of_user], "subjects": [user]})
    return {"enabled": True, "default_permission": "deny", "rules": rules, "policies": policies,
            "subjects": [{"id": user, "usernames": [user], "cert_common_names": [user]} for user in users()]}


def _rules(user: str) -> Iterable[dict[str, Any]]:
    service = declared().get(user)
    says = [f"{ROOT}/*/{STATUS.name}/{user}", *(_key(topic) for topic in (service.outputs if service else ()))]
    read = _inputs(service) if service else READERS[user]
    hears = ANY if read is None else [_key(topic) for topic in read]

    def rule(what: str, messages: list[str], flow: str, keys: list[str]) -> dict[str, Any]:
        return {"id": f"{user} {what}", "messages": messages, "flows": [flow], "permission": "allow", "key_exprs": keys}

    yield rule("says", SAID + ANSWERABLE, "ingress", says)
    yield rule("is asked", ASKED, "egress", says)
    yield rule("asks", ASKED + SUBSCRIBED, "ingress", hears)
    yield rule("is told", SAID, "egress", hears)
    # Tells a user that another one listens or could answer, perhaps on more keys than its own. Without this Zenoh sends
    # nothing.
    yield rule("knows who is there", SUBSCRIBED + ANSWERABLE, "egress", ANY)
    members = [f"{ROOT}/*/@members/{user}/*"]
    yield rule("meets", MET, "ingress", members)
    yield rule("is met", MET, "egress", members)


def _inputs(service: Service) -> tuple[Topic, ...]:
    """What the main loop subscribes to and asks for. Only a source reads statuses, because only a source waits."""
    closed = (service.closed_by,) if service.closed_by else ()
    statuses = (STATUS,) if service.name in {world.source for world in WORLDS.values()} else ()
    return (*service.inputs, *closed, *statuses, *(service.outputs if service.divisible else ()))


def _key(topic: Topic) -> str:
    return topic.key("*")
