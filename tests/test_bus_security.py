"""A bus between two hosts, here two network namespaces: mutual TLS, passwords, and who may say and hear what."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest

from saccade.app.log.check import missing
from saccade.deploy.zenoh.access import access_control, declared, users
from saccade.deploy.zenoh.make import make
from saccade.shared.bus.topics import TOPICS
from saccade.shared.errors import SaccadeError

ADDRESS, OTHER = "10.199.7.1", "10.199.7.2"
ENDPOINT = f"tls/{ADDRESS}:7447"
SAY = """
import sys, time
from saccade.shared.bus.transport import ZenohBus
from saccade.shared.bus.topics import TOPICS
bus = ZenohBus(sys.argv[1], world="table", timeout_s=3)
time.sleep(0.5)
bus.publish(TOPICS[sys.argv[2]], None, sys.argv[3].encode())
time.sleep(0.5)
bus.close()
"""
HEAR = """
import sys, time
from saccade.shared.bus.transport import ZenohBus
from saccade.shared.bus.topics import TOPICS
bus = ZenohBus(sys.argv[1], world="table", timeout_s=3)
bus.subscribe([TOPICS[sys.argv[2]]], lambda topic, part, payload: print("heard", payload.decode(), flush=True))
print("listens", flush=True)
time.sleep(60)
"""
EVERYTHING = """
import json, sys, time
from pathlib import Path
from saccade.shared.bus.outbox import Kept
from saccade.shared.bus.topics import TOPICS
from saccade.shared.bus.transport import ZenohBus
from saccade.shared.bus.wire import encode
from saccade.tests.samples import sample
endpoint, me, everyone, folder = sys.argv[1], sys.argv[2], sys.argv[3].split(), Path(sys.argv[4])
bus, told, answered, met = ZenohBus(endpoint, world="table", timeout_s=10), set(), set(), {}
def payload(topic):
    return encode(sample(topic.type, run=me))
def parts(topic):
    return everyone if topic.name == "status" else ["mug"] if topic.parts else [None]
def take(topic, part, payload):
    told.add((topic.name, part, payload.decode("latin1").split("run")[1][1:].split(chr(0xa7))[0]))
def meet(name):
    return lambda members: met.update({name: sorted(members)})
for topic in TOPICS.values():
    bus.subscribe([topic], take)
bus.subscribe(None, take)
bus.answer(TOPICS.values(), lambda topics, since, limit: [
    Kept(topic, part, payload(topic), (me, 0, 0), 1) for topic in topics for part in parts(topic)])
for name in everyone:
    bus.join(name, me, meet(name))
def together(word):
    (folder / f"{me} {word}").touch()
    while len(list(folder.glob(f"* {word}"))) < len(everyone):
        time.sleep(0.1)
    time.sleep(1.0)
together("is there")
for topic in TOPICS.values():
    for part in parts(topic):
        bus.publish(topic, part, payload(topic))
for kept in bus.recall(TOPICS.values()):
    answered.add((kept.topic.name, kept.part, kept.at[0]))
