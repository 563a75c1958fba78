"""Objects of one's own: sets as folders, what is learnt of them, and that nothing of the others changes."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from saccade.app.cli.texts import configured, is_list
from saccade.app.objects.adding import add_meshes, learn_set, remove_objects
from saccade.app.objects.cards import TURNTABLE, Card
from saccade.app.objects.lists import assembled, members_of
from saccade.app.objects.page import own_likeness, pairs_of
from saccade.app.objects.showing import list_set, show_object
from saccade.app.objects.store import (
    alone_in,
    keep,
    name_from,
    obj_text,
    own_folder,
    require_free,
)
from saccade.shared.config import WEIGHTS, Config, SceneConfig, learned_folder, set_folder
from saccade.shared.errors import SaccadeError
from saccade.shared.files import parse_toml
from saccade.shared.model.bank import bank_in, bank_of
from saccade.shared.model.object_card import CARD
from saccade.shared.model.weights import MANIFEST, OPEN, Weights, weights_in_use
from saccade.shared.render.groceries import grocery
from saccade.shared.render.mesh import read_obj
from saccade.shared.render.objects import load_mesh, names_of

pytestmark = pytest.mark.usefixtures("small_banks")


@pytest.fixture
def console():
    from rich.console import Console

    return Console(record=True, width=200)


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("SACCADE_OBJECTS", str(tmp_path))
    return tmp_path


def mesh_of(number, name):
    return grocery(np.random.default_rng([3, number]), name)


def added(objects, *names):
    for number, name in enumerate(names):
        keep(own_folder(objects), mesh_of(number, name), Card(f"{name}.obj", "m", "z", ("It was made by code.",)))


@pytest.fixture(scope="module")
def learnt_once(tmp_path_factory, small_banks):
    """A set of two objects that is learnt, for all tests of this file."""
    from rich.console import Console

    folder = tmp_path_factory.mktemp("learnt")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SACCADE_OBJECTS", str(folder))
        added("my", "tea", "rice")
        learn_set("my", Console(quiet=True))
    return folder / "my"


@pytest.fixture
def learnt(home, learnt_once):
    """The home with a copy of that set, which a test may change."""
    shutil.copytree(learnt_once, home / "my")
    return home


def test_a_set_is_named_or_its_folder_is_given(learnt):
    home = learnt
    assert names_of("my") == ("rice", "tea")
    assert names_of(str(home / "my")) == ("rice", "tea")
    assert SceneConfig(objects=str(home / "other" / ".." / "my")).objects == str(home / "my")
    assert set_folder("pantry") is None
    assert learned_folder("ycb", "default") == WEIGHTS / "ycb"
    assert learned_folder("my", OPEN) == home / "my" / "weights-open"
    with pytest.raises(SaccadeError, match=r"object set 'none' is not there, or has no objects \(.*none\): choose"):
        names_of("none")
    with pytest.raises(SaccadeError, match="object 'oil' is not in 'my': choose from rice, tea"):
        load_mesh("my", "oil")
    with pytest.raises(SaccadeError, match="object set 'ycb' comes with Saccade and stays as it is"):
        own_folder("ycb")


def test_who_uses_what_is_not_learnt_is_told_what_to_do(home, console, monkeypatch):
    added("my", "tea")
    config = Config().with_values({"scene.objects": "my"})
    with pytest.raises(SaccadeError, match=r"set 'my' is one of your own, .* add `--agent open`"):
        weights_in_use(config)
    config = config.with_values({"perception.architecture": OPEN})
    with pytest.raises(SaccadeError, match="set 'my' is not learnt: `saccade objects learn --set my`"):
        weights_in_use(config)
    learn_set("my", console)
    assert weights_in_use(config.with_values({"scene.names": ["tea"]})).names == ("tea",)
    added("my", "rice")
    with pytest.raises(SaccadeError, match="object 'rice' of the set 'my' is not learnt: `saccade objects learn"):
        weights_in_use(config.with_values({"scene.names": ["tea", "rice"]}))
    with monkeypatch.context() as patch:
        patch.setattr("saccade.shared.model.weights.FORM", 0)
        with pytest.raises(SaccadeError, match="was learnt with other networks than these"):
            weights_in_use(config.with_values({"scene.names": ["tea"]}))
    manifest = learned_folder("my", OPEN) / MANIFEST
    manifest.write_text(manifest.read_text().replace('"networks_sha256": "', '"networks_sha256": "0'))
    with pytest.raises(SaccadeError, match="was learnt with other networks than these"):
        weights_in_use(config.with_values({"scene.names": ["tea"]}))


def test_an_object_is_kept_as_it_was_with_its_card_and_its_picture(home):
    added("my", "tea")
    mesh, folder = mesh_of(0, "tea"), home / "my" / "tea"
    again = read_obj(folder, "tea")
    assert again.vertices_m[again.faces] == pytest.approx(mesh.vertices_m[mesh.faces], abs=2e-6)
    assert again.texcoords[again.faces] == pytest.approx(mesh.texcoords[mesh.faces], abs=2e-6)
    assert np.array_equal(again.texture, mesh.texture)
    card = parse_toml((folder / CARD).read_text())
    assert card["name"] == "tea"
    assert card["size_m"] == pytest.approx(mesh.size_m, abs=1e-4)
    assert card["notes"] == ["It was made by code."]
    assert (folder / TURNTABLE).stat().st_size > 1000
    assert [path.name for path in (home / "my").iterdir()] == ["tea"]  # nothing half done lies beside it


@pytest.mark.parametrize(("path", "given", "name"), [
    ("a/green tea (1).obj", None, "green_tea_1"), ("scans/milk/textured.obj", None, "milk"), ("x.glb", "cup", "cup")])
def test_the_name_is_that_of_the_file_or_of_its_folder(tmp_path, path, given, name):
    assert name_from(tmp_path / path, given) == name


def test_a_name_that_no_object_can_have_or_that_is_taken_is_one_line(home, tmp_path):
    with pytest.raises(SaccadeError, match="cannot be the name of an object: give one of at most 64 letters"):
        name_from(tmp_path / "茶.obj", None)
    added("my", "tea")
    with pytest.raises(SaccadeError, match=r"object 'tea' is in .*my already: give another name"):
        require_free(own_folder("my"), ["tea"])
    with pytest.raises(SaccadeError, match="two of the meshes have the name 'oil'"):
        require_free(own_folder("my"), ["oil", "oil"])


def test_what_is_added_is_learnt_and_leaves_the_others_as_they_were(home, console):
    added("my", "tea", "rice")
    learn_set("my", console)
    folder = learned_folder("my", OPEN)
    before = {path.name: path.read_bytes() for path in folder.glob("*.safetensors")}
    assert sorted(before) == ["rice.bank.safetensors", "tea.bank.safetensors"]
    keep(own_folder("my"), mesh_of(7, "oil"), Card("oil.obj", "m", "z"))
    learn_set("my", console)
    after = {path.name: path.read_bytes() for path in folder.glob("*.safetensors")}
    assert {name: after[name] for name in before} == before
    weights = Weights(folder)
    assert weights.names == ("rice", "tea", "oil")
    assert weights.networks.folder == WEIGHTS / OPEN
    assert len(bank_of("oil", weights.bank("oil")).pictures) > 100
    assert (folder / "oil.bank.safetensors").stat().st_size < 800_000
    banks = {name: bank_in(weights, name) for name in weights.names}
    alike = {pair.other: pair.similar for pair in pairs_of("tea", banks)}
    assert set(alike) == {"rice", "oil"}
    assert 0.0 < max(alike.values()) < own_likeness(banks["tea"]) < 1.0
    text = console.export_text()
    assert "learnt rice, tea: 2 objects in" in text
    assert "learnt oil: 3 objects in" in text


def test_what_changed_is_learnt_again_and_what_is_removed_is_forgotten(learnt, console):
    home = learnt
    folder = learned_folder("my", OPEN)
    first = (folder / "tea.bank.safetensors").read_bytes()
    shutil.rmtree(home / "my" / "tea")
    keep(own_folder("my"), mesh_of(9, "tea"), Card("tea.obj", "m", "z"))
    learn_set("my", console)
    assert (folder / "tea.bank.safetensors").read_bytes() != first
    remove_objects("my", ["tea"], console)
    assert names_of("my") == ("rice",)
    assert Weights(folder).names == ("rice",)
    assert not (folder / "tea.bank.safetensors").exists()
    with pytest.raises(SaccadeError, match=r"object 'tea' is not in .*my: it holds rice"):
        remove_objects("my", ["tea"], console)


def written(folder, number, name):
    """A mesh in a file, as it comes from elsewhere."""
    folder.mkdir()
    mesh = mesh_of(number, name)
    (folder / "textured.obj").write_text("mtllib m.mtl\nusemtl m\n" + obj_text(mesh))
    (folder / "m.mtl").write_text("newmtl m\nmap_Kd label.png\n")
    Image.fromarray(mesh.texture).save(folder / "label.png")
    return folder / "textured.obj"


def test_meshes_are_added_and_learnt_and_a_bad_one_does_not_stop_the_others(home, console, tmp_path, capsys):
    good, bad = written(tmp_path / "tea", 0, "tea"), tmp_path / "flat.stl"
    bad.write_text("solid\nendsolid\n")
    with pytest.raises(SaccadeError, match="1 of 2 meshes could not be added: see above"):
        add_meshes([bad, good], "my", name=None, unit="m", up="z", ask=None, console=console)
    assert capsys.readouterr().err.startswith("saccade: ")
    assert names_of("my") == ("tea",)
    assert load_mesh("my", "tea").size_m == pytest.approx(mesh_of(0, "tea").size_m, abs=1e-4)
    assert Weights(learned_folder("my", OPEN)).names == ("tea",)
    text = console.export_text()
    assert "its picture is" in text
    assert "use it with `--objects my`" in text


@pytest.mark.parametrize("damage", ["bank", "manifest", "hashes", "gone"])
def test_what_was_learnt_and_is_damaged_is_learnt_again(learnt, console, damage):
    folder = learned_folder("my", OPEN)
    right = {path.name: path.read_bytes() for path in folder.glob("*.safetensors")}
    if damage == "bank":
        (folder / "tea.bank.safetensors").write_bytes(b"no bank")
    elif damage == "gone":
        (folder / "tea.bank.safetensors").unlink()
    elif damage == "manifest":
        (folder / MANIFEST).write_text("{")
    else:
        told = json.loads((folder / MANIFEST).read_text()) | {"meshes_sha256": ["x"]}
        (folder / MANIFEST).write_text(json.dumps(told))
    learn_set("my", console)
    assert {path.name: path.read_bytes() for path in folder.glob("*.safetensors")} == right
    assert sorted(Weights(folder).names) == ["rice", "tea"]


def test_an_object_that_cannot_be_learnt_does_not_stop_the_others(home, console, capsys):
    added("my", "tea", "rice", "oil")
    text = (home / "my" / "rice" / "textured.obj").read_text()
    (home / "my" / "rice" / "textured.obj").write_text(text.replace("v 0", "v 90").replace("v -0", "v -90"))
    (home / "my" / "oil" / "textured.obj").write_text("no mesh")
    with pytest.raises(SaccadeError, match="2 of the set's objects could not be learnt: see above"):
        learn_set("my", console)
    assert Weights(learned_folder("my", OPEN)).names == ("tea",)
    told = capsys.readouterr().err
    assert "object 'rice' is " in told
    assert "or remove it with `saccade objects remove oil`" in told
    list_set("my", console)
    assert "damaged: mesh" in console.export_text()


def test_only_one_command_changes_a_set_at_a_time(home, console):
    added("my", "tea")
    (home / "my" / ".adding-left").mkdir()
    with alone_in(home / "my"), pytest.raises(SaccadeError, match=r"changes the object set .*my: wait"):
        learn_set("my", console)
    assert not (home / "my" / ".adding-left").exists()


def test_who_says_no_adds_nothing(home, console, tmp_path):
    asked = []
    add_meshes([written(tmp_path / "tea", 0, "tea")], "my", name="cup", unit="m", up="z",
               ask=lambda question: bool(asked.append(question)), console=console)
    assert asked == ["Is cup right?"]
    assert not (home / "my" / "cup").exists()
    assert "cup is not added: --unit, --up and --symmetry say how the file is meant" in console.export_text()


def test_a_set_is_listed_and_an_object_is_shown(learnt, console):
    learned = learned_folder("my", OPEN)
    shutil.move(learned, learnt / "aside")
    list_set("my", console)
    show_object("my", "tea", console)
    shutil.move(learnt / "aside", learned)
    show_object("my", "tea", console)
    text = console.export_text()
    assert text.count('source = "tea.obj"') == 2
    assert "learnt: no; `saccade objects learn` does it" in text
    assert "most like it (1 is the same): rice" in text
    with pytest.raises(SaccadeError, match=r"object 'oil' is not in 'my': it holds rice, tea"):
        show_object("my", "oil", console)


# --- objects of several sets

def test_listed_objects_of_several_sets_are_one_set(home, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    added("my", "tea", "rice")
    added("other", "oil")
    folder = assembled("tea,other,pantry:soup_can", OPEN)
    assert names_of(folder) == ("oil", "soup_can", "tea")
    for object_set, name in (("my", "tea"), ("other", "oil"), ("pantry", "soup_can")):
        assert load_mesh(folder, name).size_m == pytest.approx(load_mesh(object_set, name).size_m, abs=1e-5)
    weights = Weights(learned_folder(folder, OPEN))
    assert sorted(weights.names) == ["oil", "soup_can", "tea"]
    before = {path.name: path.stat().st_mtime_ns for path in Path(folder).iterdir()}
    assert assembled("pantry:soup_can, tea,other:oil", OPEN) == folder
    assert {path.name: path.stat().st_mtime_ns for path in Path(folder).iterdir()}.items() >= {
        name: when for name, when in before.items() if not name.startswith("weights")}.items()
    config, agent = configured(None, {"scene.objects": "tea,oil"}, None, "still")
    assert agent == "still"
    assert names_of(config.scene.objects) == ("oil", "tea")


@pytest.mark.parametrize(("objects", "words"), [
    ("tea,oil", "object 'oil' is in none of the sets my, other, pantry, ycb"),
    ("rice,tea", "object 'rice' is in my and in other: write my:rice"),
    ("my:rice,other:rice", "object 'rice' is listed twice"),
    ("my:oil", "object 'oil' is not in 'my': choose from rice, tea"),
    ("none:oil", "object set 'none' is not there"), (",", "lists nothing: write NAME,SET:NAME,SET")])
def test_a_list_that_cannot_be_is_one_line(learnt, objects, words):
    shutil.copytree(learnt / "my" / "rice", learnt / "other" / "rice")
    with pytest.raises(SaccadeError, match=words):
        members_of(objects)


def test_a_folder_with_a_colon_is_no_list(tmp_path):
    assert not is_list(str(tmp_path / "a:b"))
    assert is_list("pantry:soup_can")
    assert not is_list("my")
