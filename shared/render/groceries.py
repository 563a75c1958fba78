"""Groceries that nobody sells: objects made by code in any number, to train on things that are not any one's own.

They are of the pantry's kind: boxes, cans, bottles, bowls and mugs of household size, with labels of random colours,
shapes and words. Some carry no label at all.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from saccade.shared.render.mesh import Mesh
from saccade.shared.render.pantry import ATLAS_PX, Art, Colour, Shape, ellipse, rectangle

LETTERS = "ABCDEFGHIKLMNOPRSTUVWZ"
PLAIN = 0.12  # share of the objects without a label
HANDLE_SEGMENTS = 10
SMALLEST_LID_PX = 24

Rng = np.random.Generator


def grocery(rng: Rng, name: str) -> Mesh:
    """Draws an object."""
    while True:
        make, faces = _KINDS[int(rng.choice(len(_KINDS), p=(0.34, 0.26, 0.22, 0.09, 0.09)))]
        shape = make(rng)
        if min(shape.lid_px) >= SMALLEST_LID_PX:  # a label that is too high leaves no room in the atlas
            break
    mesh = _dressed(rng, shape, name, faces)
    return _with_handle(mesh, rng) if make is _mug else mesh


def _colours(rng: Rng) -> list[Colour]:
    """Five colours that go together or not: a few hues, some of them pale, some dark."""
    hues = (rng.random() + rng.normal(0, 0.12, 5) + 0.5 * (rng.random(5) < 0.35)) % 1.0
    saturation, value = rng.beta(1.5, 1.0, 5), rng.beta(2.5, 1.0, 5)
    saturation[rng.random(5) < 0.25] = 0.05
    wheel = np.clip(np.abs((hues[:, None] * 6 + np.array([0, 4, 2])) % 6 - 3) - 1, 0, 1)
    rgb = value[:, None] * (1 - saturation[:, None] * (1 - wheel))
    return [(int(r), int(g), int(b)) for r, g, b in (255 * rgb).round()]


def _word(rng: Rng) -> str:
    return "".join(rng.choice(list(LETTERS), int(rng.integers(2, 8))))


def _label(rng: Rng, art: Art, colours: list[Colour], faces: int) -> None:
    """Draws what a label has, in `faces` fields from left to right: bands, pictures, words, print and a barcode."""
    def pick() -> Colour:
        return colours[int(rng.integers(len(colours)))]

    for _ in range(int(rng.integers(0, 3))):  # bands around
        top = rng.random()
        art.rect((0, top, 1, top + rng.uniform(0.03, 0.4), pick()))
    if rng.random() < 0.4:
        edge = rng.random(2)
        art.poly([(0, edge[0]), (1, edge[1]), (1, 1), (0, 1)], pick())
    for face in range(faces):
        left, width = face / faces, 1 / faces
        for _ in range(int(rng.integers(0, 5))):
            x, y = left + width * rng.uniform(0.1, 0.9), rng.uniform(0.05, 0.95)
            size = rng.uniform(0.04, 0.3)
            _picture(rng, art, x, y, size, width, pick)
        if rng.random() < 0.75:
            size = rng.uniform(0.05, 0.24)
            art.text(left + width / 2, rng.uniform(0.1, 0.9), _word(rng), size, pick(), 90.0 * (rng.random() < 0.15))
        if rng.random() < 0.25:
            top = rng.uniform(0.05, 0.6)
            art.table(left + 0.15 * width, top, left + 0.85 * width, top + rng.uniform(0.2, 0.4),
                      int(rng.integers(3, 9)))
        if rng.random() < 0.2:
            top = rng.uniform(0.1, 0.75)
            art.barcode(left + 0.2 * width, top, left + 0.8 * width, top + 0.2, int(rng.integers(2 ** 20, 2 ** 25)))


def _picture(rng: Rng, art: Art, x: float, y: float, size: float, width: float, pick: Callable[[], Colour]) -> None:
    kind = int(rng.integers(5))
    if kind == 0:
        art.disc(x, y, size, pick(), rng.uniform(0.5, 1.2))
        if rng.random() < 0.5:
            art.disc(x, y, 0.6 * size, pick())
    elif kind == 1:
        half = width * rng.uniform(0.1, 0.4)
        art.rect((x - half, y - size, x + half, y + size, pick()))
    elif kind == 2:
        corners = rng.uniform(-1, 1, (int(rng.integers(3, 7)), 2)) * (size * art.height / art.width, size)
        art.poly(corners + np.array([x, y]), pick())
    elif kind == 3:
        art.bowl(x, y, size, pick(), pick(), pick())
    else:
        for k in range(int(rng.integers(2, 5))):
            art.disc(x + 0.03 * k, y + rng.uniform(-0.1, 0.1), 0.35 * size, pick())


def _dressed(rng: Rng, shape: Shape, name: str, faces: int) -> Mesh:
    """A mesh with a random label and lid."""
    colours = _colours(rng)
    art, lid = shape.arts(colours[0], colours[int(rng.integers(len(colours)))])
    if rng.random() > PLAIN:
        _label(rng, art, colours, faces)
        if rng.random() < 0.6:
            _label(rng, lid, colours, 1)
    return shape.mesh(name, art, lid)


def _box(rng: Rng) -> Shape:
    depth, width, height = rng.uniform(0.02, 0.1), rng.uniform(0.05, 0.2), rng.uniform(0.03, 0.26)
    return Shape(rectangle(depth, width), [(1, -height / 2), (1, height / 2)])


def _can(rng: Rng) -> Shape:
    across, height = rng.uniform(0.045, 0.12), rng.uniform(0.03, 0.2)
    inset = rng.uniform(0.94, 1.0)
    profile = [(1, -height / 2), (inset, -height / 2 + 0.004), (inset, height / 2 - 0.004), (1, height / 2)]
    return Shape(ellipse(across, across), profile, sunk=rng.uniform(0, 0.005))


def _bottle(rng: Rng) -> Shape:
    across, flat = rng.uniform(0.05, 0.11), rng.uniform(0.55, 1.0)
    height, neck = rng.uniform(0.12, 0.25), rng.uniform(0.2, 0.5)
    shoulder = rng.uniform(0.45, 0.8) * height - height / 2
    bend = np.linspace(0, np.pi / 2, 5)
    slope = min(rng.uniform(0.02, 0.08), 0.8 * (height / 2 - 0.015 - shoulder))
    curve = np.c_[neck + (1 - neck) * np.cos(bend), shoulder + slope * np.sin(bend)]
    waist = rng.uniform(0.8, 1.0)
    profile = [(0.92, -height / 2), (1, -height / 2 + 0.006), (waist, (shoulder - height / 2) / 2), *curve,
               (neck, height / 2 - 0.015), (neck * 1.1, height / 2 - 0.014), (neck * 1.05, height / 2)]
    return Shape(ellipse(across, across * flat), profile)


def _bowl(rng: Rng) -> Shape:
    across, height = rng.uniform(0.1, 0.2), rng.uniform(0.03, 0.09)
    profile = [(rng.uniform(0.3, 0.6), -height / 2), (0.85, 0.0), (1, height / 2)]
    return Shape(ellipse(across, across), profile, sunk=0.8 * height)


def _mug(rng: Rng) -> Shape:
    across, height = rng.uniform(0.06, 0.1), rng.uniform(0.07, 0.12)
    return Shape(ellipse(across, across), [(rng.uniform(0.8, 1.0), -height / 2), (1, height / 2)], sunk=0.85 * height)


def _with_handle(body: Mesh, rng: Rng) -> Mesh:
    """Adds a handle at +y: a band bent to a half ring, in the colour of the label's corner."""
    _, across, height = body.size_m
    angle = np.linspace(-np.pi / 2, np.pi / 2, HANDLE_SEGMENTS)
    reach, half, thick = rng.uniform(0.02, 0.035), 0.35 * height, rng.uniform(0.004, 0.008)
    ring = [np.stack([np.full_like(angle, x), across / 2 * 0.97 + (reach + r) * np.cos(angle),
                      (half + r) * np.sin(angle)], axis=1)
            for x, r in ((-thick, -thick), (thick, -thick), (thick, thick), (-thick, thick))]
    points = np.concatenate(ring)
    faces = []
    for side in range(4):
        first, second = side * HANDLE_SEGMENTS, (side + 1) % 4 * HANDLE_SEGMENTS
        for k in range(HANDLE_SEGMENTS - 1):
            a, b, c, d = first + k, second + k, second + k + 1, first + k + 1
            faces += [(a, b, c), (a, c, d)]
    start = len(body.vertices_m)
    where = np.tile(np.array([[0.5 / ATLAS_PX, 1 - 0.5 / ATLAS_PX]]), (len(points), 1))
    vertices: NDArray[np.float32] = np.concatenate([body.vertices_m, points]).astype(np.float32)
    vertices -= (vertices.max(0) + vertices.min(0)) / 2
    return Mesh(body.name, vertices, np.concatenate([body.texcoords, where]).astype(np.float32),
                np.concatenate([body.faces, np.array(faces) + start]).astype(np.int32), body.texture)


# How each kind is shaped, and how many fields its label has.
_KINDS: tuple[tuple[Callable[[Rng], Shape], int], ...] = ((_box, 4), (_can, 3), (_bottle, 3), (_bowl, 2), (_mug, 3))