together("has spoken")
said = json.dumps({"told": list(told), "answered": list(answered), "met": met})  # as long as everyone is there
together("is done")
print(said)
bus.close()
"""
# What is meant, written down once more: who publishes what beside its own status, and who reads what
SAYS = {"simulator": {"frame", "goal", "truth"}, "camera": {"frame", "goal"}, "perception": {"percept", "goal_percept"},
        "belief": {"belief", "events"}, "planner": {"plan", "action"}, "evaluator": {"result"}, "recorder": set(),
        "director": set(), "viewer": set()}
SEEN = {"frame", "goal", "percept", "belief", "events", "plan", "truth", "result", "status"}
HEARS = {"simulator": {"action", "result", "status"}, "camera": {"action", "status"},
         "perception": {"frame", "goal", "percept", "goal_percept"}, "belief": {"percept", "goal_percept", "goal"},
         "planner": {"belief", "goal_percept", "goal"}, "evaluator": {"truth"}, "recorder": set(TOPICS), "viewer": SEEN,
         "director": {"frame", "truth", "plan", "belief", "status", "result"}}
ROUTER = """
import sys, time
from saccade.shared.bus.transport import ZenohBus
bus = ZenohBus(sys.argv[1], world="table", listen=True)
print("listens", flush=True)
time.sleep(300)
"""


def ip(*arguments: str, check: bool = True) -> bool:
    return subprocess.run(["ip", *arguments], check=check, capture_output=True).returncode == 0


class Hosts:
    """Two of them with a cable, and the files of `saccade.deploy.zenoh.make`."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.names = folder, (f"saccade-a-{os.getpid()}", f"saccade-b-{os.getpid()}")
        self.processes: list[subprocess.Popen] = []

    def start(self, host: int, user: str | Path | None, *command: str, out: int | IO = subprocess.PIPE,
              **environment: str) -> subprocess.Popen:
        """A process on host 0 or 1 as that user: a name, another configuration, or nobody."""
        file = self.folder / f"{user}.json5" if isinstance(user, str) else user
        environment = {**os.environ, **environment}
        if file:
            environment["ZENOH_CONFIG"] = str(file)
        process = subprocess.Popen(["ip", "netns", "exec", self.names[host], sys.executable, *command], text=True,
                                   env=environment, stdout=out, stderr=subprocess.STDOUT)
        self.processes.append(process)
        return process

    def hear(self, host: int, user: str, topic: str) -> subprocess.Popen:
        listener = self.start(host, user, "-c", HEAR, ENDPOINT, topic)
        assert "listens" in listener.stdout.readline()
        return listener

    def say(self, host: int, user: str | Path | None, topic: str, text: str) -> str:
        return self.start(host, user, "-c", SAY, ENDPOINT, topic, text).communicate(timeout=30)[0]


@pytest.fixture
def hosts(tmp_path) -> Iterator[Hosts]:
    hosts = Hosts(tmp_path / "bus")
    a, b = hosts.names
    if os.geteuid() != 0 or not ip("netns", "add", a, check=False):
        pytest.skip("network namespaces need root: the two hosts are not tested here")
    with contextlib.ExitStack() as stack:
        stack.callback(ip, "netns", "del", a)
        ip("netns", "add", b)
        stack.callback(ip, "netns", "del", b)
        ip("link", "add", "cable", "netns", a, "type", "veth", "peer", "name", "cable", "netns", b)
        for name, address in ((a, ADDRESS), (b, OTHER)):
            ip("-n", name, "address", "add", f"{address}/24", "dev", "cable")
            ip("-n", name, "link", "set", "cable", "up")
            ip("-n", name, "link", "set", "lo", "up")
        make(hosts.folder, [ADDRESS])
        yield hosts
        for process in hosts.processes:
            process.kill()
            process.wait()


def heard(listener: subprocess.Popen) -> list[str]:
    listener.kill()
    return listener.communicate()[0].split()[1::2]


def test_only_who_is_known_gets_in_and_says_only_what_it_may(hosts, tmp_path):
    assert "listens" in hosts.start(0, "router", "-c", ROUTER, ENDPOINT).stdout.readline()
    simulator, evaluator = hosts.hear(0, "simulator", "action"), hosts.hear(1, "evaluator", "truth")
    curious = hosts.hear(1, "planner", "truth")
    refused = hosts.say(1, None, "action", "nobody")
    assert "does not let this one in" in refused
    wrong = json.loads((hosts.folder / "planner.json5").read_text())
    wrong["transport"]["auth"]["usrpwd"]["password"] = "wrong"
    (tmp_path / "wrong.json5").write_text(json.dumps(wrong))
    assert "does not let this one in" in hosts.say(1, tmp_path / "wrong.json5", "action", "wrong-password")
    make(tmp_path / "others", [ADDRESS])
    strange = json.loads((hosts.folder / "planner.json5").read_text())
    strange["transport"]["link"] = json.loads((tmp_path / "others" / "planner.json5").read_text())["transport"]["link"]
    strange["transport"]["link"]["tls"]["root_ca_certificate"] = str(hosts.folder / "authority.pem")
    (tmp_path / "strange.json5").write_text(json.dumps(strange))
    assert "does not let this one in" in hosts.say(1, tmp_path / "strange.json5", "action", "strange-certificate")
    assert hosts.say(1, "belief", "action", "belief-is-no-planner") == ""
    assert hosts.say(1, "planner", "action", "planner") == ""
    assert hosts.say(0, "simulator", "truth", "simulator") == ""
    assert hosts.say(1, "planner", "truth", "planner-is-no-simulator") == ""
    assert heard(simulator) == ["planner"]
    assert heard(evaluator) == ["simulator"]
    assert heard(curious) == []


