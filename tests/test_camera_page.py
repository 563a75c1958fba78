"""The guide's page about the camera, followed word by word: a folder, a film and poses, boards, and pictures alone."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("cv2")
pytest.importorskip("av")

from saccade.benchmarks.board_scene import SIZE as FILM_SIZE
from saccade.benchmarks.board_scene import encode
from saccade.services.camera.calibration import Calibration
from saccade.shared.config import PACKAGE
from saccade.shared.render.objects import load_mesh, names_of
from saccade.shared.render.world import World
from saccade.shared.world.geometry import direction, look_at
from saccade.tests.fakes.board import PINHOLE, SIZE, both_on_the_table, view
from saccade.tests.fakes.camera import tum, written
from saccade.tests.front_door import call

PAGE = (PACKAGE / "docs" / "camera.md").read_text()
SECTIONS = ("## A board", "### Several boards", "## Pictures of which nothing is known")
LOCAL = " --bus local --plain --set belief.particles=500"  # within this process, and quicker


def section(title: str) -> str:
    """The text of a section, without those after it."""
    return re.split(r"^##+ ", PAGE.partition(f"\n{title}\n")[2], maxsplit=1, flags=re.MULTILINE)[0]


def commands(text: str) -> list[str]:
    return [line for block in re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
            for line in block.splitlines() if line.startswith("saccade")]


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """A folder with what the sections have at hand: a film of both boards, a calibration, and pictures of objects."""
    monkeypatch.chdir(tmp_path)
    encode((both_on_the_table(view(230 + 4 * k, 55, 0.5, at=(0.15, 0.0))) for k in range(9)), tmp_path / "my_video.mp4")
    (k1, k2, p1, p2, k3) = (dict(PINHOLE.distortion)[name] for name in ("k1", "k2", "p1", "p2", "k3"))
    Calibration(size_px=SIZE, intrinsics_px=PINHOLE.intrinsics_px, distortion=(k1, k2, p1, p2, k3)).write(
        tmp_path / "camera.toml")
    names = names_of("pantry")[:4]
    meshes = tuple(load_mesh("pantry", name) for name in names)
    places = ((0.12, 0.0), (-0.1, 0.1), (0.0, -0.16), (0.0, 0.18))
    world = World(meshes)
    world.place({mesh.name: ((*place, mesh.size_m[2] / 2), 0.4) for mesh, place in zip(meshes, places, strict=True)})
    (tmp_path / "my_images").mkdir()
    for number, azimuth in ((0, 0.2), (1, 0.5), (3, 0.9)):
        rgb = world.render(look_at(0.62 * direction(azimuth, 0.75), np.array([0.0, 0.0, 0.05])))
        Image.fromarray(rgb).save(tmp_path / "my_images" / f"{number:03}.png")
    world.close()
    return tmp_path


def test_the_sections_are_followed_word_by_word(desk, monkeypatch, capsys):
    said = {}
    for title in SECTIONS:
        lines = commands(section(title))
        assert lines, title
        for line in lines:
            words = shlex.split(line + (LOCAL if line.startswith("saccade run") else ""))[1:]
            code, out, err = call(monkeypatch, capsys, *words)
            assert code == 0, (line, err)
            said[title] = said.get(title, "") + out + err
    told = section("## A board").partition("```text\n")[2].partition("```")[0]
    assert told in said["## A board"]
    assert "9 views" in said["### Several boards"]
    assert "board.json and 1 more" not in said["### Several boards"]  # which is said only if no image has a pose
    shown = section("## Pictures of which nothing is known")
    assert "is no substitute for poses" in shown.replace("\n", " ")
    assert "is no substitute for poses" in said["## Pictures of which nothing is known"].replace("\n", " ")
    assert (desk / "map.json").is_file()


def test_a_folder_a_film_and_their_poses_are_followed_word_by_word(tmp_path, monkeypatch, capsys):
    """With a shorter first run. The film has its images, and the poses are those of the page, as TUM."""
    monkeypatch.chdir(tmp_path)

    def said(line: str) -> str:
        words = shlex.split(line + (LOCAL if line.startswith("saccade run") else ""))[1:]
        code, out, err = call(monkeypatch, capsys, *words)
        assert code == 0, (line, err)
        return out + err

    folder = section("## Images from a folder")
    first, = re.findall(r"`(saccade run [^`]*)`", folder)
    said(first.replace(" --plain", " --set simulator.max_steps=3"))
    exec(re.search(r'title="images_of_a_run.py"\n(.*?)^```', folder, re.MULTILINE | re.DOTALL)[1], {})
    seen = "".join(map(said, commands(folder)))
    assert "3 views" in seen
    assert "found" in seen
    goal, = commands(section("## What you should see"))
    assert "goal image my_view.png: " in said(goal)
    shown = said(*commands(section("### Look at the poses first")))
    assert "poses: 3 (000.png to 002.png)" in shown
    assert (tmp_path / "cameras.png").is_file()
    poses = [json.loads(text)["world_from_camera"] for text in Path("my_poses.jsonl").read_text().splitlines()]
    written(tmp_path / "my_trajectory.txt", *(tum(k / 10, np.array(each)) for k, each in enumerate(poses)))
    images = [Image.open(f"my_images/00{k}.png").resize(FILM_SIZE) for k in range(3)]
    encode(map(np.array, images), tmp_path / "my_video.mp4")
    film = commands(section("## Videos and webcams"))[0]
    assert "3 views" in said(film)


def test_what_can_go_wrong_is_told_as_the_page_says():
    rows = [line for line in PAGE.splitlines() if line.startswith("| `")]
    sources = "\n".join(path.read_text() for folder in ("services/camera", "app/look", "app/camera")
                        for path in (PACKAGE / folder).rglob("*.py"))
    flat = re.sub(r'"\s*\n?\s*f?"', "", sources)
    for words in ("have markers in common, so that they could not be told apart",
                  "camera.more_boards without camera.board", "objects in common with the map"):
        assert any(words in row for row in rows), words
        assert words in flat, words
