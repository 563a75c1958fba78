"""Cards of objects of one's own: they follow the mesh, keep what the user has set, and learning leaves others alone."""

from __future__ import annotations

import errno
import os

import pytest

from saccade.app.api import Agent
from saccade.app.cli.texts import configured
from saccade.app.objects import adding
from saccade.app.objects.adding import add_meshes, learn_set
from saccade.app.objects.cards import TURNTABLE, Card, refresh
from saccade.app.objects.learning import Learnt
from saccade.app.objects.showing import show_object
from saccade.app.objects.store import keep, obj_text, own_folder
from saccade.app.run.registry import configuration
from saccade.services.simulator.scenes import save_scenes
from saccade.services.simulator.suites import SUITES
from saccade.services.simulator.tables import draw_tables
from saccade.shared.config import learned_folder
from saccade.shared.errors import SaccadeError
from saccade.shared.files import parse_toml, remedy, writing
from saccade.shared.model.object_card import CARD, symmetry_in
from saccade.shared.model.weights import MANIFEST, OPEN
from saccade.shared.render.objects import load_mesh, names_of
from saccade.shared.world.symmetry import CONTINUOUS, NONE
from saccade.tests.fakes.shapes import box, can, labelled
from saccade.tests.front_door import call

pytestmark = pytest.mark.usefixtures("small_banks")


@pytest.fixture
def console():
    from rich.console import Console

    return Console(record=True, width=200)


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("SACCADE_OBJECTS", str(tmp_path / "sets"))
    return tmp_path / "sets"


def added(mesh, symmetry=NONE, found=NONE):
    return keep(own_folder("my"), mesh, Card("x.obj", "m", "z", symmetry=symmetry, symmetry_found=found))


def said(folder):
    return parse_toml((folder / CARD).read_text())


def test_an_objects_symmetry_is_found_when_it_is_added_or_told(home, tmp_path, console, monkeypatch):
    square, source = box((0.08, 0.08, 0.14)), tmp_path / "square.obj"
    source.write_text(obj_text(square))
    add = {"unit": "m", "up": "z", "ask": lambda _: True, "console": console}
    monkeypatch.setattr(adding, "learn", lambda *_: Learnt([], {}))
    add_meshes([source], "my", name="found", **add)
    add_meshes([source], "my", name="told", symmetry=NONE, **add)
    assert load_mesh("my", "found").symmetry == 4
    assert load_mesh("my", "told").symmetry == NONE
    assert "symmetry_found" not in said(home / "my" / "told")
    text = console.export_text()
    assert "found: turned about the vertical, it looks the same after a quarter turn" in text
    assert "told: turned about the vertical, it looks different from each side" in text


@pytest.mark.parametrize(("card", "symmetry"), [
    ("symmetry = 4\nsymmetry_found = 4\n", NONE), ("", NONE),
    ('symmetry = "continuous"\nsymmetry_found = 4\n', CONTINUOUS), ("symmetry = 2\n", 2)])
def test_a_card_follows_the_mesh_but_for_what_the_user_has_set(home, card, symmetry):
    folder = added(box((0.08, 0.08, 0.14), labelled(0.1)))
    (folder / CARD).write_text(f'# mine\nsize_m = [1, 1, 1]\nmesh_sha256 = "old"\n{card}[shop]\nprice = 3\n')
    (folder / "textured.obj").write_text(obj_text(can()))
    before, told = (folder / TURNTABLE).read_bytes(), []
    refresh(folder, told.append)
    assert symmetry_in(folder) == symmetry
    assert said(folder)["size_m"] == pytest.approx([0.07, 0.07, 0.11], abs=1e-3)
    assert said(folder)["shop"] == {"price": 3}
    assert "# mine" in (folder / CARD).read_text()
    assert (folder / TURNTABLE).read_bytes() != before
    assert len(told) == 1
    assert ("that you have set" in told[0]) == (symmetry in (2, CONTINUOUS))
    now = (folder / CARD).stat().st_mtime_ns
    refresh(folder, told.append)
    assert (folder / CARD).stat().st_mtime_ns == now


def test_a_new_object_leaves_the_files_of_the_others_untouched(home, console):
    added(can(name="tea"))
    learn_set("my", console)
    learned = learned_folder("my", OPEN)
    files = [home / "my" / "tea" / name for name in os.listdir(home / "my" / "tea")]
    files += [path for path in learned.iterdir() if path.name != MANIFEST]
    before = {path: (path.stat().st_mtime_ns, path.stat().st_ino) for path in files}
    assert len(before) == 5
    added(can(labelled(0.2), name="oil"))
    learn_set("my", console)
    assert {path: (path.stat().st_mtime_ns, path.stat().st_ino) for path in files} == before
    assert (learned / "oil.bank.safetensors").is_file()
    show_object("my", "oil", console, home / "page")
    page = (home / "page" / "oil.md").read_text()
    for words in ("| turned about the vertical | looks different from each side |", "| source | x.obj |",
                  "1. **tea**, ", "| oil | tea |", "The bank holds 120 views"):
        assert words in page
    for picture in ("oil-turntable.png", "oil-views.png", "oil-like-1.png"):
        assert f"({picture})" in page
        assert (home / "page" / picture).read_bytes().startswith(b"\x89PNG")


