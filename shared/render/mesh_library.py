"""Reads GLB, glTF, PLY and STL with the library trimesh. What a file says of its size is checked before, so that no
file makes the library fill the memory, and the library gets no other file than those in the mesh's folder."""

from __future__ import annotations

import io
import logging
import re
import struct
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from saccade.shared.errors import SaccadeError, told
from saccade.shared.files import read_bytes
from saccade.shared.render.mesh import MAX_FILE_BYTES
from saccade.shared.render.mesh_gltf import Gltf, read_gltf_header
from saccade.shared.render.mesh_parts import (
    EXPORT_AGAIN,
    GREY,
    MAX_FACES,
    MAX_IMAGES,
    TOO_MANY,
    Folder,
    Loaded,
    Part,
    coloured,
    decoded,
)

NEEDS = "reading this kind of mesh needs the library trimesh: pip install 'saccade[objects]'"


class _Files(Mapping[str, bytes]):
    """What the library asks for the files that a mesh names."""

    def __init__(self, folder: Folder):
        self.folder = folder

    def __getitem__(self, name: str) -> bytes:
        return self.folder.read(unquote(name), "file")

    def __iter__(self) -> Iterator[str]:
        return iter(())

    def __len__(self) -> int:
        return 0


def read_with_library(path: Path, folder: Folder) -> Loaded:
    """Reads a GLB, glTF, PLY or STL file. Raises SaccadeError if something is missing or damaged."""
    data = read_bytes(path, "mesh", EXPORT_AGAIN, MAX_FILE_BYTES)
    kind = path.suffix[1:].lower()
    try:
        if kind in ("glb", "gltf"):
            return _read_gltf(data, kind, path, folder)
        return _read_ply(data, path, folder) if kind == "ply" else _read_stl(data, path, folder)
    except SaccadeError:
        raise
    except Exception as error:  # the library raises many kinds for files that are damaged or made to harm
        why = f"it lacks {error}" if isinstance(error, KeyError) else str(error) or type(error).__name__
        raise SaccadeError(f"mesh {path} is damaged ({why}): {EXPORT_AGAIN}") from error


def _loaded(data: bytes, kind: str, folder: Folder) -> Iterator[tuple[NDArray[np.float64], Any, Any]]:
    """Gives the corners [F, 3, 3] of every part, its faces [F, 3] and what it looks like."""
    try:
        import trimesh
    except ImportError as error:
        raise SaccadeError(NEEDS) from error
    logging.getLogger("trimesh").addHandler(logging.NullHandler())  # what it notes would stand on the terminal
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False,
                                   resolver=_Files(folder))
        for node in scene.graph.nodes_geometry:
            matrix, name = scene.graph[node]
            shape = scene.geometry[name]
            if not isinstance(shape, trimesh.Trimesh) or len(shape.faces) == 0:
                continue
            vertices, faces = np.asarray(shape.vertices, dtype=np.float64), np.asarray(shape.faces)
            if faces.min() < 0 or faces.max() >= len(vertices):
                raise ValueError("a face refers to a vertex that is not there")
            corners = (vertices @ matrix[:3, :3].T + matrix[:3, 3])[faces]
            turned_over = np.linalg.det(matrix[:3, :3]) < 0  # a mirrored part shows its inner side otherwise
            order = [0, 2, 1] if turned_over else [0, 1, 2]
            yield corners[:, order], faces[:, order], shape.visual


def _read_stl(data: bytes, path: Path, folder: Folder) -> Loaded:
    count = struct.unpack("<I", data[80:84])[0] if len(data) >= 84 else 0
    if len(data) != 84 + 50 * count:
        count = data.lower().count(b"endfacet")
    if count > MAX_FACES:
        raise SaccadeError(f"mesh {path} cannot be used: {TOO_MANY}")
    parts = [coloured(corners, GREY) for corners, _, _ in _loaded(data, "stl", folder)]
    return Loaded(parts, ["STL files hold no colours, so the object is grey."], "STL")


