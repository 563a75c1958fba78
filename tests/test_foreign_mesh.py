"""Meshes as people have them: any kind, unit, axes, parts and colours come out as one mesh, and what is no object is
refused in one line."""

from __future__ import annotations

import json
import os
import struct
import sys

import numpy as np
import pytest
import trimesh
from PIL import Image

from saccade.shared.errors import SaccadeError
from saccade.shared.render.foreign_mesh import read_mesh
from saccade.shared.render.mesh import TEXTURE_MAX_PX, read_obj
from saccade.shared.render.mesh_parts import GREY
from saccade.shared.render.world import World
from saccade.shared.world.geometry import look_at
from saccade.tests.hostile import complaint, not_files, sparse, within_limits

RED, GREEN, BLUE, YELLOW = (200, 30, 30), (30, 160, 60), (40, 60, 210), (240, 220, 100)
TURNED = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # from z up to y up

# The corners of a box, and its six sides as quads that count them back from the last.
BOX = [(x, y, z) for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
SIDES = {"bottom": (-8, -5, -6, -7), "top": (-4, -3, -2, -1), "front": (-8, -7, -3, -4), "right": (-7, -6, -2, -3),
         "back": (-6, -5, -1, -2), "left": (-5, -8, -4, -1)}


def write_image(path, *colours, rows=1):
    """A PNG of squares, in rows."""
    squares = np.array(colours, dtype=np.uint8).reshape(rows, -1, 3)
    Image.fromarray(np.repeat(np.repeat(squares, 16, 0), 16, 1)).save(path)


def box_text(size=(0.08, 0.04, 0.12), at=(0.0, 0.0, 0.0), *, uv="full", header="", suffix=""):
    """A box of quads with relative indices, every side with the same piece of the texture."""
    corners = np.array(BOX) * size + at
    coords = {"full": ((0, 0), (1, 0), (1, 1), (0, 1)),
              "tenth": ((10, -3), (10.5, -3), (10.5, -2), (10, -2)),
              "twice": ((0, 0), (2, 0), (2, 1), (0, 1))}[uv]
    lines = [header, *(f"v {x} {y} {z}{suffix}" for x, y, z in corners), *(f"vt {u} {v}" for u, v in coords)]
    lines += ["f " + " ".join(f"{corner}/{k - 4}" for k, corner in enumerate(side)) for side in SIDES.values()]
    return "\n".join(lines) + "\n"


def write_box(folder, name="box.obj", **options):
    """A box with a texture that is red on the left and green on the right."""
    options.setdefault("header", "mtllib box.mtl\nusemtl paper")
    (folder / "box.mtl").write_text("newmtl paper\nKd 0.1 0.1 0.1\nmap_Kd label.png\n")
    write_image(folder / "label.png", RED, GREEN)
    (folder / name).write_text(box_text(**options))
    return folder / name


def sampled(mesh, shares=(1 / 3, 1 / 3, 1 / 3)):
    """The middle of every face [F, 3] in metres, and the colour [F, 3] there."""
    uv = np.einsum("fkc,k->fc", mesh.texcoords[mesh.faces].astype(float), shares)
    high, wide, _ = mesh.texture.shape
    column = np.clip((uv[:, 0] * wide).astype(int), 0, wide - 1)
    row = np.clip(((1.0 - uv[:, 1]) * high).astype(int), 0, high - 1)
    return np.einsum("fkc,k->fc", mesh.vertices_m[mesh.faces].astype(float), shares), mesh.texture[row, column]


def told_of(imported, *words):
    """Whether one note has all of these words."""
    return any(all(word in note for word in words) for note in imported.notes)


def solid(kind, **options):
    return getattr(trimesh.creation, kind)(**options)


# What is read.

def test_quads_relative_indices_and_spaces(tmp_path):
    """Also a texture after options in the material file, and an absolute name of another computer."""
    path = write_box(tmp_path, "tea box.obj", header="mtllib tea box.mtl\no tea box\nusemtl brown paper")
    write_image(tmp_path / "tea label.png", RED, GREEN)
    for named in ("-s 1 1 1 -bm 0.5 tea label.png", "C:\\work\\tea label.png", "../x/tea label.png"):
        (tmp_path / "tea box.mtl").write_text(f"newmtl brown paper\nmap_Kd {named}\n")
        imported = read_mesh(path, "tea")
        mesh = imported.mesh
        assert mesh.size_m == pytest.approx([0.08, 0.04, 0.12])
        assert mesh.vertices_m.max(0) == pytest.approx(-mesh.vertices_m.min(0))
        assert len(mesh.faces) == 12
        # The front begins at the texture's left side and ends at its right side.
        for shares in ((0.8, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.1, 0.8)):
            places, colours = sampled(mesh, shares)
            front = places[:, 1] < -0.0199
            assert front.sum() == 2
            for place, colour in zip(places[front], colours[front], strict=True):
                assert tuple(colour) == (RED if place[0] < 0 else GREEN)


def test_relative_indices_count_from_the_line_they_stand_in(tmp_path):
    """A file with several parts has vertices after the first faces."""
    first, second = box_text((0.1, 0.1, 0.1)), box_text((0.1, 0.1, 0.1), (0.2, 0.0, 0.0))
    (tmp_path / "two.obj").write_text(first + second)
    imported = read_mesh(tmp_path / "two.obj", "two")
    assert imported.mesh.size_m == pytest.approx([0.3, 0.1, 0.1])
    places, _ = sampled(imported.mesh)
    assert (places[:, 0] < 0).sum() == (places[:, 0] > 0).sum() == 12
    assert not told_of(imported, "not closed")


def test_it_is_what_the_reader_of_scans_gives(tmp_path):
    """A file in the layout of the scans is the same mesh with the same view. Kd does not darken a texture."""
    path = write_box(tmp_path, "textured.obj", uv="full")
    write_image(tmp_path / "texture_map.png", RED, GREEN)
    text = path.read_text()
    corners = [line[2:].split() for line in text.splitlines() if line.startswith("f ")]
    triangles = [f"f {a} {b} {c}" for q in corners for a, b, c in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))]
    absolute = [" ".join(w if k == 0 else "/".join(str(int(n) + m) for n, m in zip(w.split("/"), (9, 5), strict=True))
                         for k, w in enumerate(t.split())) for t in triangles]
    path.write_text("\n".join([line for line in text.splitlines() if not line.startswith("f ")] + absolute) + "\n")
    mine, scan = read_mesh(path, "a").mesh, read_obj(tmp_path, "a")
    assert mine.size_m == pytest.approx(scan.size_m)
    views = []
    for mesh in (mine, scan):
        world = World((mesh,), size_px=120, intrinsics_px=(150, 150, 60, 60))
        world.show_table(False)
        world.place({"a": (np.zeros(3), 0.0)})
        views.append(world.render(look_at((0.3, -0.3, 0.2), (0, 0, 0))).astype(int))
        world.close()
    assert views[0].max() > 100
    assert np.abs(views[0] - views[1]).mean() < 0.5


