"""The object sets, and where their meshes come from.

The set `pantry` is made by code (`pantry.py`). The set `ycb` is read from the folder that the environment variable
SACCADE_YCB names, or from the user's cache. Any other set is a folder of the user's, in which each object is a folder.
"""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

from saccade.shared.config import SceneConfig, set_folder
from saccade.shared.errors import SaccadeError, told
from saccade.shared.model.object_card import symmetry_in
from saccade.shared.render.mesh import MESH_FILE, Mesh, read_obj
from saccade.shared.render.pantry import PANTRY_NAMES, make_mesh
from saccade.shared.wording import WORLD

YCB_NAMES = ("002_master_chef_can", "003_cracker_box", "004_sugar_box", "005_tomato_soup_can", "006_mustard_bottle")


def ycb_folder() -> Path:
    """The folder with the YCB scans: SACCADE_YCB if it is set, otherwise a folder in the user's cache."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return Path(os.environ.get("SACCADE_YCB", cache / "saccade" / "ycb"))


def names_of(object_set: str) -> tuple[str, ...]:
    """The names of the objects in a set. Raises SaccadeError if the set is not there, or empty."""
    if object_set == "ycb":
        return YCB_NAMES
    if object_set == "pantry":
        return PANTRY_NAMES
    folder = set_folder(object_set)
    assert folder is not None  # as the set is not built in
    names = own_names(folder)
    if not names:
        raise SaccadeError(f"object set {told(object_set)} is not there, or has no objects ({folder}): choose pantry, "
                           "ycb or one of your own, or put a mesh into it with `saccade objects add`")
    return names


def own_names(folder: Path) -> tuple[str, ...]:
    """The names of the objects in the folder of a set of the user's, in their order. None if there is no such
    folder."""
    try:
        entries = sorted(entry.name for entry in folder.iterdir() if (entry / MESH_FILE).is_file())
    except OSError:
        return ()
    return tuple(name for name in entries if re.fullmatch(WORLD, name))


def load_mesh(object_set: str, name: str) -> Mesh:
    """Loads one mesh of a set. Raises SaccadeError if the object is unknown, or if a file is missing or damaged."""
    if name not in names_of(object_set):
        raise SaccadeError(f"object {name!r} is not in {object_set!r}: choose from {', '.join(names_of(object_set))}")
    if object_set == "pantry":
        return make_mesh(name)
    folder = set_folder(object_set)
    if folder is None:
        return read_obj(ycb_folder() / name, name)
    return replace(read_obj(folder / name, name), symmetry=symmetry_in(folder / name))


def names_in_use(config: SceneConfig) -> tuple[str, ...]:
    """The names of the objects that a run uses: all of the set, or the configured ones.

    Raises SaccadeError if a name is not in the set or occurs twice, or if there is none.
    """
    available = names_of(config.objects)
    for name in config.names or ():
        if name not in available:
            choice = ", ".join(available)
            raise SaccadeError(f"scene.names: {name!r} is not in {config.objects!r}: choose from {choice}")
    if config.names is not None and (not config.names or len(set(config.names)) < len(config.names)):
        raise SaccadeError("scene.names: name at least one object, each once")
    return config.names or available
