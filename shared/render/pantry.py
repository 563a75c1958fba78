"""`pantry`, the built-in object set: five groceries with the sizes of five YCB objects, made by code.

Every object is an outline that is scaled along a vertical profile, with a lid and a base. Its shape says little about
its azimuth. Its label and its lid look different from every azimuth. Azimuth 0 (+x) is the front. The texture atlas
holds the label (at the top, over the whole width), and below it the lid and the base.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from saccade.shared.render.mesh import Mesh

PANTRY_NAMES = ("coffee_can", "cereal_box", "rice_box", "soup_can", "squeeze_bottle")
ATLAS_PX = 1024
_GUTTER_PX = 8  # margin around lid and base in their edge's colour, so that coarse mip levels do not mix regions
_SEGMENTS = 56  # segments around a can; a multiple of 4, so that the extents are exact
_FINE = 2  # pictures are drawn larger by this factor and then averaged

WHITE, BLACK, SILVER, GOLD = (248, 246, 240), (24, 22, 26), (186, 192, 200), (226, 172, 40)
RED, ORANGE, YELLOW, CREAM = (206, 28, 36), (242, 120, 20), (252, 206, 24), (250, 234, 190)
GREEN, LEAF, BLUE, NAVY, SKY = (18, 130, 62), (130, 196, 60), (26, 82, 190), (16, 36, 98), (110, 182, 236)
PURPLE, PLUM, PINK, BROWN, TEAL = (112, 40, 150), (62, 18, 88), (238, 96, 156), (96, 54, 26), (0, 142, 150)

Colour = tuple[int, int, int]
Rectangle = tuple[float, float, float, float, Colour]  # left, top, right, bottom
Steps = Sequence[tuple[float, float]]  # points of a profile: scale of the outline, height in metres


class Art:
    """A picture. Coordinates are fractions of it: x to the right, y down, both 0 to 1.

    Radii and text sizes are fractions of its height.
    """

    def __init__(self, width_px: int, height_px: int, colour: Colour):
        self.width, self.height = width_px * _FINE, height_px * _FINE
        self.image = Image.new("RGB", (self.width, self.height), colour)
        self.draw = ImageDraw.Draw(self.image)

    def rect(self, *rectangles: Rectangle) -> None:
        """Draws filled rectangles. A later one covers an earlier one."""
        for x0, y0, x1, y1, colour in rectangles:
            left, top = x0 * self.width, y0 * self.height
            right, bottom = max(left, x1 * self.width - 1), max(top, y1 * self.height - 1)  # at least a pixel
            self.draw.rectangle((left, top, right, bottom), fill=colour)

    def poly(self, points: ArrayLike, colour: Colour) -> None:
        """Draws a filled polygon with corners [N, 2]."""
        scaled = np.asarray(points, dtype=np.float64) * (self.width, self.height)
        self.draw.polygon([tuple(p) for p in scaled.tolist()], fill=colour)

    def disc(self, x: float, y: float, r: float, colour: Colour, flat: float = 1.0,
             sector_deg: tuple[float, float] = (0, 360)) -> None:
        """Draws an ellipse, `flat` times as tall as wide, or a sector of it (degrees clockwise from the right)."""
        cx, cy, rx, ry = x * self.width, y * self.height, r * self.height, r * flat * self.height
        self.draw.pieslice((cx - rx, cy - ry, cx + rx, cy + ry), *sector_deg, fill=colour)

    def text(self, x: float, y: float, words: str, size: float, colour: Colour, turn_deg: float = 0.0) -> None:
        """Draws bold words centred at (x, y), turned counter-clockwise."""
        font = ImageFont.load_default(size=round(size * self.height))
        bold = max(1, round(size * self.height / 22))
        left, top, right, bottom = font.getbbox(words, stroke_width=bold)
        mask = Image.new("L", (int(right - left) + 2, int(bottom - top) + 2))
        ImageDraw.Draw(mask).text((1 - left, 1 - top), words, font=font, fill=255, stroke_width=bold)
        mask = mask.rotate(turn_deg, Image.Resampling.BICUBIC, expand=True)
        corner = round(x * self.width - mask.width / 2), round(y * self.height - mask.height / 2)
        self.image.paste(colour, corner, mask)

    def barcode(self, x0: float, y0: float, x1: float, y1: float, number: int = 0b1011001110100110111001011) -> None:
        """Draws a white panel with vertical bars, one for each bit 1 of `number`."""
        self.rect((x0, y0, x1, y1, WHITE))
        bits, pad = f"{number:b}", 0.1
        edges = np.linspace(x0 + pad * (x1 - x0), x1 - pad * (x1 - x0), len(bits) + 1)
        for left, right, bit in zip(edges[:-1], edges[1:], bits, strict=True):
            if bit == "1":
                self.rect((left, y0 + pad * (y1 - y0), right, y1 - pad * (y1 - y0), BLACK))

    def table(self, x0: float, y0: float, x1: float, y1: float, rows: int = 8) -> None:
        """Draws a white nutrition table: a heading and lines of different lengths."""
        self.rect((x0, y0, x1, y1, WHITE))
        w, h = x1 - x0, (y1 - y0) / (rows + 2)
        self.rect((x0 + 0.08 * w, y0 + 0.4 * h, x0 + 0.92 * w, y0 + 1.4 * h, BLACK))
        for row in range(rows):
            y = y0 + (row + 1.9) * h
            self.rect((x0 + 0.08 * w, y, x0 + (0.4 + 0.12 * (row * 5 % 4)) * w, y + 0.35 * h, BLACK))
            self.rect((x0 + 0.8 * w, y, x0 + 0.92 * w, y + 0.35 * h, BLACK))

    def bowl(self, x: float, y: float, r: float, colour: Colour, food: Colour, bits: Colour) -> None:
        """Draws a bowl as seen from the front, with its rim at y, full of food with small pieces in it."""
        self.disc(x, y, r, colour, 0.95, (0, 180))
        self.disc(x, y, r, food, 0.34)
        for k in range(7):
            self.disc(x + 0.22 * (k - 3) * r * self.height / self.width, y - (0.16, -0.12)[k % 2] * r, 0.11 * r, bits)


def ellipse(x_m: float, y_m: float) -> NDArray[np.float64]:
    """A closed elliptic outline [_SEGMENTS + 1, 2] (metres) with these extents, counter-clockwise from azimuth -pi."""
    angle = np.linspace(-np.pi, np.pi, _SEGMENTS + 1)
    outline = np.stack([np.cos(angle) * x_m / 2, np.sin(angle) * y_m / 2], axis=1)
    outline[-1] = outline[0]
    return outline


def rectangle(x_m: float, y_m: float) -> NDArray[np.float64]:
    """A closed rectangular outline [5, 2] (metres), counter-clockwise: front (+x), +y side, back and -y side."""
    return np.array([(1, -1), (1, 1), (-1, 1), (-1, -1), (1, -1)]) * (x_m / 2, y_m / 2)


class Shape:
    """An outline [N, 2] (metres) moved along a profile [P, 2] of (scale of the outline, height in metres).

    Lid and base lie `sunk` metres inside the rim. The label covers the outside only.
    """

    def __init__(self, outline: NDArray[np.float64], profile: ArrayLike, sunk: float = 0.0):
        self.outline, self.profile, self.sunk = outline, np.asarray(profile, dtype=np.float64), sunk
        around = np.linalg.norm(np.diff(outline, axis=0), axis=1)
        radius = around.sum() / (2 * np.pi)
        along = np.hypot(np.diff(self.profile[:, 0]) * radius, np.diff(self.profile[:, 1]))
        self.u = np.concatenate([[0], np.cumsum(around)]) / around.sum()
        self.t = np.concatenate([[0], np.cumsum(along)]) / along.sum()
        self.label_px = round(ATLAS_PX * along.sum() / around.sum())
        room = min(ATLAS_PX // 2, ATLAS_PX - self.label_px) - 2 * _GUTTER_PX
        x_m, y_m = np.ptp(outline, axis=0)
        self.lid_px = round(room * y_m / max(x_m, y_m)), round(room * x_m / max(x_m, y_m))  # +y is to the right
        self.corners_px = [(_GUTTER_PX + x, self.label_px + _GUTTER_PX) for x in (0, ATLAS_PX // 2)]  # lid, base

    def arts(self, label: Colour, lid: Colour) -> tuple[Art, Art]:
        """An empty label and an empty lid in these colours."""
        return Art(ATLAS_PX, self.label_px, label), Art(*self.lid_px, lid)

    def _skin(self, steps: Steps) -> tuple[NDArray, NDArray]:
        """Vertices [V, 3] of the outline at each of the steps (scale, height) [S, 2], and the faces [F, 3] between."""
        columns = len(self.outline)
        points = np.concatenate([np.c_[self.outline * scale, np.full(columns, z)] for scale, z in steps])
        low = (np.arange(len(steps) - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
        faces = np.concatenate([np.c_[low, low + 1, low + columns + 1], np.c_[low, low + columns + 1, low + columns]])
        a, b, c = np.moveaxis(points[faces], 1, 0)
        return points, faces[(a != b).any(1) & (b != c).any(1) & (c != a).any(1)]

    def _side(self) -> tuple[NDArray, NDArray, NDArray]:
        """The outside: vertices [V, 3], their pixels in the atlas [V, 2], and faces [F, 3]."""
        points, faces = self._skin(self.profile.tolist())
        u, t = np.tile(self.u, len(self.t)), np.repeat(self.t, len(self.u))
        return points, np.c_[u * ATLAS_PX, (1 - t) * self.label_px], faces

    def _end(self, which: int) -> tuple[NDArray, NDArray, NDArray]:
        """The lid (0) or the base (1), in the same form: a rim and a recess if it is sunk, and a fan to the centre."""
        sign, (scale, z) = (1, self.profile[-1]) if which == 0 else (-1, self.profile[0])
        inner = z - sign * self.sunk
        rim = [(0.95 * scale, z), (0.93 * scale, inner)] if self.sunk else []
        points, faces = self._skin([(scale, z), *rim, (0.0, inner)])
        across = points[:, [1, 0]] * (1, sign) / np.ptp(self.outline[:, ::-1], axis=0) / scale + 0.5
        return points, self.corners_px[which] + across * self.lid_px, faces[:, ::sign]

    def mesh(self, name: str, label: Art, lid: Art) -> Mesh:
        """The closed mesh with this label and lid. The base is plain, because it is never seen on a table."""
        pixel, base = label.image.getpixel((0, 0)), Art(*self.lid_px, SILVER)
        assert isinstance(pixel, tuple)  # true for every colour image
        red, green, blue = pixel
        ground = red, green, blue
        base.rect((0, 0, 0.5, 1, ground))
        base.barcode(0.2, 0.2, 0.7, 0.45)
        atlas = Image.new("RGB", (ATLAS_PX, ATLAS_PX), ground)
        atlas.paste(label.image.resize((ATLAS_PX, self.label_px), Image.Resampling.BOX))
        for which, art in enumerate((lid, base)):
            x, y = self.corners_px[which]
            picture = art.image.resize(self.lid_px, Image.Resampling.BOX)
            padded = np.pad(np.asarray(picture), [(_GUTTER_PX,) * 2] * 2 + [(0, 0)], mode="edge")
            atlas.paste(Image.fromarray(padded), (x - _GUTTER_PX, y - _GUTTER_PX))
        points, pixels, faces = zip(self._side(), self._end(0), self._end(1), strict=True)
        starts = np.cumsum([0] + [len(p) for p in points[:-1]])
        joined = np.concatenate([f + start for f, start in zip(faces, starts, strict=True)])
        texcoords = np.concatenate(pixels) / ATLAS_PX * (1, -1) + (0, 1)
        return Mesh(name, np.concatenate(points).astype(np.float32), texcoords.astype(np.float32),
                    joined.astype(np.int32), np.array(atlas))


def _coffee_can() -> Mesh:
    shape = Shape(ellipse(0.102, 0.102), [(0.97, -0.07), (0.97, 0.056), (1.0, 0.056), (1.0, 0.07)], sunk=0.004)
    art, lid = shape.arts(BLUE, SILVER)
    art.rect((0.16, 0, 0.34, 1, SKY))  # -y side: mountains
    art.poly([(0.16, 0.85), (0.22, 0.4), (0.26, 0.62), (0.3, 0.35), (0.34, 0.85)], NAVY)
    art.disc(0.2, 0.32, 0.09, YELLOW)
    art.text(0.5, 0.29, "BREVA", 0.2, WHITE)  # front: a cup
    art.disc(0.56, 0.62, 0.1, WHITE)
    art.disc(0.56, 0.62, 0.06, BLUE)
    art.bowl(0.5, 0.56, 0.17, WHITE, BROWN, GOLD)
    art.rect((0.66, 0, 0.84, 1, SILVER))  # +y side: beans
    for k in range(9):
        x, y = 0.69 + 0.06 * (k % 3), 0.24 + 0.2 * (k // 3) + 0.04 * (k % 2)
        art.disc(x, y, 0.062, BROWN, 0.75)
        art.rect((x - 0.02, y - 0.012, x + 0.02, y + 0.012, GOLD))
    art.rect((0.84, 0, 1, 1, NAVY))  # back: a barcode and a panel
    art.barcode(0.91, 0.3, 0.98, 0.72)
    art.rect((0, 0, 0.16, 1, SILVER))
    art.table(0.02, 0.2, 0.14, 0.76)
    art.poly([(0, 0.93), (1, 0.72), (1, 0.86), (0, 1.07)], RED)  # a band: its height says where on the can it is
    art.rect((0, 0, 1, 0.105, SILVER), (0.45, 0, 0.55, 0.105, RED))  # rim of the lid, with a tab at the front
    lid.disc(0.5, 0.5, 0.44, BLUE)
    lid.disc(0.5, 0.5, 0.44, RED, 1.0, (60, 120))
    lid.disc(0.5, 0.5, 0.44, NAVY, 1.0, (180, 270))
    lid.text(0.5, 0.38, "BREVA", 0.17, WHITE)
    lid.disc(0.72, 0.66, 0.09, SILVER)
    return shape.mesh("coffee_can", art, lid)


def _cereal_box() -> Mesh:
    shape = Shape(rectangle(0.072, 0.164), [(1, -0.1065), (1, 0.1065)])
    art, lid = shape.arts(RED, ORANGE)
    side, narrow = 0.164 / 0.472, 0.072 / 0.472  # of the way round
    art.rect((0, 0.84, side, 1, ORANGE))  # front
    art.poly([(0, 0.84), (side, 0.62), (side, 1), (0, 1)], ORANGE)
    art.disc(side / 2, 0.19, 0.34, YELLOW, 0.4)
    art.text(side / 2, 0.19, "ZINGOS", 0.135, RED)
    art.bowl(side * 0.52, 0.56, 0.26, WHITE, YELLOW, BROWN)
    art.text(side * 0.2, 0.93, "500 g", 0.06, WHITE)
    art.rect((side, 0, 0.5, 1, ORANGE))  # +y side
    art.text(side + narrow * 0.5, 0.34, "ZINGOS", 0.13, WHITE, 90)
    art.table(side + narrow * 0.12, 0.6, side + narrow * 0.88, 0.95)
    art.rect((0.5, 0, 0.5 + side, 1, YELLOW), (0.5, 0, 0.5 + side, 0.17, RED))  # back: a game
    art.text(0.5 + side / 2, 0.085, "PLAY & WIN", 0.09, WHITE)
    for k in range(16):
        art.rect((0.52 + 0.078 * (k % 4), 0.23 + 0.13 * (k // 4), 0.59 + 0.078 * (k % 4), 0.34 + 0.13 * (k // 4),
                  (ORANGE, TEAL, RED, WHITE)[(k + k // 4 * 2) % 4]))
    art.poly([(0.52, 0.95), (0.66, 0.77), (0.8, 0.95)], RED)
    left = 0.5 + side  # -y side
    art.rect((left, 0, 1, 1, RED))
    for k in range(5):
        art.poly([(left, 0.1 + 0.14 * k), (1, 0.03 + 0.14 * k), (1, 0.09 + 0.14 * k), (left, 0.16 + 0.14 * k)], YELLOW)
    art.barcode(left + 0.02, 0.78, 0.98, 0.95)
    lid.rect((0, 0, 0.3, 1, RED))
    lid.poly([(0.86, 0), (1, 0), (1, 1), (0.7, 1)], YELLOW)
    lid.text(0.53, 0.56, "ZINGOS", 0.36, WHITE)
    lid.rect((0, 0, 1, 0.14, TEAL))
    return shape.mesh("cereal_box", art, lid)


def _rice_box() -> Mesh:
    shape = Shape(rectangle(0.050, 0.094), [(1, -0.088), (1, 0.088)])
    (art, lid), side = shape.arts(WHITE, WHITE), 0.094 / 0.288
    art.rect((0, 0, side, 0.36, GREEN))  # front
    art.text(side / 2, 0.18, "OLANA", 0.135, WHITE)
    art.text(side / 2, 0.44, "RICE", 0.1, GREEN)
    art.bowl(side / 2, 0.66, 0.2, GREEN, CREAM, LEAF)
    art.rect((side, 0, 0.5, 1, LEAF), (side + 0.08, 0.1, side + 0.094, 0.95, GREEN))  # +y side: leaves up a stem
    for k in range(5):
        x, y = side + 0.087, 0.85 - 0.15 * k
        tip = x + (0.07 if k % 2 else -0.07)
        art.poly([(x, y), (tip, y - 0.16), (x, y - 0.12)], WHITE)
    art.poly([(0.5, 0), (0.5 + side, 0), (0.5 + side, 0.62), (0.5, 0.2)], GREEN)  # back
    art.text(0.5 + side * 0.66, 0.12, "COOK", 0.1, WHITE)
    for k in range(3):
        art.disc(0.55, 0.45 + 0.2 * k, 0.07, (ORANGE, TEAL, GREEN)[k])
        art.rect((0.59, 0.43 + 0.2 * k, 0.66 + 0.05 * k, 0.48 + 0.2 * k, BLACK))
    left = 0.5 + side  # -y side
    art.rect((left, 0, 1, 1, GREEN))
    art.table(left + 0.02, 0.06, 0.98, 0.56)
    art.barcode(left + 0.02, 0.7, 0.98, 0.92)
    lid.rect((0, 0, 0.62, 1, GREEN))
    lid.text(0.31, 0.4, "OLANA", 0.32, WHITE)
    lid.disc(0.82, 0.68, 0.2, ORANGE)
    lid.poly([(0, 1), (0, 0.7), (0.62, 1)], LEAF)
    return shape.mesh("rice_box", art, lid)


def _soup_can() -> Mesh:
    bead = [(1, -0.051), (1, -0.048), (0.97, -0.046)]
    shape = Shape(ellipse(0.068, 0.068), bead + [(s, -z) for s, z in reversed(bead)], sunk=0.003)
    art, lid = shape.arts(WHITE, SILVER)
    art.poly([(0, 0), (1, 0), (1, 0.3), (0, 0.7)], PURPLE)  # the edge falls all the way round
    art.text(0.5, 0.22, "MIRO", 0.25, WHITE)  # front
    art.bowl(0.5, 0.6, 0.24, PINK, ORANGE, GREEN)
    for k in range(3):  # +y side: rings
        art.disc(0.76, 0.2 + 0.29 * k, 0.13, (LEAF, ORANGE, PINK)[k])
        art.disc(0.76, 0.2 + 0.29 * k, 0.06, WHITE)
    for k in range(4):  # -y side: upright stripes
        art.rect((0.17 + 0.045 * k, 0.1, 0.192 + 0.045 * k, 0.94, (PINK, PLUM)[k % 2]))
    art.rect((0.87, 0.05, 1, 0.95, PLUM))  # back
    art.barcode(0.89, 0.45, 0.985, 0.9)
    art.text(0.935, 0.26, "400 g", 0.11, WHITE)
    art.table(0, 0.1, 0.13, 0.9)
    art.rect((0, 0, 1, 0.05, SILVER), (0, 0.95, 1, 1, SILVER))
    lid.disc(0.5, 0.5, 0.46, WHITE)
    lid.disc(0.5, 0.5, 0.46, PURPLE, 1.0, (-20, 110))
    lid.disc(0.5, 0.5, 0.46, PINK, 1.0, (110, 170))
    lid.disc(0.5, 0.27, 0.15, PLUM, 0.8)  # pull ring, towards the back
    lid.disc(0.5, 0.27, 0.08, SILVER, 0.8)
    lid.rect((0.46, 0.38, 0.54, 0.52, PLUM))
    return shape.mesh("soup_can", art, lid)


def _squeeze_bottle() -> Mesh:
    bend = np.linspace(0, np.pi / 2, 6)
    shoulder = np.c_[0.36 + 0.64 * np.cos(bend), 0.025 + 0.033 * np.sin(bend)]
    cap = [(0.36, 0.064), (0.42, 0.065), (0.38, 0.084), (0.22, 0.0955)]
    shape = Shape(ellipse(0.097, 0.067), [(0.9, -0.0955), (1, -0.089), *shoulder, *cap])
    art, lid = shape.arts(YELLOW, BLUE)
    body = 1 - np.interp(0.025, shape.profile[:, 1], shape.t)  # where the shoulder starts, and then the cap
    neck = 1 - np.interp(0.065, shape.profile[:, 1], shape.t)
    art.rect((0.06, 0, 0.3, body, ORANGE), (0.7, 0, 0.94, body, WHITE))  # shoulder: one colour to a side
    art.rect((0.44, 0, 0.56, body, RED))
    art.disc(0.5, 0.69, 0.24, BLUE, 1.0)  # front: a flower under the name
    art.text(0.5, 0.62, "SOLA", 0.13, WHITE)
    for turn in range(0, 360, 60):
        x, y = 0.07 * np.cos(np.radians(turn)), 0.07 * np.sin(np.radians(turn))
        art.disc(0.5 + x * art.height / art.width, 0.79 + y, 0.04, YELLOW)
    art.disc(0.5, 0.79, 0.045, RED)
    for k in range(4):  # +y side: blue steps
        art.rect((0.68 + 0.05 * k, 0.9 - 0.12 * k, 0.73 + 0.05 * k, 1, BLUE))
    for k in range(3):  # -y side: drops
        art.disc(0.22, 0.56 + 0.17 * k, 0.06, RED)
        art.poly([(0.176, 0.54 + 0.17 * k), (0.264, 0.54 + 0.17 * k), (0.22, 0.45 + 0.17 * k)], RED)
    art.rect((0.9, body + 0.03, 1, 0.97, BLUE))  # back
    art.barcode(0.91, 0.6, 0.99, 0.9)
    art.table(0, body + 0.03, 0.12, 0.97)
    art.rect((0, 0, 1, neck, BLUE), (0.38, 0, 0.62, neck, WHITE), (0.62, 0, 0.8, neck, RED))
    lid.rect((0, 0.5, 1, 1, WHITE))
    return shape.mesh("squeeze_bottle", art, lid)


_MAKERS = dict(zip(PANTRY_NAMES, (_coffee_can, _cereal_box, _rice_box, _soup_can, _squeeze_bottle), strict=True))


def make_mesh(name: str) -> Mesh:
    """Makes one object of the set, the same at every call. Raises KeyError if the name is not in PANTRY_NAMES."""
    return _MAKERS[name]()
