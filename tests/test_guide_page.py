"""The page that guides a hand: what it says, and whom it answers."""

from __future__ import annotations

import http.client
import io
import json
import socket
from contextlib import closing

import numpy as np
import pytest
from PIL import Image

from saccade.app.run.registry import agent_processes
from saccade.app.run.run import to_be_guided
from saccade.services.guide.core import Guide
from saccade.services.guide.live import listen
from saccade.services.guide.server import MOST, PageServer
from saccade.services.viewer.server import free_port, guide_url_of
from saccade.shared.bus.messages import Action, Belief, Frame, Goal, Plan
from saccade.shared.bus.topics import FRAME, GOAL, PLAN
from saccade.shared.bus.transport import LocalBus
from saccade.shared.bus.wire import encode
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.process import Health, Inbox
from saccade.shared.world.geometry import INTRINSICS_PX, look_at, pose
from saccade.tests.samples import sample

CAMERA = look_at((0.4, 0.0, 0.3), (0.0, 0.0, 0.05))
AT = {"run": "r", "episode": 0}
WAIT_S = 20  # for what must come


def frame(step=0, run="r") -> Frame:
    return Frame(run=run, episode=0, step=step, rgb=np.full((480, 480, 3), 90, np.uint8),
                 intrinsics_px=np.array(INTRINSICS_PX), world_from_camera=CAMERA)


def plan(by=(0.0, 0.1, 0.0), step=0, arrived=False) -> Plan:
    return sample(Plan, **AT, step=step, viewpoint=pose(CAMERA[:3, :3], CAMERA[:3, 3] + by), target="can", mode="goal",
                  look_at_m=np.array([0.0, 0.0, 0.05]), arrived=arrived)


def guide_with(*messages) -> Guide:
    guide = Guide({"can": np.array([0.07, 0.07, 0.1])})
    for message in messages:
        guide.take(message)
    return guide


def told(*messages) -> dict:
    return json.loads(guide_with(*messages).state())


def test_it_says_where_to_go_and_draws_it():
    can = sample(Belief, **AT, object="can", presence=0.9, mean_m=np.array([0.0, 0.0, 0.05]))
    state = told(frame(), plan((0.0, 0.08, 0.0)), can)
    assert (state["state"], state["words"], state["distance_m"], state["turn_deg"]) == (
        "move", "move 8 cm to the right", 0.08, 0.0)
    assert (len(state["arrow"]), len(state["frame"]), state["outlines"][0]["name"]) == (7, 4, "can")
    assert told(frame(), plan(arrived=True))["words"] == "you are there"


def test_before_there_is_a_plan_it_waits():
    assert told()["step"] == -1
    assert (told(frame(3))["state"], told(frame(3))["step"]) == ("wait", 3)


def test_the_arrow_goes_around_with_the_action():
    around = sample(Action, **AT, step=0, translation_m=np.array([0.0, 0.0, 0.05]))
    assert told(frame(), plan((0, 0.3, 0)), around)["words"].startswith("move 30 cm up")


def test_what_is_old_is_ignored_and_a_new_episode_forgets():
    newer = sample(Goal, run="r", episode=1, step=0, rgb=None)
    assert told(frame(5), frame(4))["step"] == 5
    assert told(frame(5), newer)["step"] == -1
    assert told(newer, frame(5))["step"] == -1


def configured(**values) -> Config:
    return Config().with_values({"viewer.guide_port": free_port("127.0.0.1")} | values)


@pytest.fixture
def server():
    goal = sample(Goal, **AT, step=0, rgb=np.zeros((8, 8, 3), np.uint8))
    with closing(PageServer(configured().viewer, guide_with(frame(), plan(), goal))) as server:
        yield server


def asked(server, path, method="GET", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=WAIT_S)
    connection.request(method, path, headers={"Host": f"localhost:{server.port}"} | headers)
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.status, content, answer.headers


def test_a_browser_gets_the_page_the_state_and_the_images(server):
    status, page, headers = asked(server, "/")
    assert status == 200
    assert b"state.json" in page
    assert b"http:" not in page  # nothing is loaded from elsewhere
    assert b"https:" not in page
    assert headers["Content-Security-Policy"].startswith("default-src 'none'")
    assert json.loads(asked(server, "/state.json")[1])["state"] == "move"
    assert Image.open(io.BytesIO(asked(server, "/image.jpg?7")[1])).size == (480, 480)
    assert Image.open(io.BytesIO(asked(server, "/goal.jpg")[1])).size == (8, 8)
    assert asked(server, "/", method="HEAD")[1] == b""


@pytest.mark.parametrize(("path", "method", "headers", "status"), [
    ("/", "GET", {"Host": "evil.example"}, 403), ("/state.json", "GET", {"Origin": "http://evil.example"}, 403),
    ("/", "POST", {}, 405), ("/../core.py", "GET", {}, 404), ("/other", "GET", {}, 404)])
def test_others_get_nothing(server, path, method, headers, status):
    assert asked(server, path, method, **headers)[0] == status


def test_opened_to_other_hosts_it_asks_for_the_token():
    config = to_be_guided(configured(**{"viewer.address": "0.0.0.0"}))
    token = config.viewer.token
    assert token in guide_url_of(config.viewer)
    with closing(PageServer(config.viewer, guide_with(frame()))) as server:
        assert asked(server, "/state.json")[0] == 403
        status, _, headers = asked(server, f"/?token={token}")
        assert (status, headers["Location"]) == (302, "/")
        assert asked(server, "/state.json", Cookie=headers["Set-Cookie"].partition(";")[0])[0] == 200


def test_guests_are_limited(server):
    """Those that say nothing take a place for a while only, and more are turned away at once."""
    silent = [socket.create_connection(("127.0.0.1", server.port), timeout=WAIT_S) for _ in range(MOST)]
    late = socket.create_connection(("127.0.0.1", server.port), timeout=WAIT_S)
    assert late.recv(1) == b""
    for guest in (*silent, late):
        guest.close()


def test_a_port_in_use_is_told(server):
    with pytest.raises(SaccadeError, match=r"guide: port \d+ of 127.0.0.1 cannot be opened .*viewer.guide_port"):
        PageServer(configured(**{"viewer.guide_port": server.port}).viewer, guide_with())


def test_it_hears_its_own_run_and_ignores_what_is_no_message():
    bus, inbox, guide, health = LocalBus(), Inbox(), guide_with(), Health("guide", at=("r", 0, 0))
    for topic, payload in ((FRAME, encode(frame(2))), (FRAME, encode(frame(9, run="other"))), (PLAN, b"no message"),
                           (GOAL, encode(sample(Goal, **AT, step=0, rgb=None)))):
        inbox.put(topic, None, payload)
    inbox.put(PLAN, None, encode(plan(step=2)))
    take = guide.take

    def take_and_stop(message):
        take(message)
        if isinstance(message, Plan):
            inbox.stop()

    guide.take = take_and_stop
    listen(bus, guide, inbox, health)
    state = json.loads(guide.state())
    assert (state["step"], state["words"], health.at) == (2, "move 10 cm to the right", ("r", 0, 2))


def test_a_run_with_a_page_has_one_more_onlooker():
    more = set(agent_processes("sceneccn", "camera", guide=True)) - set(agent_processes("sceneccn", "camera"))
    assert [(process.name, process.onlooker) for process in more] == [("guide", True)]
    with pytest.raises(SaccadeError, match="--guide is for services on the bus"):
        to_be_guided(configured(**{"bus.kind": "local"}))
