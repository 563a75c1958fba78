"""Meshes, textures, images and poses that are damaged, huge or no files: one line says so, and nothing blocks."""

from __future__ import annotations

import contextlib
import json
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from saccade.services.camera import sources, video
from saccade.services.camera.poses import MAX_POSES, read_poses
from saccade.services.camera.sources import Folder, open_source
from saccade.shared.errors import SaccadeError
from saccade.shared.render import mesh
from saccade.shared.render.mesh import read_obj, read_texture
from saccade.shared.world import images
from saccade.shared.world.goal_image import read_goal_image
from saccade.shared.world.images import image_size, read_image
from saccade.tests.hostile import MANY, complaint, not_files, sparse

POINTS = "v 0 0 0\nv 0 0 1\nv 0 1 0\nvt 0 0\nvt 0 1\nvt 1 0\n"
SOLID = "v 1 0 0\n" + POINTS + "f 1/1 2/2 3/3\nf 1/1 2/2 4/3\nf 1/1 3/2 4/3\nf 2/1 3/2 4/3\n"
MESHES = {
    "index of 2^63": POINTS + "f 1/1 2/2 9223372036854775808/3", "index of -2^63": POINTS + f"f 1/1 2/2 {-2 ** 63}/3",
    "index 0": POINTS + "f 1/1 2/2 0/3", "relative": POINTS + "f 1/1 2/2 -9/3",
    "relative texel": POINTS + "f 1/1 2/2 3/-9",
    "digits": POINTS + "f 1/1 2/2 " + "9" * 5000 + "/3", "nan": "v nan 0 0\n" + POINTS + "f 1/1 2/2 3/3",
    "far": "v 1e300 0 0\n" + POINTS + "f 1/1 2/2 3/3", "texel": "vt 1e30 0\n" + POINTS + "f 1/1 2/2 3/3",
    "square": POINTS + "f 1/1 2/2 3/3 1/1", "no texel": POINTS + "f 1 2 3", "word": "v a b c\n", "empty": "",
    "short": "v 0 0\n", "points alone": POINTS,
    "one triangle": POINTS + "f 1/1 2/2 3/3", "one point": POINTS + "f 1/1 1/1 1/1",
    "a plane": "v 0 1 1\n" + POINTS + "f 1/1 2/2 3/3\nf 1/1 2/2 4/3\nf 1/1 3/2 4/3"}


def scan(folder: Path, text: str = SOLID) -> Path:
    (folder / "textured.obj").write_text(text)
    Image.new("RGB", (8, 8)).save(folder / "texture_map.png")
    return folder


@pytest.mark.parametrize("text", MESHES.values(), ids=MESHES)
def test_a_damaged_mesh_is_refused(tmp_path, text):
    told = complaint(read_obj, scan(tmp_path, text), "can")
    assert "textured.obj is damaged" in told
    assert "int too big" not in told


def test_a_mesh_is_a_text_of_some_size(tmp_path, monkeypatch):
    assert len(read_obj(scan(tmp_path), "can").faces) == 4
    monkeypatch.setattr(mesh, "MAX_COUNT", 5)
    for line in ("v 0 0 0\n", "vt 0 0\n", "f 1/1 1/1 1/1\n"):
        scan(tmp_path, POINTS + line * 6)
        assert "more than 5 vertices or faces" in complaint(read_obj, tmp_path, "can")
    (tmp_path / "textured.obj").write_bytes(b"v 0 0 0 \xff")
    assert "is damaged" in complaint(read_obj, tmp_path, "can")
    sparse(tmp_path / "textured.obj", 2 ** 40)
    assert "is larger than 64 MiB" in complaint(read_obj, tmp_path, "can")


def test_a_mesh_of_many_faces_is_refused_while_it_is_read(tmp_path):
    """Ten million faces took 5 GB before they were refused: it stops at the first that is too much."""
    read = 0

    def lines():
        nonlocal read
        yield POINTS
        while True:
            read += 1
            yield "f 1/1 2/2 3/3"

    with pytest.raises(ValueError, match="more than 1000000 vertices or faces"):
        mesh._parse_obj(lines())
    assert read == mesh.MAX_COUNT + 1


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(*between: bytes, width: int = 8, height: int = 8, pixels: bytes | None = None) -> bytes:
    """A grey picture in RGB, with other chunks in it; its header may promise more than there is."""
    pixels = zlib.compress(bytes((1 + 3 * 8) * 8)) if pixels is None else pixels
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(between) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


