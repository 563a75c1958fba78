"""The views of the objects. They are rendered once per training run and kept in its folder."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from saccade.shared.errors import SaccadeError
from saccade.shared.files import writing
from saccade.shared.render.objects import load_mesh
from saccade.shared.render.views import ObjectViews, default_shells_m, render_views
from saccade.training.settings import TrainingConfig


def path_of(run_dir: Path, name: str) -> Path:
    """The file with the views of one object."""
    return run_dir / "views" / f"{name}.npz"


def render_missing(run_dir: Path, config: TrainingConfig, progress: Callable[[str, int, int], None]) -> None:
    """Renders the views that do not exist yet. `progress` is called with (object, views done, number of views)."""
    for name in config.names:
        path = path_of(run_dir, name)
        if path.is_file():
            continue
        mesh = load_mesh(config.objects, name)
        total = config.views * len(default_shells_m(mesh.size_m))

        def show(done: int, name: str = name, total: int = total) -> None:
            progress(name, done, total)

        views = render_views(mesh, count=config.views, progress=show)
        temporary = path.with_suffix(".tmp.npz")
        with writing(path, "views"):
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                np.savez_compressed(temporary, tiles=views.tiles, shells_m=np.array(views.shells_m),
                                    azimuth_rad=views.azimuth_rad, elevation_rad=views.elevation_rad,
                                    crop_side_m=views.crop_side_m, size_m=views.size_m)
                os.replace(temporary, path)
            finally:
                temporary.unlink(missing_ok=True)


def load_views(run_dir: Path, name: str) -> ObjectViews:
    """Reads the views of one object. Raises SaccadeError if they are missing or damaged."""
    path = path_of(run_dir, name)
    try:
        with np.load(path, allow_pickle=False) as file:
            return ObjectViews(name, file["tiles"], tuple(float(x) for x in file["shells_m"]), file["azimuth_rad"],
                               file["elevation_rad"], float(file["crop_side_m"]), file["size_m"])
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise SaccadeError(f"views {path} are missing or damaged ({error}): remove the file, they are rendered again") \
            from error