def test_a_valid_user_is_heard_and_told_no_more_than_its_service_declares(hosts, tmp_path):
    """Every user publishes every message of everybody, answers every question, subscribes to and asks for all there is,
    and joins every group: with its own password and certificate, on either host."""
    assert "listens" in hosts.start(0, "router", "-c", ROUTER, ENDPOINT).stdout.readline()
    assert set(SAYS) == set(HEARS) == set(users())
    members = {user: user for user in users()} | {"perception-2": "perception"}
    (tmp_path / "meet").mkdir()
    started = {me: hosts.start(k % 2, user, "-c", EVERYTHING, ENDPOINT, me, " ".join(members), str(tmp_path / "meet"))
               for k, (me, user) in enumerate(members.items())}
    said = {me: process.communicate(timeout=120)[0] for me, process in started.items()}
    found = {me: json.loads(text.splitlines()[-1]) for me, text in said.items()}
    for me, user in members.items():
        others = {other: who for other, who in members.items() if other != me}
        wanted = {(topic, "mug" if TOPICS[topic].parts else None, other)
                  for other, who in others.items() for topic in SAYS[who] & HEARS[user]}
        statuses = {("status", who, other) for other, who in others.items() if "status" in HEARS[user]}
        for way, known in (("told", wanted | statuses), ("answered", wanted)):  # nobody is asked for old statuses
            # its own it hears without the router
            assert {(topic, part, by) for topic, part, by in found[me][way] if by != me} == known, (me, way)
        assert {name: set(there) - {me} for name, there in found[me]["met"].items()} == {
            name: {other for other, who in others.items() if who == user == name} for name in members}, me


def test_a_password_alone_and_a_certificate_alone_are_nobodys(hosts, tmp_path):
    """A valid user with the password of another, or with the certificate of another."""
    assert "listens" in hosts.start(0, "router", "-c", ROUTER, ENDPOINT).stdout.readline()
    simulator = hosts.hear(0, "simulator", "action")
    planner, belief = (json.loads((hosts.folder / f"{user}.json5").read_text())["transport"]
                       for user in ("planner", "belief"))
    for name, link, auth in (("password", belief["link"], planner["auth"]),
                             ("certificate", planner["link"], belief["auth"])):
        (tmp_path / f"{name}.json5").write_text(json.dumps({"transport": {"link": link, "auth": auth}}))
        hosts.say(1, tmp_path / f"{name}.json5", "action", f"stolen-{name}")
    assert hosts.say(1, "planner", "action", "planner") == ""
    assert heard(simulator) == ["planner"]


