"""The guide's page about objects of one's own, followed word by word with a mesh."""

import re
import shlex
import sys

import numpy as np
import pytest
import trimesh
from PIL import Image

from saccade.app.cli.main import main
from saccade.shared.config import PACKAGE
from saccade.shared.render.groceries import grocery
from saccade.shared.render.objects import names_of

PAGE = (PACKAGE / "docs" / "objects.md").read_text()
ADD = "saccade objects add tea.glb"
BY_VIEWS = "saccade objects add --views mug_pictures --poses mug_pictures/transforms.json --name mug"
SHORT = {"saccade run --objects my --count 3": " --bus local --set simulator.max_steps=1"}
SKIPPED = (BY_VIEWS,)  # test_object_views.py does it, with pictures of its own


def commands():
    """The commands of the page, in its order."""
    blocks = re.findall(r"^```sh\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    return [line for block in blocks for line in block.splitlines() if line]


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """A folder with what the page has at hand: a mesh as GLB in metres with y up, and a photograph."""
    monkeypatch.setenv("SACCADE_OBJECTS", str(tmp_path / "sets"))
    monkeypatch.chdir(tmp_path)
    mesh = grocery(np.random.default_rng([3, 0]), "tea")
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(mesh.texture))
    shape = trimesh.Trimesh(mesh.vertices_m[:, [0, 2, 1]] * (1, 1, -1), mesh.faces, process=False)
    shape.visual = trimesh.visual.TextureVisuals(uv=mesh.texcoords, material=material)
    data = shape.export(file_type="glb")  # not as from the library, which does not keep to the definition of the axes
    (tmp_path / "tea.glb").write_bytes(data.replace(b"mikedh/trimesh", b"another/progra"))
    Image.fromarray(np.full((240, 320, 3), 120, dtype=np.uint8)).save(tmp_path / "photo.jpg")
    return tmp_path


def call(monkeypatch, line):
    monkeypatch.setattr(sys, "argv", shlex.split(line))
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code in (0, None), line


def test_the_page_is_followed_word_by_word(desk, monkeypatch, capsys):
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("typer.confirm", lambda question, default: True)  # yes, as the page says
    lines = commands()
    assert {ADD, *SKIPPED, *SHORT} <= set(lines)
    for line in lines:
        if line not in SKIPPED:
            call(monkeypatch, line + SHORT.get(line, ""))
        if line == ADD:
            assert names_of("my") == ("tea",)
            told_as_the_page_says(capsys.readouterr().out)
            kept_as_the_page_says(desk / "sets" / "my")
    assert (desk / "about" / "tea.md").is_file()
    assert (desk / "seen").exists()
    assert not (desk / "sets" / "my" / "tea").exists()  # the page removes it last


def told_as_the_page_says(said):
    for words in ("tea: The lengths are in metres, because glTF files are in metres by definition: the largest side is",
                  "tea: The axis y points up, because glTF files have y up by definition; if the object lies on its "
                  "side, give --up z.", "tea: turned about the vertical, it looks different from each side",
                  "its picture is", "learnt tea: 1 object in", "use it with `--objects my`"):
        assert words in said
        assert words in PAGE


def kept_as_the_page_says(folder):
    """The tree under 'How sets are kept'."""
    tree = PAGE.partition("~/.local/share/saccade/objects/my/\n")[2].partition("```")[0]
    named = {name.rstrip("/") for name in re.findall(r"[├└]── (\S+)", tree)}
    assert len(named) == 6
    assert named <= {path.name for path in folder.rglob("*")}
