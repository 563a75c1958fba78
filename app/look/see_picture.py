"""Draws what networks saw in a photograph: outlines, names, presences, and how they imagine each object."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from saccade.app.look.sights import Look, Sight
from saccade.app.palette import COLOURS
from saccade.shared.files import replace_whole, writing
from saccade.shared.world.images import Size

SHOWN_PX = (640, 1280)  # limits of the picture's longer side
OUTLINE_PX, TEXT_PX, DRAWING_PX, CROSS_PX = 2, 16, 96, 8


def draw_look(look: Look, out: Path) -> None:
    """Draws the photograph with the objects that are seen, as a PNG file. The same look gives the same bytes. Raises
    SaccadeError if the file cannot be written."""
    rgb = look.photo.rgb
    share = float(np.clip(max(rgb.shape), *SHOWN_PX)) / max(rgb.shape)
    size_px = round(rgb.shape[1] * share), round(rgb.shape[0] * share)
    picture = Image.fromarray(rgb).resize(size_px, Image.Resampling.BILINEAR)
    colours = {name: COLOURS[k % len(COLOURS)] for k, name in enumerate(sorted(s.name for s in look.sights))}
    for sight in reversed([sight for sight in look.sights if sight.is_seen]):  # the surest last, on top
        _draw_sight(picture, look, sight, colours[sight.name])
    drawn = io.BytesIO()
    picture.save(drawn, format="PNG")
    with writing(out, "picture"):
        replace_whole(out, drawn.getvalue())


def _draw_sight(picture: Image.Image, look: Look, sight: Sight, colour: str) -> None:
    mask = look.mask(sight, picture.size)
    picture.paste(colour, (0, 0), Image.fromarray(outline(mask, OUTLINE_PX)))
    scale = np.array(picture.size) / look.photo.size_px
    u, v = np.clip(np.array(sight.pixel) * scale, 0, np.array(picture.size) - 1)
    draw = ImageDraw.Draw(picture)
    draw.line([(u - CROSS_PX, v), (u + CROSS_PX, v)], fill=colour, width=OUTLINE_PX)
    draw.line([(u, v - CROSS_PX), (u, v + CROSS_PX)], fill=colour, width=OUTLINE_PX)
    left, top, right, _ = _box(mask) or (u - CROSS_PX, v - CROSS_PX, u + CROSS_PX, v + CROSS_PX)
    if sight.drawing is not None:
        x = right + OUTLINE_PX if right + DRAWING_PX < picture.width else left - DRAWING_PX - OUTLINE_PX
        x, y = _within(picture.size, x, top, DRAWING_PX, DRAWING_PX)
        picture.paste(Image.fromarray(sight.drawing).resize((DRAWING_PX, DRAWING_PX)), (x, y))
        draw.rectangle((x, y, x + DRAWING_PX - 1, y + DRAWING_PX - 1), outline=colour)
    _label(draw, picture.size, f"{sight.name} {sight.presence:.2f}", left, top - TEXT_PX - 6, colour)


def _label(draw: ImageDraw.ImageDraw, size_px: Size, text: str, x: float, y: float, colour: str) -> None:
    font = ImageFont.load_default(TEXT_PX)
    width, height = int(draw.textlength(text, font)) + 6, TEXT_PX + 4
    left, top = _within(size_px, x, y, width, height)
    draw.rectangle((left, top, left + width, top + height), fill=colour)
    draw.text((left + 3, top), text, fill="white", font=font)


def _within(size_px: Size, x: float, y: float, width: int, height: int) -> tuple[int, int]:
    """The corner at which a box lies within the picture, near (x, y)."""
    return max(0, min(int(x), size_px[0] - width - 1)), max(0, min(int(y), size_px[1] - height - 1))


def _box(mask: NDArray[np.bool_]) -> tuple[int, int, int, int] | None:
    """Left, top, right and bottom of a mask. None if it is empty."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return None
    return int(columns[0]), int(rows[0]), int(columns[-1]), int(rows[-1])


def outline(mask: NDArray[np.bool_], width_px: int) -> NDArray[np.bool_]:
    """The pixels of a mask [H, W] within `width_px` of its border. The border of the picture is none."""
    inner = mask
    for _ in range(width_px):
        around = np.pad(inner, 1, mode="edge")
        inner = inner & around[:-2, 1:-1] & around[2:, 1:-1] & around[1:-1, :-2] & around[1:-1, 2:]
    return mask & ~inner