def test_an_agent_runs_across_two_hosts(hosts, tmp_path):
    here, there = ("router", "simulator", "evaluator", "recorder", "viewer"), ("perception", "belief", "planner")
    runs = {"SACCADE_RUNS": str(tmp_path / "runs"), "SACCADE_WAIT": "1", "SACCADE_VIEW_S": "0"}
    for host, names in enumerate((here, there)):
        for name in names:
            with (tmp_path / f"{name}.log").open("w") as log:
                hosts.start(host, name, "-m", "saccade.deploy.container", name, out=log,
                            SACCADE_HEARTBEATS=str(tmp_path / name), **runs)
    director = hosts.start(0, "director", "-m", "saccade.deploy.director", f"--endpoint={ENDPOINT}", "--seed=3",
                           SACCADE_HEARTBEATS=str(tmp_path / "director"), **runs)
    said = director.communicate(timeout=240)[0]
    assert "reached the goal in" in said, said + "".join(path.read_text() for path in tmp_path.glob("*.log"))
    ends = {" ".join(map(str, p.args[6:])): p.wait(timeout=60) for p in hosts.processes[:-1]}
    assert set(ends.values()) == {0}, ends
    report = missing(tmp_path / "runs" / "latest" / "run.mcap")
    assert report.complete, list(report.lines())


def test_access_follows_the_declarations():
    rules = {rule["id"]: rule["key_exprs"] for rule in access_control()["rules"]}
    assert [user for user in users() if "saccade/*/action" in rules[f"{user} says"]] == ["planner"]
    readers = {user for user in users() if {"saccade/*/truth", "saccade/**"} & set(rules[f"{user} asks"])}
    assert readers == {"evaluator", "recorder", "director", "viewer"}
    assert set(declared()) == {"belief", "camera", "evaluator", "perception", "planner", "simulator"}


def test_a_configuration_that_is_none_is_told(tmp_path):
    (tmp_path / "z.json5").write_text("{")
    done = subprocess.run([sys.executable, "-c", SAY, "tcp/127.0.0.1:1", "action", "x"], text=True, capture_output=True,
                          env={**os.environ, "ZENOH_CONFIG": str(tmp_path / "z.json5")})
    assert f"ZENOH_CONFIG={tmp_path / 'z.json5'}: no configuration of Zenoh's" in done.stderr


def test_the_files_are_for_their_owner_from_the_moment_they_exist(tmp_path, monkeypatch):
    """With a umask that forbids nothing. No mode is changed afterwards, so each is the one at the file's creation."""
    def changed(*_: object, **__: object) -> None:
        raise AssertionError("a mode is changed after the creation")

    (tmp_path / "bin").mkdir()
    program = tmp_path / "bin" / "openssl"  # the real one, then the modes of what lies there as it ends
    program.write_text(f'#!/bin/sh\n{shutil.which("openssl")} "$@" || exit\n'
                       f'stat -c "%a %n" {tmp_path / "bus"}/* >> {tmp_path / "modes"}\n')
    program.chmod(0o755)
    for name in ("chmod", "fchmod", "lchmod"):
        monkeypatch.setattr(os, name, changed, raising=False)
    monkeypatch.setenv("PATH", str(program.parent), prepend=os.pathsep)
    before = os.umask(0)
    try:
        make(tmp_path / "bus", [ADDRESS])
    finally:
        os.umask(before)
    assert (tmp_path / "bus").stat().st_mode & 0o777 == 0o700
    files = list((tmp_path / "bus").iterdir())
    assert {f"{name}.key" for name in (*users(), "router", "authority")} <= {file.name for file in files}
    assert [file.name for file in files if file.stat().st_mode & 0o777 != 0o600] == []
    assert {line.split()[0] for line in (tmp_path / "modes").read_text().splitlines()} == {"600"}


def test_the_files_are_made_once(tmp_path):
    make(tmp_path / "bus", ["router.example", ADDRESS])
    with pytest.raises(SaccadeError, match=r"bus cannot be made .*: name a new folder"):
        make(tmp_path / "bus", [ADDRESS])
    passwords = dict(line.split(":") for line in (tmp_path / "bus" / "users.txt").read_text().split())
    assert set(passwords) == set(users())
    assert len(set(passwords.values())) == len(passwords)
    text = subprocess.run(["openssl", "x509", "-in", tmp_path / "bus" / "router.pem", "-noout", "-ext",
                           "subjectAltName"], capture_output=True, text=True, check=True).stdout
    assert "DNS:router.example" in text
    assert f"IP Address:{ADDRESS}" in text