def test_several_parts_and_textures_become_one_texture(tmp_path):
    """Two textures of different sizes and a plain colour: each part keeps its own, the right way up."""
    write_image(tmp_path / "a.png", RED, GREEN, BLUE, YELLOW, rows=2)
    write_image(tmp_path / "b.png", BLUE)
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd a.png\nnewmtl b\nmap_Kd b.png\nnewmtl c\nKd 1 0.5 0\n")
    parts = [box_text((0.1, 0.1, 0.1), (0.15 * k, 0, 0), header=f"usemtl {name}") for k, name in enumerate("abc")]
    (tmp_path / "m.obj").write_text("mtllib m.mtl\n" + "".join(parts))
    imported = read_mesh(tmp_path / "m.obj", "m")
    for shares in ((0.8, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.1, 0.8)):
        places, colours = sampled(imported.mesh, shares)
        for (x, y, z), colour in zip(places, colours, strict=True):
            if x > -0.09:
                assert tuple(colour) == (BLUE if x < 0.06 else (255, 128, 0))
            elif y < -0.0499:  # the front of the first
                assert tuple(colour) == ((BLUE if x < -0.15 else YELLOW) if z < 0 else RED if x < -0.15 else GREEN)
    assert max(imported.mesh.texture.shape) < 200


def test_the_meshes_of_a_folder_are_parts_of_one_object(tmp_path):
    write_box(tmp_path, "body.obj", size=(0.1, 0.1, 0.1))
    (tmp_path / "lid.obj").write_text(box_text((0.1, 0.1, 0.05), (0, 0, 0.1)))
    imported = read_mesh(tmp_path, "pot")
    assert imported.mesh.size_m == pytest.approx([0.1, 0.1, 0.15])
    assert [file.name for file in imported.files] == ["body.obj", "lid.obj"]
    assert told_of(imported, "body.obj, lid.obj")
    solid("box", extents=(0.1, 0.1, 0.1)).export(tmp_path / "x.stl")
    assert "several kinds (OBJ, STL)" in complaint(read_mesh, tmp_path, "pot")