def _read_ply(data: bytes, path: Path, folder: Folder) -> Loaded:
    header = data[:data.find(b"end_header") + 1][:65536].decode("latin-1")
    found = re.findall(r"^element\s+(\S+)\s+(\d{1,18})\s*$", header, re.MULTILINE)
    counts = {name: int(count) for name, count in found}
    if b"end_header" not in data[:65536]:
        raise ValueError("its header does not end")
    if not counts.get("face"):
        raise SaccadeError(f"mesh {path} has no faces, only points or nothing: {EXPORT_AGAIN}, with faces")
    if max(counts.values()) > 3 * MAX_FACES or counts["face"] > MAX_FACES:
        raise SaccadeError(f"mesh {path} cannot be used: {TOO_MANY}")
    if sum(counts.values()) > len(data):
        raise ValueError("it ends too early")
    named = re.search(r"^comment\s+TextureFile\s+(.*\S)", header, re.MULTILINE | re.IGNORECASE)
    image = folder.image(named[1]) if named else None
    notes: list[str] = []
    try:
        parts = [_ply_part(*one, image, notes) for one in _loaded(data, "ply", folder)]
    except ValueError as error:
        if "unexpected length" in str(error):
            raise ValueError("it ends too early or has faces of different numbers of corners, which only the ASCII "
                             "variant may have") from error
        raise
    return Loaded(parts, notes, "PLY")


def _ply_part(corners: NDArray, faces: NDArray, visual: Any, image: Image.Image | None, notes: list[str]) -> Part:
    uv = getattr(visual, "uv", None)
    if uv is not None and image is not None:
        return Part(corners, np.asarray(uv, dtype=np.float64)[faces], image)
    if getattr(visual, "kind", None) == "face":
        return coloured(corners, visual.face_colors[:, None, :3])
    if getattr(visual, "kind", None) == "vertex":
        return coloured(corners, visual.vertex_colors[:, :3][faces])
    notes.append("The mesh has no colour, so it is grey.")
    return coloured(corners, GREY)


def _read_gltf(data: bytes, kind: str, path: Path, folder: Folder) -> Loaded:
    header = read_gltf_header(data, kind, path)
    for named in header.textures:  # with a better message than the library's, which leaves out what it does not find
        if not named.startswith("data:"):
            folder.image(named)
    notes: list[str] = list(header.notes)
    images: dict[Any, Image.Image] = {}
    parts = [_gltf_part(*found, header, images, path, notes) for found in _loaded(header.data, kind, folder)]
    # The library trimesh writes the axes of any file as they are, so its files do not keep to the definition.
    return Loaded(parts, notes, "glTF", unit=("m", "because glTF files are in metres by definition"), likely_up="y",
                  up=None if header.by_trimesh else ("y", "because glTF files have y up by definition"))


def _gltf_part(corners: NDArray, faces: NDArray, visual: Any, header: Gltf, images: dict[Any, Image.Image], path: Path,
               notes: list[str]) -> Part:
    material, uv = getattr(visual, "material", None), getattr(visual, "uv", None)
    factor = getattr(material, "baseColorFactor", None)
    factor = (255, 255, 255) if factor is None else tuple(int(number) for number in np.asarray(factor)[:3])
    texture = getattr(material, "baseColorTexture", None)
    if texture is None and (name := header.textured.get(getattr(material, "name", ""))) is not None:
        raise SaccadeError(f"texture of the material {told(name)} in mesh {path} is damaged or of an unknown "
                           f"kind: {EXPORT_AGAIN}, with PNG or JPEG textures")
    if texture is not None and uv is not None:
        key = (id(texture), factor)
        if key not in images:
            if len(images) == MAX_IMAGES:
                raise ValueError(f"it has more than {MAX_IMAGES} textures")
            images[key] = _tinted(decoded(lambda: texture, f"in mesh {path}"), factor, header, notes)
        return Part(corners, np.asarray(uv, dtype=np.float64)[faces], images[key])
    colours = getattr(visual, "vertex_attributes", {}).get("color")
    if colours is None and getattr(visual, "kind", None) == "vertex":
        colours = visual.vertex_colors
    if colours is None and material is None:
        notes.append("The mesh has no colour, so it is grey.")
        return coloured(corners, GREY)
    linear = np.asarray(factor) / 255.0
    if colours is not None:
        linear = linear * _fractions(np.asarray(colours))[:, :3][faces]
    return coloured(corners, header.bytes_of(linear))


def _fractions(colours: NDArray) -> NDArray[np.float64]:
    return colours / float(np.iinfo(colours.dtype).max) if colours.dtype.kind in "ui" else colours.astype(np.float64)


def _tinted(image: Image.Image, factor: tuple[int, ...], header: Gltf, notes: list[str]) -> Image.Image:
    """The texture times the material's colour, as glTF defines it: in linear light."""
    if min(factor) == 255:
        return image
    if header.by_trimesh and factor == (102, 102, 102):
        notes.append("The file darkens its texture to 0.4, which the library trimesh writes for a material without a "
                     "colour, so the texture is taken as it is.")
        return image
    levels = np.arange(256) / 255.0
    linear = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    table = [int(level) for number in factor for level in header.encoded(linear * number / 255.0)]
    return image.point(table)