def test_a_card_that_is_damaged_is_one_line(home, console, capsys):
    (added(can(name="oil")) / CARD).write_text("symmetry = round")
    with pytest.raises(SaccadeError, match="1 of the set's objects could not be learnt: see above"):
        learn_set("my", console)
    assert "object.toml is not TOML" in capsys.readouterr().err
    assert "learnt nothing new: 0 objects" in console.export_text()


@pytest.mark.parametrize(("number", "words"), [
    (errno.ENOSPC, "free some space"), (errno.EDQUOT, "free some space"), (errno.EACCES, "the permission to write"),
    (errno.EROFS, "that is not read-only"), (errno.ENOTDIR, "name another place")])
def test_what_cannot_be_written_says_what_helps(tmp_path, number, words):
    error = OSError(number, os.strerror(number))
    with pytest.raises(SaccadeError, match=words) as told, writing(tmp_path, "object"):
        raise error
    assert os.strerror(number) in str(told.value)
    assert ("space" in remedy(error)) == (number in (errno.ENOSPC, errno.EDQUOT))


def test_a_wrong_symmetry_is_one_line(monkeypatch, capsys):
    code, _, err = call(monkeypatch, capsys, "objects", "add", "x.obj", "--symmetry", "round")
    assert code == 2
    assert err == ("saccade: --symmetry is 'round': write \"none\", \"continuous\", or a number from 2 to 120, such as "
                   "4 for a square box without a label\n")


# --- which agent

def test_without_a_word_the_agent_is_the_one_that_knows_the_objects(home, tmp_path, capsys):
    added(can(name="tea"))
    for objects in ("my", str(home / "my")):
        config, agent = configured(None, {"scene.objects": objects}, None, None)
        assert (agent, config.perception.architecture) == ("open", OPEN)
        assert capsys.readouterr().out.startswith("the agent is open, because it is the one that knows objects of your")
    assert configured(None, {"scene.objects": "my"}, None, "still")[1] == "still"
    for keys in ({}, {"scene.objects": "ycb"}, {"scene.objects": "my", "perception.weights": tmp_path}):
        assert configured(None, keys, None, None)[1] == "sceneccn"
    (tmp_path / "c.toml").write_text('[scene]\nobjects = "my"\n')
    config, agent = configuration(tmp_path / "c.toml", {})
    assert (agent, config.perception.architecture) == ("open", OPEN)
    assert capsys.readouterr().out == ""
    with pytest.raises(SaccadeError, match="object set 'mine' is not there"):
        configured(None, {"scene.objects": "mine"}, None, None)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(("keys", "why"), [
    ({"simulator.look": "room"}, "any light"), ({"simulator.goal_look": "dim"}, "any light"),
    ({"camera.source": "webcam:0"}, "photographs"), ({"scene.goal_image": "view.png"}, "photographs")])
def test_in_other_light_and_for_photographs_it_is_the_agent_that_was_made_for_them(keys, why, tmp_path, capsys):
    assert configured(None, keys, None, None)[1] == "open"
    assert capsys.readouterr().out.startswith(f"the agent is open, because it is the one for {why}: `--agent`")
    assert configured(None, keys, None, "sceneccn")[1] == "sceneccn"
    assert configured(None, keys | {"perception.weights": tmp_path}, None, None)[1] == "sceneccn"
    assert configured(None, {"simulator.look": "flat", "simulator.goal_look": "flat"}, None, None)[1] == "sceneccn"
    assert capsys.readouterr().out == ""


def test_for_objects_that_lie_it_is_too(tmp_path, capsys):
    meshes = {name: load_mesh("pantry", name) for name in names_of("pantry")}
    assert {name for name, suite in SUITES.items() if suite.place is not None and any(
        scene.lying for scene in draw_tables(name, meshes, 0, 11 if name == "moving" else 2))} == {
            name for name, suite in SUITES.items() if suite.lying}
    for number, agent in ((0, "sceneccn"), (10, "open")):  # it is moved, pushed over
        save_scenes(path := tmp_path / f"{number}.json", [draw_tables("moving", meshes, 0, 11)[number]])
        assert configured(None, {"scene.file": path}, None, None)[1] == agent
    assert configured(None, {}, None, None, lying=True)[1] == "open"
    assert capsys.readouterr().out.count("it is the one for objects that lie or fall") == 2


def test_in_python_too(home):
    added(can(name="tea"))
    with pytest.raises(SaccadeError, match=r"weights-open/manifest.json are missing"):
        Agent(objects="my")