def test_texture_coordinates_beyond_the_image_are_wrapped(tmp_path):
    """What lies whole images away, or repeats the image within a face, looks as it does within."""
    away = read_mesh(write_box(tmp_path, uv="tenth"), "a").mesh
    assert away.texcoords.min() >= 0
    assert away.texcoords.max() <= 1
    assert {tuple(colour) for colour in sampled(away)[1]} == {RED}
    twice = read_mesh(write_box(tmp_path, uv="twice"), "a").mesh
    assert twice.texcoords.max() <= 1
    places, colours = sampled(twice, (0.9, 0.05, 0.05))
    front = places[:, 1] < -0.0199
    assert {tuple(colour) for colour in colours[front]} == {RED}
    places, colours = sampled(twice, (0.45, 0.3, 0.25))  # somewhere in the second copy
    u = (places[:, 0] + 0.04) / 0.08 * 2
    for x, place, colour in zip(u, places, colours, strict=True):
        if place[1] < -0.0199 and min(x % 0.5, 0.5 - x % 0.5) > 0.05:
            assert tuple(colour) == (RED if x % 1 < 0.5 else GREEN)


def test_large_textures_are_reduced(tmp_path):
    path = write_box(tmp_path)
    Image.new("RGB", (2 * TEXTURE_MAX_PX, 64), RED).save(tmp_path / "label.png")
    assert read_mesh(path, "a").mesh.texture.shape[:2] == (32, TEXTURE_MAX_PX)
    many = "".join(f"newmtl m{k}\nmap_Kd {k}.png\n" for k in range(6))
    (tmp_path / "box.mtl").write_text(many)
    for k in range(6):
        Image.new("RGB", (1500, 1500), (40 * k, 0, 0)).save(tmp_path / f"{k}.png")
    path.write_text("mtllib box.mtl\n" + "".join(box_text(at=(0.1 * k, 0, 0), header=f"usemtl m{k}") for k in range(6)))
    mesh = read_mesh(path, "a").mesh
    assert max(mesh.texture.shape) <= TEXTURE_MAX_PX
    places, colours = sampled(mesh)
    reds = [colours[np.abs(places[:, 0] + 0.25 - 0.1 * k) < 0.045, 0] for k in range(6)]
    assert [set(red.tolist()) for red in reds] == [{40 * k} for k in range(6)]


def test_obj_with_colours_of_vertices(tmp_path):
    (tmp_path / "c.obj").write_text(box_text(suffix=" 0.2 0.4 0.6"))
    assert {tuple(colour) for colour in sampled(read_mesh(tmp_path / "c.obj", "c").mesh)[1]} == {(51, 102, 153)}


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
def test_ply_with_colours_of_vertices(tmp_path, encoding):
    """A colour goes over into its neighbours within a face."""
    shape = solid("box", extents=(0.1, 0.1, 0.1))
    shape.visual.vertex_colors = [(*(RED if z < 0 else BLUE), 255) for _, _, z in shape.vertices]
    shape.export(tmp_path / "c.ply", encoding=encoding)
    mesh = read_mesh(tmp_path / "c.ply", "c").mesh
    for shares in ((0.98, 0.01, 0.01), (0.01, 0.98, 0.01), (0.01, 0.01, 0.98)):
        places, colours = sampled(mesh, shares)
        assert np.abs(colours - np.where(places[:, 2:] < 0, RED, BLUE)).max() < 60
        assert np.abs(colours.astype(int) - np.where(places[:, 2:] < 0, BLUE, RED)).max(1).min() > 90


