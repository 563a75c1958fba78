"""The viewer's page in a real browser: headless Chromium, drawing in software."""

from __future__ import annotations

import io
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
import rerun as rr
from PIL import Image
from playwright.sync_api import sync_playwright

from saccade.services.viewer.live import connected
from saccade.services.viewer.server import Server, binary, free_port, listens
from saccade.shared.config import PACKAGE
from saccade.tests.fixtures.make import GOLDEN
from saccade.tests.test_viewer import Seen
from saccade.tests.test_viewer_door import READ
from saccade.tests.test_viewer_server import configured

ARTEFACTS = PACKAGE / "artefacts"
WAIT_S = 300
FLAGS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader",
         "--host-resolver-rules=MAP *.example 127.0.0.1")  # as the owner of such a name could have it
SIZE = {"width": 1400, "height": 860}
# left, top, right and bottom of what the layout puts there, as shares of the page
PLACES = {"world": (0.02, 0.10, 0.48, 0.75), "camera": (0.51, 0.09, 0.66, 0.32), "goal": (0.68, 0.09, 0.82, 0.32),
          "crops": (0.55, 0.37, 0.95, 0.50), "distance": (0.52, 0.56, 0.74, 0.72), "entropy": (0.78, 0.56, 0.98, 0.72),
          "decisions": (0.02, 0.85, 0.45, 0.95)}
TITLES = (0.0, 0.05, 1.0, 0.065)  # where a view that cannot be drawn has a red sign
ENTITIES = ("/world/path", "/world/candidates", "/world/viewpoint/imagined", "/world/true", "/goal/image", "/F", "/G",
            "/entropy", "/presence", "/distance/true", "/decisions", "/milliseconds/perception")
MOVES = ("world", "camera", "distance", "decisions")

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium")


@pytest.fixture(scope="module")
def browser():
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=[*FLAGS, "--no-sandbox"])
        yield browser
        browser.close()


@contextmanager
def saccade(*arguments: object):
    """A command of ours, interrupted at the end."""
    child = subprocess.Popen([sys.executable, "-m", "saccade", *map(str, arguments)], text=True,
                             stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=os.environ | {"COLUMNS": "200"})
    try:
        yield child
    finally:
        child.send_signal(signal.SIGINT)
        child.communicate(timeout=WAIT_S)


def until(done) -> bool:
    end_s = time.monotonic() + WAIT_S
    while not (well := done()) and time.monotonic() < end_s:
        time.sleep(0.2)
    return well


def data_port_of(port: int) -> int:
    """The port from which the page at this port gets its data."""
    door = HTTPConnection("127.0.0.1", port, timeout=WAIT_S)
    door.request("GET", "/")
    data, = parse_qs(urlsplit(door.getresponse().headers["Location"]).query)["url"]
    return urlsplit(data).port


