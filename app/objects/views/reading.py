"""Finds the object in the pictures around it: by its masks, by an alpha channel, or before a plain background."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from saccade.app.objects.views.masks import at_the_border, cleaned, plain_mask
from saccade.app.objects.views.pictures import MOST, NEED, Picture, Told, evenly, pictures_of, straight_mask
from saccade.app.objects.views.view import View
from saccade.services.camera.sources import IMAGE_SUFFIXES
from saccade.shared.errors import SaccadeError
from saccade.shared.world.images import opened_image

FEWEST = 12  # views
USABLE = 0.5  # of the pictures
LONGEST_PX = 448  # of the part of a picture that is kept
MARGIN_PX = 6
NOT_PLAIN, EMPTY, CUT_OFF, NO_MASK = "not plain", "empty", "cut off", "no mask"
_SAID = {
    NOT_PLAIN: "the background is not plain: put the object before and on something of one colour that it does not "
               "have, in even light, or give --masks FOLDER",
    EMPTY: "nothing is seen of the object: see that it differs from the background, and that masks are white where it "
           "is",
    CUT_OFF: "the picture's border cuts something off: keep the whole object in the picture, and nothing else but the "
             "background",
    NO_MASK: "there is no mask of the picture's name in the folder of --masks"}


def views_of(source: Path, told: Told, masks: Path | None) -> list[View]:
    """The views of an object, at most MOST. What is left out is added to the notes. Raises SaccadeError if fewer than
    FEWEST or than half of the pictures are usable, and as `pictures_of` does."""
    if masks is not None and not os.path.isdir(masks):
        raise SaccadeError(f"--masks {masks} is not a folder: give the folder that holds a mask for each picture")
    views: list[View] = []
    wrong: Counter[str] = Counter()
    first: dict[str, str] = {}
    pictures = 0
    for picture in pictures_of(source, told):
        pictures += 1
        found = _view(picture, masks)
        if isinstance(found, View):
            views.append(found)
            if len(views) == 2 * MOST:  # of a video whose end is not known
                views = views[::2]
        else:
            wrong[found] += 1
            first.setdefault(found, picture.name)
    told_wrong = [f"in {count} of {pictures} pictures ({first[why]}{', ...' if count > 1 else ''}) {_SAID[why]}"
                  for why, count in wrong.most_common()]
    if wrong and (len(views) < FEWEST or wrong.total() > (1 - USABLE) * pictures):
        raise SaccadeError(told_wrong[0])
    if len(views) < FEWEST:
        raise SaccadeError(f"{source} has {len(views)} {'picture' if len(views) == 1 else 'pictures'} with a pose, and "
                           f"{FEWEST} are needed, better 60: take them from all around the object")
    told.notes += [f"left out: {line}" for line in told_wrong]
    return [views[k] for k in evenly(len(views), MOST)]


def _view(picture: Picture, masks: Path | None) -> View | str:
    """The part of a picture that shows the object, or what is wrong with it."""
    if masks is not None:
        found = _mask_in(masks, picture)
        if found is None:
            return NO_MASK
        mask = cleaned(found)
    elif picture.mask is not None:
        mask = cleaned(picture.mask)
    else:
        plain = plain_mask(picture.rgb)
        if plain is None:
            return NOT_PLAIN
        mask = plain
    if not mask.any():
        return EMPTY
    return CUT_OFF if at_the_border(mask) else _cut_out(picture, mask)


def _cut_out(picture: Picture, mask: NDArray[np.bool_]) -> View:
    """The part of a picture around the mask, made smaller if it is large."""
    rows, columns = np.nonzero(mask)
    top, left = max(int(rows.min()) - MARGIN_PX, 0), max(int(columns.min()) - MARGIN_PX, 0)
    part = slice(top, int(rows.max()) + MARGIN_PX + 1), slice(left, int(columns.max()) + MARGIN_PX + 1)
    fx, fy, cx, cy = picture.intrinsics_px
    rgb, mask, cx, cy = picture.rgb[part], mask[part], cx - left, cy - top
    share = LONGEST_PX / max(mask.shape)
    if share < 1:
        size = max(1, round(mask.shape[1] * share)), max(1, round(mask.shape[0] * share))
        x, y = size[0] / mask.shape[1], size[1] / mask.shape[0]
        rgb = np.asarray(Image.fromarray(rgb).resize(size, Image.Resampling.BOX))
        mask = np.asarray(Image.fromarray(mask.astype(np.uint8) * 255).resize(size, Image.Resampling.BOX)) > 127
        fx, fy, cx, cy = fx * x, fy * y, cx * x, cy * y
    return View(picture.name, np.array(rgb), np.array(mask), (fx, fy, cx, cy), picture.world_from_camera)


def _mask_in(folder: Path, picture: Picture) -> NDArray[np.bool_] | None:
    """The mask of a picture from the folder. None if there is no such file."""
    name = picture.name.replace(" ", "_")  # those of a video are frame_0.png and so on
    names = (name, *(Path(name).stem + ending for ending in IMAGE_SUFFIXES))
    path = next((folder / each for each in names if (folder / each).is_file()), None)
    if path is None:
        return None
    with opened_image(path, "mask", NEED) as image:
        if image.mode.startswith(("I", "F")):
            raise SaccadeError(f"mask {path} has mode {image.mode}: {NEED}")
        alpha = image.getchannel("A") if image.mode in ("RGBA", "LA") else None
        channel = image.convert("L") if alpha is None or alpha.getextrema()[0] == 255 else alpha
        height, width = picture.rgb.shape[:2]
        if abs(channel.width * height / (channel.height * width) - 1) > 0.02:
            raise SaccadeError(f"mask {path} is {channel.width}x{channel.height} pixels, and its picture has another "
                               "shape: give masks of the pictures' size")
        mask = np.asarray(channel.resize((width, height), Image.Resampling.BOX)) > 127
    return mask if picture.places is None else straight_mask(mask, picture.places)