def test_ply_with_colours_of_faces(tmp_path):
    shape = solid("box", extents=(0.1, 0.1, 0.1))
    shape.visual.face_colors = [(*(RED if normal[2] > 0.5 else BLUE), 255) for normal in shape.face_normals]
    shape.export(tmp_path / "c.ply")
    places, colours = sampled(read_mesh(tmp_path / "c.ply", "c").mesh)
    assert (colours == np.where(places[:, 2:] > 0.049, RED, BLUE)).all()


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_stl_is_grey_and_says_so(tmp_path, kind):
    solid("cylinder", radius=30, height=120).export(tmp_path / "c.stl", file_type=kind)
    imported = read_mesh(tmp_path / "c.stl", "c")
    assert imported.mesh.size_m == pytest.approx([0.06, 0.06, 0.12], rel=1e-3)
    assert {tuple(colour) for colour in sampled(imported.mesh)[1]} == {GREY}
    assert told_of(imported, "STL", "grey")
    assert told_of(imported, "millimetres", "guess")


def write_glb(path, shape, *, by_trimesh):
    """A GLB file of the library or, with the name of the program taken out, of another program."""
    data = shape.export(file_type="glb")
    path.write_bytes(data if by_trimesh else data.replace(b"mikedh/trimesh", b"another/program"[:14]))
    return path


def painted(shape, **material):
    image = Image.fromarray(np.repeat(np.array([[RED], [GREEN]], dtype=np.uint8), 8, axis=0).repeat(16, axis=1))
    uv = np.stack([np.full(len(shape.vertices), 0.5), (shape.vertices[:, 2] > 0) * 0.9 + 0.05], axis=-1)
    pbr = trimesh.visual.material.PBRMaterial(baseColorTexture=image, **material)
    shape.visual = trimesh.visual.TextureVisuals(uv=uv, material=pbr)
    return shape


def test_glb_is_in_metres_with_y_up(tmp_path):
    """Its parts may be moved. The texture's v points down in the file."""
    shape = painted(solid("box", extents=(0.1, 0.06, 0.2)))
    scene = trimesh.Scene()
    scene.add_geometry(shape, transform=trimesh.transformations.translation_matrix((0, 5, 0)) @ TURNED)
    imported = read_mesh(write_glb(tmp_path / "a.glb", scene, by_trimesh=False), "a")
    assert imported.mesh.size_m == pytest.approx([0.1, 0.06, 0.2])
    assert (imported.unit, imported.up) == ("m", "y")
    assert told_of(imported, "y points up", "by definition")
    places, colours = sampled(imported.mesh, (0.98, 0.01, 0.01))
    assert (colours == np.where(places[:, 2:] > 0, RED, GREEN)).all()
    assert read_mesh(tmp_path / "a.glb", "a", up="z").mesh.size_m == pytest.approx([0.1, 0.2, 0.06])


def test_mirrored_parts_of_a_glb_show_their_outer_side(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(solid("box", extents=(0.1, 0.1, 0.1)), transform=np.diag([-1.0, 1.0, 1.0, 1.0]))
    mesh = read_mesh(write_glb(tmp_path / "a.glb", scene, by_trimesh=False), "a").mesh
    assert trimesh.Trimesh(mesh.vertices_m, mesh.faces).volume == pytest.approx(0.001)


def test_glb_of_the_library_is_as_it_was_given(tmp_path):
    """It does not turn what it writes, and writes a grey for no colour: a scan that stands on its z axis goes on to."""
    mug = painted(solid("cylinder", radius=0.04, height=0.1), baseColorFactor=[102, 102, 102, 255])
    imported = read_mesh(write_glb(tmp_path / "a.glb", mug, by_trimesh=True), "a")
    assert imported.up == "z"
    assert told_of(imported, "broadest base")
    assert {tuple(colour) for colour in sampled(imported.mesh, (0.98, 0.01, 0.01))[1]} == {RED, GREEN}
    assert told_of(imported, "darkens")
    lying = read_mesh(write_glb(tmp_path / "b.glb", mug.apply_transform(TURNED), by_trimesh=True), "b")
    assert lying.up == "y"
    assert lying.mesh.size_m == pytest.approx([0.08, 0.08, 0.1], rel=0.01)


def test_colours_of_glb_materials_are_linear(tmp_path):
    """A half in linear light is 188 of 255 in an image; a texture is multiplied by it."""
    plain = solid("box", extents=(0.1, 0.1, 0.1))
    plain.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(baseColorFactor=[128, 0, 255, 255]))
    mesh = read_mesh(write_glb(tmp_path / "a.glb", plain, by_trimesh=False), "a").mesh
    assert {tuple(colour) for colour in sampled(mesh)[1]} == {(188, 0, 255)}
    dark = painted(solid("box", extents=(0.1, 0.1, 0.1)), baseColorFactor=[255, 0, 255, 255])
    mesh = read_mesh(write_glb(tmp_path / "b.glb", dark, by_trimesh=False), "b").mesh
    assert {tuple(colour) for colour in sampled(mesh, (0.98, 0.01, 0.01))[1]} == {(200, 0, 30), (30, 0, 60)}


