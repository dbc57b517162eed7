"""Meshes made of lofts: skins over a row of cross-sections. For looks alone; nothing touches them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import mujoco
import numpy as np

from ompl_ext.arrays import Matrix

Point3: TypeAlias = tuple[float, float, float]
Part: TypeAlias = tuple[Matrix, list[tuple[int, int, int]]]
"""Vertices (n, 3) and triangles that run counter-clockwise seen from outside."""


def loft(sections: Sequence[Sequence[Point3]]) -> Part:
    """Skin over cross-sections of equally many corners, closed by flat ends.

    The first and last section have to be convex. Corners may run either way round.
    """
    corners = len(sections[0])
    faces: list[tuple[int, int, int]] = []
    for k in range(len(sections) - 1):
        here, there = k * corners, (k + 1) * corners
        for i in range(corners):
            j = (i + 1) % corners
            faces += [(here + i, there + j, here + j), (here + i, there + i, there + j)]
    last = (len(sections) - 1) * corners
    for i in range(1, corners - 1):
        faces += [(0, i, i + 1), (last, last + i + 1, last + i)]
    vertices = np.array(sections, dtype=float).reshape(-1, 3)
    return vertices, faces if _volume(vertices, faces) > 0 else [(a, c, b) for a, b, c in faces]


def _volume(vertices: Matrix, faces: list[tuple[int, int, int]]) -> float:
    """Volume within a closed skin, negative if it is inside out, m^3."""
    a, b, c = (vertices[np.array(faces)[:, k]] - vertices.mean(axis=0) for k in range(3))
    return float(np.sum(a * np.cross(b, c))) / 6


def block(low: Point3, high: Point3) -> Part:
    """Upright box between two corners."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    return loft([[(x, y0, z0), (x, y0, z1), (x, y1, z1), (x, y1, z0)] for x in (x1, x0)])


def mirrored(part: Part) -> Part:
    """The same on the other side of the plane y = 0."""
    vertices, faces = part
    return vertices * [1.0, -1.0, 1.0], [(a, c, b) for a, b, c in faces]


def add_mesh(spec: Any, name: str, parts: Iterable[Part]) -> str:
    """Add a mesh made of parts to a specification; returns its name."""
    vertices: list[Matrix] = []
    faces: list[int] = []
    count = 0
    for corners, triangles in parts:
        vertices.append(corners)
        faces += [count + index for triangle in triangles for index in triangle]
        count += len(corners)
    spec.add_mesh(
        name=name,
        uservert=np.vstack(vertices).ravel(),
        userface=faces,
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,  # parts may overlap, which a volume may not
    )
    return name