BOMB = zlib.compress(bytes(80 * 2 ** 20))
IMAGES = {
    "profile": png(chunk(b"iCCP", b"p\0\0" + BOMB)), "text": png(chunk(b"zTXt", b"t\0\0" + BOMB)),
    "many pixels": png(width=9000, height=9000), "very many": png(width=12_000, height=12_000),
    "a bomb": png(width=2 ** 31 - 1, height=2 ** 31 - 1), "cut": png()[:-40], "no pixels": png(pixels=b""),
    "broken pixels": png(pixels=b"x" * 9), "zeros": bytes(100), "empty": b"",
    "jpeg's head": b"\xff\xd8\xff\xe0\0\x10JFIF",
    "postscript": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n"}


@pytest.mark.parametrize("data", IMAGES.values(), ids=IMAGES)
def test_a_hostile_image_is_refused(tmp_path, recwarn, data):
    """As a camera's image, as a goal image and as a texture."""
    path = tmp_path / "texture_map.png"
    path.write_bytes(data)
    for action, given in ((read_image, path), (read_goal_image, path), (read_texture, tmp_path)):
        assert str(path) in complaint(action, given)
    assert not recwarn.list


def test_a_good_image_is_read(tmp_path):
    (tmp_path / "texture_map.png").write_bytes(png())
    assert read_image(tmp_path / "texture_map.png").shape == (8, 8, 3)
    assert read_texture(tmp_path).shape == (8, 8, 3)


def test_broken_exif_is_refused_or_ignored(tmp_path):
    """Whatever Pillow makes of it, nothing but an image or a SaccadeError comes out."""
    rng, path = np.random.default_rng(0), tmp_path / "a.jpg"
    for _ in range(50):
        exif = b"Exif\0\0MM\0*\0\0\0\x08" + rng.integers(0, 256, 60, np.uint8).tobytes()
        Image.new("RGB", (8, 8)).save(path, exif=exif)
        for action in (read_image, image_size):
            with contextlib.suppress(SaccadeError):
                action(path)


@pytest.mark.parametrize("action", [read_image, image_size, read_goal_image, read_poses])
def test_images_and_poses_are_regular_files_of_some_size(tmp_path, action):
    for path in not_files(tmp_path).values():
        assert "cannot be read (it is a" in complaint(action, path)
    limit = images.MAX_FILE_BYTES // 2 ** 20 if action is not read_poses else 64
    assert f"larger than {limit} MiB" in complaint(action, sparse(tmp_path / "large", 2 ** 40))


@pytest.mark.parametrize("kind", ["a FIFO", "a socket"])
def test_what_is_no_file_in_a_folder_of_images_is_named(tmp_path, kind):
    (tmp_path / "a.png").write_bytes(png())
    path = not_files(tmp_path, ".png")[kind]
    for other in set(tmp_path.iterdir()) - {path, tmp_path / "a.png"}:
        other.unlink()
    assert f"{path} cannot be read (it is {kind}, not a file)" in complaint(Folder, tmp_path)


def test_a_source_that_is_no_file_is_refused(tmp_path):
    paths = not_files(tmp_path)
    for kind in ("a FIFO", "a socket", "a device"):
        assert "is neither a folder nor a file" in complaint(open_source, str(paths[kind]))
    for text in ("a" * 5000, "a\0b"):
        assert "is not there" in complaint(open_source, text)


def test_a_folder_of_too_many_entries_is_refused(tmp_path, monkeypatch):
    """It stops at the first that is too much, and opens none of them."""
    for k in range(6):
        (tmp_path / f"{k}.png").touch()
    monkeypatch.setattr(sources, "MAX_IMAGES", 5)
    assert "more than 5 images" in complaint(Folder, tmp_path)
    monkeypatch.setattr(sources, "MAX_ENTRIES", 3)
    assert "or 3 entries" in complaint(Folder, tmp_path)


def test_a_video_of_too_many_pixels_is_refused_by_its_header(tmp_path, monkeypatch):
    path = tmp_path / "a.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))
    writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    assert open_source(str(path)).size_px == (64, 48)
    monkeypatch.setattr(video, "MAX_PIXELS", 64 * 48 - 1)
    monkeypatch.setattr(video, "_rgb", None)  # nothing is made of a frame
    assert "has 64x48 pixels, more than" in complaint(open_source, str(path))


POSE = json.dumps(np.eye(4).tolist())
POSES = {
    "deep": '{"index": 1, "world_from_camera": ' + "[" * 2000, "deep value": '{"index": ' + "[" * 60 + "]" * 60 + "}",
    "deep image": '{"image": ' + "[" * 60 + "]" * 60 + f', "world_from_camera": {POSE}}}',
    "far": '{"index": 1, "world_from_camera": [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}',
    "far in TUM": "0 1e300 0 0 0 0 0 1", "huge index": f'{{"index": {10 ** 400}, "world_from_camera": {POSE}}}',
    "huge time": f'{{"time_s": {10 ** 400}, "world_from_camera": {POSE}}}', "zeros": "\0" * 100,
    "texts": '{"index": 1, "world_from_camera": ["' + "x" * 3000 + '", 1, 2, 3]}',
    "twice": f'{{"index": 1, "index": 1, "world_from_camera": {POSE}}}', "long": "0 " * MANY,
    "control codes": f'{{"\\u001b[31m\\ud800": 1, "world_from_camera": {POSE}}}'}


@pytest.mark.parametrize("text", POSES.values(), ids=POSES)
def test_hostile_poses_are_refused(tmp_path, text):
    (tmp_path / "p").write_text(text)
    assert f"{tmp_path / 'p'}:1: " in complaint(read_poses, tmp_path / "p")


def test_poses_are_told_without_control_codes(tmp_path):
    """Their names are in the notes of a camera, which are messages."""
    (tmp_path / "p").write_text(f'{{"image": "\\ud800\\u001b[31m", "world_from_camera": {POSE}}}')
    assert "\\ud800\\x1b[31m" in str(read_poses(tmp_path / "p"))
    assert str(read_poses(tmp_path / "p")).isprintable()


def test_too_many_poses_are_refused(tmp_path):
    (tmp_path / "p").write_text("1\n" * (MAX_POSES + 2))
    assert f"more than {MAX_POSES} poses" in complaint(read_poses, tmp_path / "p")