def test_gltf_with_files_beside_it(tmp_path):
    scene = trimesh.Scene(painted(solid("box", extents=(0.1, 0.1, 0.1))))
    for name, data in trimesh.exchange.gltf.export_gltf(scene).items():
        (tmp_path / name).write_bytes(data)
    assert len(read_mesh(tmp_path / "model.gltf", "a").mesh.faces) == 12
    buffer = next(tmp_path.glob("*.bin"))
    buffer.unlink()
    assert f"put it there as {buffer}" in complaint(read_mesh, tmp_path / "model.gltf", "a")


# Units and axes.

@pytest.mark.parametrize(("largest", "unit"), [
    (0.3, "m"), (1.1, "m"), (3.0, "cm"), (14.9, "cm"), (25.0, "cm"), (80.0, "mm"), (190.0, "mm"), (900.0, "mm"),
    (0.01, "m"), (1.7, "m"), (2500.0, "mm")])
def test_units_are_guessed_by_the_size_of_household_things(tmp_path, largest, unit):
    imported = read_mesh(write_box(tmp_path, size=(largest / 2, largest / 3, largest)), "a")
    assert imported.unit == unit
    assert imported.mesh.size_m[2] == pytest.approx(largest * {"m": 1, "cm": 0.01, "mm": 0.001}[unit])
    assert told_of(imported, {"m": "metres", "cm": "centimetres", "mm": "millimetres"}[unit], "guess")


def test_a_doubtful_unit_names_the_other(tmp_path):
    """30 mm of a construction program are a small part; 30 in another file are centimetres rather."""
    solid("box", extents=(20, 20, 30)).export(tmp_path / "a.stl")
    assert told_of(read_mesh(tmp_path / "a.stl", "a"), "millimetres", "if it is 30 cm, give --unit cm")
    assert told_of(read_mesh(write_box(tmp_path, size=(20, 20, 30)), "a"), "if it is 3 cm, give --unit mm")


def test_what_a_file_says_or_you_say_is_no_guess(tmp_path):
    path = write_box(tmp_path, size=(20, 20, 60), header="# This file uses centimeters as units for coordinates.")
    imported = read_mesh(path, "a")
    assert imported.mesh.size_m[2] == pytest.approx(0.6)
    assert told_of(imported, "centimetres", "comment")
    imported = read_mesh(path, "a", unit="mm", up="y")
    assert imported.mesh.size_m == pytest.approx([0.02, 0.06, 0.02])
    assert told_of(imported, "millimetres", "as you said")
    assert told_of(imported, "axis y", "as you said")


def test_what_lies_on_its_side_with_z_up_is_turned(tmp_path):
    """A bottle touches the table in a line then. Its front, which looks along -z in such files, looks along y."""
    bottle = solid("cylinder", radius=3, height=14).apply_transform(TURNED)
    bottle.export(tmp_path / "a.obj")
    imported = read_mesh(tmp_path / "a.obj", "a")
    assert imported.up == "y"
    assert imported.mesh.size_m == pytest.approx([0.06, 0.06, 0.14], rel=0.01)
    assert told_of(imported, "y points up", "give --up z")
    marked = trimesh.util.concatenate([bottle, solid("box", extents=(1, 1, 1)).apply_translation((0, 0, -4))])
    marked.export(tmp_path / "b.obj")
    vertices = read_mesh(tmp_path / "b.obj", "b").mesh.vertices_m
    assert vertices[vertices[:, 1] > vertices[:, 1].max() - 1e-4][:, 0].std() == pytest.approx(0.005, rel=0.01)
    assert read_mesh(write_box(tmp_path), "a").up == "z"


# Many faces, and open surfaces.

