"""Says what is in photographs: which objects of a set, where, how far, how sure, and how they are turned."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from rich.text import Text

from saccade.app.look.fitting import LONGEST_PX, Fitted, fitted
from saccade.app.look.relative_map import map_of, places_in
from saccade.app.look.see_picture import draw_look
from saccade.app.look.sights import Look, Sight
from saccade.app.run.registry import AGENTS, agent_of
from saccade.app.run.threads import limit_torch
from saccade.services.perception.core import Model, model_of
from saccade.services.perception.seen import Seen
from saccade.shared.bus.messages import mask_of
from saccade.shared.config import Config, load
from saccade.shared.errors import LINE_LIMIT, SaccadeError, printable
from saccade.shared.files import replace_whole, writing
from saccade.shared.model.drawing import BankPictures, LatentDecoder, drawn
from saccade.shared.model.weights import WITH_LATENTS, Weights, weights_in_use
from saccade.shared.render.objects import names_in_use
from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX, REFERENCE_RANGE_M, pixel_rays, spherical
from saccade.shared.world.photographs import Photograph, read_photograph

UP = (0.0, 1.0, 0.0)  # in the camera's frame: a photograph tells nothing else
VAGUE_RAD = math.pi / 2  # a rotation with a larger deviation tells nothing
# These read ranges from the size in the image alone, as at the training's focal length, whatever the intrinsics are
ONE_FOCAL_LENGTH = ("paper", "posecnn")


class Looker:
    """The networks of an agent, for photographs. Raises SaccadeError if the agent has no networks that find objects, or
    if their weights are missing or damaged."""

    def __init__(self, config: Config, agent: str, *, draw: bool = True) -> None:
        if "perception" not in agent_of(agent).services or config.services.perception is not None:
            able = [name for name, other in AGENTS.items() if "perception" in other.services
                    and load(None, other.preset).services.perception is None]
            raise SaccadeError(f"agent {agent!r} has no networks that find objects in a picture: choose from "
                               f"{', '.join(able)}")
        limit_torch()
        self.names = names_in_use(config.scene)
        self.weights = weights_in_use(config)
        self.model: Model = model_of(self.weights, self.names, config.perception.passes)
        self.square: bool = getattr(self.model, "square", True)  # whether the networks take square images only
        self._draw = {name: artist_of(self.weights, name) for name in self.names if draw}

    def look(self, photo: Photograph) -> Look:
        """Looks at a photograph."""
        image = fitted(photo, square=self.square)
        seen = self.model.see(image.rgb, image.intrinsics_px, UP, alone=True)
        sights = [self._sight(image, seen, k) for k in range(len(self.names))]
        return Look(photo, image, tuple(sorted(sights, key=lambda sight: -sight.presence)))

    def _sight(self, image: Fitted, seen: Seen, k: int) -> Sight:
        range_m = REFERENCE_RANGE_M / float(seen.scale[k])
        if self.weights.architecture in ONE_FOCAL_LENGTH:
            range_m *= image.intrinsics_px[0] / image.rgb.shape[1] * IMAGE_SIZE_PX / INTRINSICS_PX[0]
        grid = mask_of(seen.mask_bits[k])
        name, towards = self.names[k], towards_camera(seen, k, image)
        return Sight(name, float(seen.presence[k]), image.back(seen.pixel[k]), range_m, degrees(towards), grid,
                     drawing_of(self._draw.get(name), seen.latent_mean[k], towards))


def towards_camera(seen: Seen, k: int, image: Fitted) -> NDArray[np.float64] | None:
    """The direction [3] from object k to the camera in the object's frame, by its likeliest rotation. None if the
    networks tell no rotation, or do not know it."""
    if seen.modes:
        if seen.modes[k].deviation_rad[0] > VAGUE_RAD:
            return None
        camera_from_object = seen.modes[k].rotations[0]
    elif seen.camera_from_object is not None:
        camera_from_object = seen.camera_from_object[k, :3, :3]
    else:
        return None
    towards: NDArray[np.float64] = -camera_from_object.T @ pixel_rays(seen.pixel[k], image.intrinsics_px)
    return towards


def degrees(towards: NDArray[np.float64] | None) -> tuple[float, float] | None:
    """Azimuth and elevation of a direction [3] in degrees."""
    if towards is None:
        return None
    azimuth, elevation, _ = spherical(towards, np.zeros(3))
    return math.degrees(azimuth), math.degrees(elevation)


def artist_of(weights: Weights, name: str) -> LatentDecoder | BankPictures | None:
    """What draws an object. None if networks of this architecture draw nothing."""
    if weights.architecture == "open":
        return BankPictures(weights, name)
    return LatentDecoder(weights, name) if weights.architecture in WITH_LATENTS else None


def drawing_of(artist: LatentDecoder | BankPictures | None, latent: NDArray[np.float32],
               towards: NDArray[np.float64] | None) -> NDArray[np.uint8] | None:
    """How the networks imagine an object [64, 64, 3], by its latent pose or by the direction from which it is seen.
    None if nothing draws it, or if that is unknown."""
    if isinstance(artist, LatentDecoder):
        return drawn(artist, latent)
    return None if artist is None or towards is None else artist.picture(towards)


def see(paths: Sequence[Path], config: Config, *, agent: str, intrinsics_px: Sequence[float] | None,
        json_file: Path | None, out: Path | None, console: Console, map_file: Path | None = None) -> int:
    """Looks at photographs and prints what is in each. Returns how many of them could not be read; each of these is one
    line on stderr.

    `json_file` gets the entries of all photographs, the folder `out` a picture for each, and `map_file` a map of the
    objects that they show together (see `relative_map.py`). Raises SaccadeError if the
    networks, the file or the folder cannot be used.
    """
    _require_places(paths, json_file, out, map_file)
    looker = Looker(config, agent, draw=out is not None)
    entries: list[dict[str, Any]] = []
    looks: list[Look] = []
    taken = {os.path.realpath(path) for path in paths}
    failed = 0
    for path in paths:
        try:
            photo = read_photograph(path, intrinsics_px, longest_px=LONGEST_PX)
        except SaccadeError as error:
            failed += 1
            print(f"saccade: {error}", file=sys.stderr)
            continue
        look = looker.look(photo)
        tell(look, console)
        if map_file is not None:
            looks.append(look)
        if json_file is not None:
            entries += look.entries()
        if out is not None:
            target = _name_in(out, path, taken)
            draw_look(look, target)
            _say(console, f"written to {target}")
    if json_file is not None:
        _write(json_file, entries, "results", console)
    if map_file is not None:
        _map(looks, map_file, console)
    return failed


def _map(looks: Sequence[Look], file: Path, console: Console) -> None:
    """Prints and writes the map of what photographs show together."""
    found, names = map_of([places_in(look) for look in looks]), [str(look.photo.path) for look in looks]
    for name, place in sorted(found.places.items()):
        right, up, back = place
        _say(console, f"{name}: {right:.2f} m to the right, {up:.2f} up, {-back:.2f} ahead of the first camera")
    for k, why in found.why_not.items():
        _say(console, f"{names[k]} is not in the map: {why}")
    _say(console, found.worth(len(looks)))
    _write(file, found.entry(names), "map", console)


def _write(path: Path, content: Any, what: str, console: Console) -> None:
    with writing(path, what):
        replace_whole(path, (json.dumps(content, separators=(",", ":")) + "\n").encode())
    _say(console, f"written to {path}")


def tell(look: Look, console: Console) -> None:
    """Prints what is seen in a photograph, and what is not."""
    photo, seen = look.photo, [sight for sight in look.sights if sight.is_seen]
    width, height = photo.size_px
    wrong = "; if it is another one, the ranges are wrong by the same factor" if photo.assumed else ""
    _say(console, f"{photo.path} ({width}x{height} pixels): {photo.told}{wrong}")
    if seen:
        turned = any(sight.view_deg for sight in seen)
        table = Table(*("object", "presence", "pixel", "range (m)"), *(("azimuth, elevation (degrees)",) * turned))
        for sight in seen:
            view = ("" if sight.view_deg is None else "{:.0f}, {:.0f}".format(*sight.view_deg),) * turned
            table.add_row(Text(sight.name), f"{sight.presence:.2f}", "{:.0f}, {:.0f}".format(*sight.pixel),
                          f"{sight.range_m:.2f}", *view)
        console.print(table)
    unseen = ", ".join(f"{sight.name} ({sight.presence:.2f})" for sight in look.sights if not sight.is_seen)
    if unseen:
        _say(console, f"not seen (presence): {unseen}")


def _say(console: Console, text: str) -> None:
    console.print(Text(printable(text, LINE_LIMIT)), soft_wrap=True)


def _require_places(paths: Sequence[Path], json_file: Path | None, out: Path | None, map_file: Path | None) -> None:
    """Checks before anything is computed that results can be written, and that no photograph is written over."""
    if out is not None:
        with writing(out, "folder of pictures"):
            out.mkdir(parents=True, exist_ok=True)
    for option, file in (("--json", json_file), ("--map", map_file)):
        if file is None:
            continue
        if os.path.realpath(file) in {os.path.realpath(path) for path in paths}:
            raise SaccadeError(f"{option} {file} is one of the photographs: name another file")
        if file.is_dir() or not file.parent.is_dir():
            raise SaccadeError(f"{option} {file} cannot be written: name a file in a folder that is there")


def _name_in(folder: Path, path: Path, taken: set[str]) -> Path:
    """A file in the folder for the picture of a photograph. It is none of the photographs, and of no other one."""
    number = 1
    while True:
        name = folder / f"{path.stem}.seen{'' if number == 1 else f'-{number}'}.png"
        if os.path.realpath(name) not in taken:
            taken.add(os.path.realpath(name))
            return name
        number += 1