def recorded(data_port: int, path: Path) -> list[str]:
    """What lacks in the recording of somebody who comes now: in the end nothing, but it comes entity by entity."""
    lacking = ["anything"]

    def complete() -> bool:
        with suppress(OSError, ValueError, RuntimeError):  # it is being written
            lacking[:] = lacking_in(Seen(path))
        return not lacking

    with subprocess.Popen([binary(), "--save", path, f"rerun+http://127.0.0.1:{data_port}/proxy"],
                          stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as other:
        until(complete)
        other.send_signal(signal.SIGINT)
    return lacking


def lacking_in(seen: Seen) -> list[str]:
    begins = list(seen.of("/world/camera/image", "EncodedImage:blob"))[:5] == [0, 1, 2, 3, 4]
    return [entity for entity in ENTITIES if not seen.entities[entity]] + ["the first steps"] * (not begins)


class Page:
    """The page as it is drawn."""

    def __init__(self, browser, port: int) -> None:
        self.page = browser.new_page(viewport=SIZE)
        self.answered: set[str] = set()
        self.page.on("response", lambda response: self.answered.add(urlsplit(response.url).hostname))
        end_s = time.monotonic() + WAIT_S
        while time.monotonic() < end_s:
            try:
                self.page.goto(f"http://127.0.0.1:{port}/")
                return
            except Exception:  # it is not open yet
                time.sleep(0.3)
        pytest.fail(f"no page at port {port}")

    def shot(self, path: Path | None = None) -> dict[str, np.ndarray]:
        """The pixels of every place."""
        data = self.page.screenshot(path=path)
        pixels = np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(np.int16)
        height, width = pixels.shape[:2]
        return {name: pixels[int(t * height):int(b * height), int(x * width):int(r * width)]
                for name, (x, t, r, b) in (PLACES | {"titles": TITLES}).items()}

    def until(self, wanted) -> dict[str, np.ndarray]:
        """The first shot of which `wanted(shot)` names nothing that lacks."""
        end_s, lacking = time.monotonic() + WAIT_S, ["a page"]
        while time.monotonic() < end_s:
            shot = self.shot()
            if not (lacking := wanted(shot)):
                return shot
            time.sleep(0.5)
        self.shot(ARTEFACTS / "viewer_lacks.png")
        return pytest.fail(f"the page shows nothing in: {', '.join(lacking)}; see {ARTEFACTS / 'viewer_lacks.png'}")


def empty(shot: dict[str, np.ndarray]) -> list[str]:
    """Places without content, of one colour or nearly; and the titles, while a view says that it cannot be drawn."""
    signs = (shot["titles"][..., 0] > 180) & (shot["titles"][..., 1:] < 110).all(-1)
    nothing = [name for name, pixels in shot.items() if share_unlike_background(pixels) < 0.002]
    return nothing + ["titles"] * bool(signs.any())


def share_unlike_background(pixels: np.ndarray) -> float:
    values, counts = np.unique(pixels.reshape(-1, 3), axis=0, return_counts=True)
    return float((np.abs(pixels - values[counts.argmax()]).max(-1) > 24).mean())


@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # it is read while it is written
def test_a_running_episode_is_seen_and_moves(browser, tmp_path):
    """World, images, curves and words have content that changes from step to step; nobody else is heard of; who comes
    late sees the run from its start."""
    port = free_port("127.0.0.1")
    data_port = free_port("127.0.0.1", but=(port,))
    another = free_port("127.0.0.1", but=(port, data_port))
    ARTEFACTS.mkdir(exist_ok=True)
    with saccade("run", "--view", "--plain", "--count", "2000", "--seed", "5", "--set", f"viewer.port={port}", "--set",
                 f"viewer.data_port={data_port}", "--set", "viewer.truth=true", "--out", tmp_path / "run") as run:
        page = Page(browser, port)
        first = page.until(empty)
        page.until(lambda shot: [name for name in MOVES if np.abs(shot[name] - first[name]).max() < 48])
        page.shot(ARTEFACTS / "viewer_live.png")
        assert page.answered == {"127.0.0.1"}
        page.page.close()  # it draws in software: beside it those who come last would be long in coming
        late = recorded(data_port, tmp_path / "late.rrd")
        with saccade("view", "--live", "--truth", "--run", tmp_path / "run", "--port", another):
            assert until(lambda: listens("127.0.0.1", another))
            later = recorded(data_port_of(another), tmp_path / "later.rrd")
        assert run.poll() is None  # that was while it ran
    assert (late, later) == ([], [])


def test_a_browser_gets_in_with_the_token_alone(browser):
    """The whole address shows the page and gets the data. Without the token, under a name that points to this machine,
    and from a page of another site nothing is answered but 403."""
    answered: list[tuple[str, int]] = []
    with Server(configured(address="0.0.0.0")) as server, browser.new_context() as context:
        recording = rr.RecordingStream("saccade")
        with connected(recording, server):
            recording.log("said", rr.TextLog("hello"))
            page = context.new_page()
            page.on("response", lambda response: answered.append((response.url, response.status)))

            def data(address: str) -> list[int]:
                return [status for url, status in answered if url == f"{address}{READ}"]

            assert page.goto(server.page).status == 403
            assert page.goto(server.url).status == 200
            assert "token" not in page.url
            assert until(lambda: page.wait_for_timeout(100) or data(server.page)) == [200]
            strange = server.page.replace("localhost", "rebound.example")
            assert page.goto(strange).status == 403
            for address in (server.page, f"http://localhost:{server.data_port}"):
                page.evaluate(f"fetch('{address}{READ}', {{method: 'POST', mode: 'no-cors', credentials: 'include', "
                              "body: '\\0\\0\\0\\0\\0'}).catch(String)")
                assert until(lambda at=address: page.wait_for_timeout(100) or data(at)[-1:]) == [403]


def test_a_log_is_seen(browser):
    port = free_port("127.0.0.1")
    ARTEFACTS.mkdir(exist_ok=True)
    with saccade("view", GOLDEN, "--port", port, "--truth") as view:
        page = Page(browser, port)
        page.until(empty)
        page.shot(ARTEFACTS / "viewer_log.png")
        page.page.close()
        assert view.poll() is None
    assert view.returncode == 0