def test_many_faces_are_simplified(tmp_path):
    """Its size, its colours and its seams stay."""
    ball = solid("icosphere", subdivisions=6, radius=0.1)
    assert len(ball.faces) == 81920
    ball.visual.vertex_colors = [(*(RED if z < 0 else BLUE), 255) for _, _, z in ball.vertices]
    ball.export(tmp_path / "a.ply")
    imported = read_mesh(tmp_path / "a.ply", "a")
    assert len(imported.mesh.faces) <= 25_000
    assert told_of(imported, "simplified from 81920 to")
    assert imported.mesh.size_m == pytest.approx(ball.extents, rel=0.01)
    radii = np.linalg.norm(imported.mesh.vertices_m, axis=1)
    assert radii == pytest.approx(np.full(len(radii), 0.1), rel=0.01)
    places, colours = sampled(imported.mesh)
    far = np.abs(places[:, 2]) > 0.01
    assert np.abs(colours[far] - np.where(places[far, 2:] < 0, RED, BLUE)).mean() < 3


def test_a_texture_stays_in_place_when_simplified(tmp_path):
    """The texture is red above the middle and green below it."""
    shape = solid("icosphere", subdivisions=6, radius=0.1)
    path = write_glb(tmp_path / "a.glb", painted(shape), by_trimesh=True)
    places, colours = sampled(read_mesh(path, "a", up="z").mesh)
    far = np.abs(places[:, 2]) > 0.01
    assert len(places) <= 25_000
    assert (np.abs(colours[far].astype(int) - np.where(places[far, 2:] > 0, RED, GREEN)).max(1) < 10).mean() > 0.99


def test_an_open_mesh_is_accepted_and_says_so(tmp_path):
    shape = solid("box", extents=(0.1, 0.1, 0.1))
    shape.update_faces(shape.face_normals[:, 2] < 0.5)
    shape.export(tmp_path / "a.stl")
    imported = read_mesh(tmp_path / "a.stl", "a")
    assert len(imported.mesh.faces) == 10
    assert told_of(imported, "not closed (4 of its edges")
    assert not told_of(read_mesh(write_box(tmp_path), "a"), "not closed")


# What is refused.

def test_names_paths_and_kinds(tmp_path):
    for name in ("", "  ", "a/b", "a\nb", "x" * 999):
        assert "cannot be the name of an object" in complaint(read_mesh, tmp_path / "a.obj", name)
    assert f"mesh {tmp_path / 'a.obj'} is missing" in complaint(read_mesh, tmp_path / "a.obj", "a")
    assert "holds no meshes" in complaint(read_mesh, tmp_path, "a")
    (tmp_path / "a.fbx").write_bytes(b"Kaydara")
    assert "is of an unknown kind: export it as OBJ" in complaint(read_mesh, tmp_path / "a.fbx", "a")
    for kind, path in not_files(tmp_path, ".stl").items():
        if kind in ("a FIFO", "a socket"):
            assert f"it is {kind}, not a file" in complaint(read_mesh, path, "a")


