"""Small meshes whose symmetry is known: cans, boxes and a mug."""

from __future__ import annotations

import numpy as np

from saccade.shared.render.mesh import Mesh

TEXTURE_PX = 128


def plain(colour=(180, 60, 50)):
    return np.full((TEXTURE_PX, TEXTURE_PX, 3), colour, dtype=np.uint8)


def labelled(*starts, width=0.16):
    """A texture with labels that begin at these shares of the way around."""
    texture = plain()
    for start in starts:
        texture[40:90, round(start * TEXTURE_PX):round((start + width) * TEXTURE_PX)] = (240, 230, 90)
    return texture


def can(texture=None, *, sides=48, radius_m=0.035, height_m=0.11, name="can"):
    """A prism, whose texture goes once around it."""
    columns = np.arange(sides + 1)
    angle = 2 * np.pi * columns / sides
    ring = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    low, high = (np.c_[ring, np.full(sides + 1, z)] for z in (-height_m / 2, height_m / 2))
    vertices = np.concatenate([low, high, [[0, 0, -height_m / 2], [0, 0, height_m / 2]]])
    around = columns / sides
    texcoords = np.concatenate([np.c_[around, np.zeros(sides + 1)], np.c_[around, np.ones(sides + 1)],
                                [[0.0, 0.0], [0.0, 1.0]]])
    a = columns[:-1]
    b, c, d, bottom, top = a + 1, a + sides + 1, a + sides + 2, len(vertices) - 2, len(vertices) - 1
    faces = np.concatenate([np.c_[a, b, d], np.c_[a, d, c], np.c_[b, a, np.full(sides, bottom)],
                            np.c_[c, d, np.full(sides, top)]])
    return mesh_of(name, vertices, texcoords, faces, plain() if texture is None else texture)


def box(size_m, texture=None, name="box"):
    """A box; the texture's four quarters are around it."""
    turned = np.pi / 4
    upright = can(texture, sides=4, radius_m=1.0, height_m=1.0, name=name)
    rotation = np.array([[np.cos(turned), -np.sin(turned), 0], [np.sin(turned), np.cos(turned), 0], [0, 0, 1]])
    vertices = upright.vertices_m @ rotation.T * np.sqrt((0.5, 0.5, 1.0)) * size_m
    return mesh_of(name, vertices, upright.texcoords, upright.faces, upright.texture)


def mug():
    """A can with a block as its handle."""
    body, handle = can(name="mug"), box((0.03, 0.012, 0.05))
    count = len(body.vertices_m)
    vertices = np.concatenate([body.vertices_m, handle.vertices_m + np.array([0.05, 0.0, 0.0])])
    vertices -= (vertices.max(0) + vertices.min(0)) / 2
    return mesh_of("mug", vertices, np.concatenate([body.texcoords, handle.texcoords]),
                   np.concatenate([body.faces, handle.faces + count]), plain())


def mesh_of(name, vertices, texcoords, faces, texture):
    return Mesh(name, vertices.astype(np.float32), texcoords.astype(np.float32), faces.astype(np.int32), texture)
