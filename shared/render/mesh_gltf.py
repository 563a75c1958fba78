"""The header of a glTF or GLB file: what it is made of, and whether it is as small as it seems. A few bytes of it can
ask for gigabytes of zeros, or for one part a million times."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from saccade.shared.errors import SaccadeError, told
from saccade.shared.files import parse_json
from saccade.shared.render.mesh import MAX_FILE_BYTES
from saccade.shared.render.mesh_parts import EXPORT_AGAIN, MAX_FACES, TOO_MANY

MAX_NODES = 4096  # of the scene; also of parts, materials and the like
MAX_DEPTH = 64  # of nodes within one another
MOVED = ("The file moves, turns or scales its textures (KHR_texture_transform), which is not followed: look whether "
         "they are in place.")
_NUMBERS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}  # of one item; others have up to 16
_FLOAT = 5126
_JSON = 0x4E4F534A  # the kind of GLB's first chunk
_TRIANGLES, _STRIP = 4, 5
# What a file may ask of its readers: this one understands it, or shows the same shape and colours without it.
_HARMLESS = {"KHR_materials_unlit", "KHR_materials_pbrSpecularGlossiness", "EXT_texture_webp"}


@dataclass(frozen=True)
class Gltf:
    """What the header says: files of textures, the materials with a texture, and which program wrote it.

    `data` is the file with its materials' numbers as their names. `textured` has the true names by these.
    """

    data: bytes
    textures: tuple[str, ...]
    textured: dict[str, str]
    by_trimesh: bool
    notes: tuple[str, ...]

    def bytes_of(self, colours: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Colours of materials and vertices as 0 to 255. They are in linear light, but the library trimesh writes them
        as they are in images."""
        return np.clip(colours * 255.0, 0, 255).round().astype(np.uint8) if self.by_trimesh else self.encoded(colours)

    def encoded(self, linear: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Linear light from 0 to 1 as images hold it, sRGB from 0 to 255."""
        linear = np.clip(np.nan_to_num(linear), 0.0, 1.0)
        curved = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        return (curved * 255.0).round().astype(np.uint8)


def read_gltf_header(data: bytes, kind: str, path: Path) -> Gltf:
    """Reads and checks the header. Raises SaccadeError or, if the file is damaged, ValueError, KeyError, IndexError or
    TypeError."""
    text, rest = data, b""
    if kind == "glb":
        magic, _, _, length, chunk = struct.unpack("<4s4I", data[:20])
        if magic != b"glTF" or chunk != _JSON:
            raise ValueError("it does not begin as a GLB file does")
        text, rest = data[20:20 + length], data[20 + length:]
    tree = parse_json(text.decode("utf-8-sig"))
    if not isinstance(tree, dict):
        raise ValueError("its header is no map")
    _require_known(tree, path)
    _require_small(tree)
    if _faces(tree) > MAX_FACES:
        raise SaccadeError(f"mesh {path} cannot be used: {TOO_MANY}")
    files, textured = _textures(tree)
    for number, material in enumerate(tree.get("materials", [])):
        material["name"] = str(number)  # names may be missing, or the same
    by_trimesh = "trimesh" in str(tree.get("asset", {}).get("generator", ""))
    moved = "KHR_texture_transform" in tree.get("extensionsUsed", [])
    return Gltf(_written(tree, kind, rest), files, textured, by_trimesh, (MOVED,) if moved else ())


def _written(tree: dict[str, Any], kind: str, rest: bytes) -> bytes:
    text = json.dumps(tree).encode()
    if kind != "glb":
        return text
    text += b" " * (-len(text) % 4)
    return struct.pack("<4s4I", b"glTF", 2, 20 + len(text) + len(rest), len(text), _JSON) + text + rest


def _require_known(tree: dict[str, Any], path: Path) -> None:
    unknown = set(tree.get("extensionsRequired", [])) - _HARMLESS - {"KHR_texture_transform"}
    if unknown:
        raise SaccadeError(f"mesh {path} needs the glTF extensions {told(', '.join(sorted(map(str, unknown))))}, which "
                           f"are not supported: {EXPORT_AGAIN}, without compression")


def _require_small(tree: dict[str, Any]) -> None:
    for name in ("nodes", "meshes", "accessors", "bufferViews", "buffers", "images", "materials", "textures", "scenes"):
        if len(tree.get(name, [])) > MAX_NODES:
            raise ValueError(f"it has more than {MAX_NODES} {name}")
    accessors = tree.get("accessors", [])
    for accessor in accessors:
        if not isinstance(accessor["count"], int) or not 0 <= accessor["count"] <= 3 * MAX_FACES:
            raise ValueError("an accessor has no count or one that is too large")
        if "sparse" in accessor:
            raise ValueError("it has sparse accessors, which are not supported")
    if sum(accessor["count"] * _NUMBERS.get(accessor["type"], 16) for accessor in accessors) > 60 * MAX_FACES:
        raise ValueError("its accessors are too large")
    if sum(int(view["byteLength"]) for view in tree.get("bufferViews", [])) > 2 * MAX_FILE_BYTES:
        raise ValueError("its views of the data are too large")
    for mesh in tree.get("meshes", []):
        for primitive in mesh["primitives"]:
            texcoords = primitive["attributes"].get("TEXCOORD_0")
            if texcoords is not None and accessors[texcoords]["componentType"] != _FLOAT:
                raise ValueError("its texture coordinates are whole numbers, which are not supported")


def _faces(tree: dict[str, Any]) -> int:
    """How many triangles the scene has. A part counts as often as the scene shows it, and at least once."""
    accessors, sizes = tree.get("accessors", []), []
    for mesh in tree.get("meshes", []):
        count = 0
        for primitive in mesh["primitives"]:
            mode, points = primitive.get("mode", _TRIANGLES), accessors[primitive["attributes"]["POSITION"]]["count"]
            if mode in (_TRIANGLES, _STRIP):
                corners = accessors[primitive["indices"]]["count"] if "indices" in primitive else points
                count += max(corners // 3 if mode == _TRIANGLES else corners - 2, points // 3)
        sizes.append(count)
    nodes = tree.get("nodes", [])
    if sum(len(node.get("children", [])) for node in nodes) > len(nodes):
        raise ValueError("a node has two parents")
    _require_shallow(nodes)
    return max(sum(sizes), sum(sizes[node["mesh"]] for node in nodes if "mesh" in node))


def _require_shallow(nodes: list[dict[str, Any]]) -> None:
    level = set(range(len(nodes)))
    for _ in range(MAX_DEPTH):
        level = {child for number in level for child in nodes[number].get("children", [])}
        if not level:
            return
    raise ValueError(f"its nodes are nested deeper than {MAX_DEPTH} levels")


def _textures(tree: dict[str, Any]) -> tuple[tuple[str, ...], dict[str, str]]:
    """The files of the textures that give colour, and the names of the materials that have such a texture."""
    files, names = [], {}
    for number, material in enumerate(tree.get("materials", [])):
        texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
        if texture is None:
            continue
        names[str(number)] = str(material.get("name", number))
        source = tree["textures"][texture["index"]].get("source")
        uri = tree["images"][source].get("uri") if source is not None else None
        if uri is not None:
            files.append(str(uri) if str(uri).startswith("data:") else unquote(str(uri)))
    return tuple(files), names