@pytest.mark.parametrize("kind", ["obj", "glb", "gltf", "ply", "stl"])
def test_damaged_files(tmp_path, kind):
    """Whole files cut off anywhere, noise, and nothing at all."""
    path = tmp_path / f"a.{kind}"
    whole = solid("box", extents=(0.1, 0.1, 0.1)).export(file_type="glb" if kind == "gltf" else kind)
    whole = whole if isinstance(whole, bytes) else whole.encode()
    noise = np.random.default_rng(0).integers(0, 256, 5000, dtype=np.uint8).tobytes()
    tried = [b"", b"\0" * 999, noise, b'{"asset": [', b"ply\n", b"solid", b"glTF" + noise]
    tried += [] if kind == "obj" else [whole[:len(whole) * k // 7] for k in range(1, 7)]
    for data in tried:
        path.write_bytes(data)
        text = complaint(read_mesh, path, "a")
        assert str(path) in text
        assert "damaged" in text or "has no faces" in text
        assert ": export it again" in text


def test_a_damaged_line_of_an_obj_is_named(tmp_path):
    text = box_text().splitlines()
    for line, why in (("v 1 2", "line 3"), ("v a b c", "line 3"), ("f 1 2", "fewer than three corners"),
                      ("f 1 2 99999", "a face refers to a vertex that is not there"), ("f 0 1 2", "not there"),
                      ("f -99 1 2", "not there"), ("f 1 2 " + "9" * 5000, "line 3")):
        (tmp_path / "a.obj").write_text("\n".join([*text[:2], line, *text[2:]]))
        assert why in complaint(read_mesh, tmp_path / "a.obj", "a")
    write_box(tmp_path, "b.obj")
    with (tmp_path / "b.obj").open("a") as file:
        file.write("f 1/77 2/1 3/1\n")
    assert "refers to a vertex that is not there" in complaint(read_mesh, tmp_path / "b.obj", "a")


@pytest.mark.parametrize(("size", "words"), [
    ((0.0, 0.1, 0.1), "lies in one plane"), ((1e-9, 0.1, 0.1), "lies in one plane"),
    ((float("nan"), 0.1, 0.1), "not finite"), ((1e99, 1e99, 1e99), "too large"),
    ((1e-4, 1e-4, 1e-4), "smaller than 1 mm: scale it"), ((9e3, 9e3, 9e3), "larger than 5 m: scale it")])
def test_what_is_no_object(tmp_path, size, words):
    assert words in complaint(read_mesh, write_box(tmp_path, size=size), "a")


def test_a_wrong_unit_names_the_right_one(tmp_path):
    path = write_box(tmp_path, size=(10, 10, 30))
    assert "is 30 m large in metres, larger than 5 m: give --unit cm, which makes it 30 cm" in complaint(
        read_mesh, path, "a", unit="m")
    path = write_box(tmp_path, size=(0.05, 0.05, 0.1))
    assert "is 0.1 mm large in millimetres, smaller than 1 mm: give --unit m, which makes it 10 cm" in complaint(
        read_mesh, path, "a", unit="mm")


def test_no_faces(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    assert "has no faces" in complaint(read_mesh, tmp_path / "a.obj", "a")
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 1\n")
    assert "has no faces" in complaint(read_mesh, tmp_path / "a.obj", "a")
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "a.ply")
    assert "has no faces, only points" in complaint(read_mesh, tmp_path / "a.ply", "a")


def test_missing_and_damaged_textures(tmp_path):
    """The line says where the texture has to be."""
    path = write_box(tmp_path)
    (tmp_path / "label.png").write_bytes((tmp_path / "label.png").read_bytes()[:70])
    assert f"texture {tmp_path / 'label.png'} is damaged" in complaint(read_mesh, path, "a")
    (tmp_path / "label.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n")
    assert "is damaged" in complaint(read_mesh, path, "a")
    (tmp_path / "label.png").unlink()
    text = complaint(read_mesh, path, "a")
    assert f"texture 'label.png' is missing, which mesh {path} names: put it there as {tmp_path / 'label.png'}" in text
    (tmp_path / "box.mtl").unlink()
    imported = read_mesh(path, "a")
    assert told_of(imported, "material file 'box.mtl'", str(tmp_path))
    assert told_of(imported, "grey")
    assert {tuple(colour) for colour in sampled(imported.mesh)[1]} == {GREY}


def test_files_outside_the_folder_are_not_read(tmp_path):
    """Neither by their path nor by a link."""
    inside = tmp_path / "inside"
    inside.mkdir()
    path = write_box(inside)
    write_image(tmp_path / "outside.png", BLUE)
    for named in ("../outside.png", str(tmp_path / "outside.png")):
        (inside / "box.mtl").write_text(f"newmtl paper\nmap_Kd {named}\n")
        assert f"put it there as {inside / 'outside.png'}" in complaint(read_mesh, path, "a")
    os.symlink(tmp_path / "outside.png", inside / "outside.png")
    assert "is missing" in complaint(read_mesh, path, "a")
    tree = {"asset": {"version": "2.0"}, "buffers": [{"uri": "../outside.png", "byteLength": 9}]}
    (inside / "a.gltf").write_text(json.dumps(tree))
    assert "is missing" in complaint(read_mesh, inside / "a.gltf", "a")
    tree["buffers"][0]["uri"] = "http://127.0.0.1:9/outside.bin"
    (inside / "a.gltf").write_text(json.dumps(tree))
    assert "'http://127.0.0.1:9/outside.bin' is missing" in complaint(read_mesh, inside / "a.gltf", "a")


def test_a_damaged_texture_within_a_glb(tmp_path):
    data = painted(solid("box", extents=(0.1, 0.1, 0.1)), name="paint").export(file_type="glb")
    assert data.count(b"\x89PNG") == 1
    broken = data.replace(b"\x89PNG", b"\x89PNX")
    (tmp_path / "a.glb").write_bytes(broken)
    assert "texture of the material 'paint'" in complaint(read_mesh, tmp_path / "a.glb", "a")
    (tmp_path / "a.glb").write_bytes(broken.replace(b'"name":"paint"', b'"nome":"paint"'))
    assert "texture of the material '0'" in complaint(read_mesh, tmp_path / "a.glb", "a")
    at = data.index(b"IDAT") + 4
    (tmp_path / "a.glb").write_bytes(data[:at] + b"\0" * 9 + data[at + 9:])
    assert f"texture in mesh {tmp_path / 'a.glb'} is damaged" in complaint(read_mesh, tmp_path / "a.glb", "a")


def test_compressed_glb_is_refused(tmp_path):
    tree = {"asset": {"version": "2.0"}, "extensionsRequired": ["KHR_draco_mesh_compression"]}
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    assert "'KHR_draco_mesh_compression'" in complaint(read_mesh, tmp_path / "a.gltf", "a")


def bomb(kind):
    """A small file that says it holds ten million faces or more."""
    if kind == "ply":
        return (b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
                b"property float z\nelement face 10000000\nproperty list uchar int vertex_indices\nend_header\n")
    accessor = {"componentType": 5126, "type": "VEC3", "count": 10 ** 10 if kind == "count" else 3 * 10 ** 6}
    primitive = {"attributes": {"POSITION": 0}}
    meshes = [{"primitives": [primitive] * (1 if kind != "parts" else 400)}]
    nodes = [{"mesh": 0}] * (1 if kind != "nodes" else 4000)
    if kind == "depth":
        nodes = [{"children": [k + 1]} for k in range(4000)] + [{"mesh": 0}]
    if kind == "circle":
        nodes = [{"children": [1]}, {"children": [0]}]
    return json.dumps({
        "asset": {"version": "2.0"}, "accessors": [accessor] * (1 if kind != "accessors" else 4000), "meshes": meshes,
        "nodes": nodes, "scenes": [{"nodes": [0]}], "buffers": [], "bufferViews": []}).encode()


@pytest.mark.parametrize(("kind", "why"), [
    ("ply", "more than 1000000 faces"), ("count", "no count or one that is too large"),
    ("accessors", "its accessors are too large"), ("parts", "more than 1000000 faces"),
    ("nodes", "more than 1000000 faces"), ("depth", "deeper than 64 levels"), ("circle", "deeper than 64 levels")])
def test_small_files_that_say_they_are_large(tmp_path, kind, why):
    path = tmp_path / f"a.{'ply' if kind == 'ply' else 'gltf'}"
    path.write_bytes(bomb(kind))
    print_it = ("import sys; from pathlib import Path; from saccade.shared.render.foreign_mesh import *\n"
                "try: read_mesh(Path(sys.argv[1]), 'a')\nexcept SaccadeError as error: print(error)")
    assert why in within_limits(print_it, path)


def test_large_files_are_refused_by_their_size(tmp_path, monkeypatch):
    """Ten million faces are more than 64 MiB in every kind. A binary STL file tells the number of its faces, so that
    nothing more of it is read."""
    monkeypatch.delattr(trimesh, "load_scene")
    for kind in ("obj", "glb", "ply", "stl"):
        assert "is larger than 64 MiB" in complaint(read_mesh, sparse(tmp_path / f"a.{kind}", 2 ** 40), "a")
    path = sparse(tmp_path / "b.stl", 84 + 50 * 1_100_000)
    with path.open("r+b") as file:
        file.seek(80)
        file.write(struct.pack("<I", 1_100_000))
    assert "it has more than 1000000 faces: reduce it" in complaint(read_mesh, path, "a")
    (tmp_path / "c.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "f 1 2 3\n" * 1_000_001)
    assert "it has more than 1000000 faces: reduce it" in complaint(read_mesh, tmp_path / "c.obj", "a")
    (tmp_path / "c.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf" + " 1" * 1_000_003)
    assert "it has more than 1000000 faces: reduce it" in complaint(read_mesh, tmp_path / "c.obj", "a")


def test_without_the_library_one_line_says_how_to_get_it(tmp_path, monkeypatch):
    solid("box", extents=(0.1, 0.1, 0.1)).export(tmp_path / "a.stl")
    solid("icosphere", subdivisions=6, radius=0.1).export(tmp_path / "b.obj")
    for module, name in (("trimesh", "a.stl"), ("fast_simplification", "b.obj")):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(SaccadeError, match=r"pip install 'saccade\[objects\]'"):
            read_mesh(tmp_path / name, "a")
