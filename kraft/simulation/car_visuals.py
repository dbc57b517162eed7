"""Visual geoms of the car, a small rally car, without mass or contacts.

In the car's body frame, m: x forward, z up, wheels at x = -0.148 and 0.148. Meshes are few, one for each colour, since
every geom costs time in every physics step.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import product
from typing import Any, Final, TypeAlias

import mujoco
import numpy as np

from kraft.simulation import contacts
from kraft.simulation.car import MARKER_HEIGHT, MUSHR, WHEELS, CarDesign
from ompl_ext.arrays import Matrix

AXLE: Final = MUSHR.wheelbase / 2
ARCH: Final = 0.056
WAIST: Final = 0.1
LENGTHWISE: Final = (-0.222, -0.214, -0.15, -0.05, 0.05, 0.12, 0.17, 0.2, 0.213)
BONNET: Final = (0.112, 0.131, 0.138, 0.138, 0.136, 0.13, 0.12, 0.11, 0.1)
HALF_WIDTH: Final = (0.104, 0.114, 0.13, 0.122, 0.12, 0.13, 0.126, 0.112, 0.096)
SILL: Final = (0.07, 0.058, 0.05, 0.046, 0.046, 0.048, 0.05, 0.053, 0.06)
BITS: Final = ("011001", "100110", "101101", "010011", "110100", "001110")

Point3: TypeAlias = tuple[float, float, float]
Part: TypeAlias = tuple[Matrix, list[tuple[int, int, int]]]
"""Vertices (n, 3) and triangles that run counter-clockwise seen from outside."""


def add_car_visuals(spec: Any, body: Any, design: CarDesign) -> None:
    """Add the visual geoms of a car's body, those of the MuSHR in the size of the design, and of its wheels."""
    meshes = {
        "paint": [_deck(), *_both(_flank()), *_roof()],
        "stripe": [*_both(_stripe()), *_door_plates()],
        "glass": [_cabin()],
        "trim": [_underbody(), *_wing(), *_both(block((0.07, 0.112, 0.14), (0.092, 0.13, 0.152)))],
        "lamp": _both(block((0.195, 0.052, 0.078), (0.2145, 0.09, 0.096))),
        "tail lamp": _both(block((-0.223, 0.055, 0.1), (-0.215, 0.098, 0.116))),
        "plate": [block((-0.125, -0.075, 0.197), (0.025, 0.075, MARKER_HEIGHT))],
        "ink": _cells(),
    }
    stretch = [(design.front - design.rear) / (MUSHR.front - MUSHR.rear), design.side / MUSHR.side, 1.0]
    for material, parts in meshes.items():
        scaled = parts if design == MUSHR else [(vertices * stretch, faces) for vertices, faces in parts]
        _add_visual(body, add_mesh(spec, f"car {material}", scaled), material)
    sides = [design.wheel_radius / MUSHR.wheel_radius, design.wheel_width / MUSHR.wheel_width]
    rim = [sides[0], sides[1], sides[0]]
    add_mesh(spec, "rim", _rim() if design == MUSHR else [(vertices * rim, faces) for vertices, faces in _rim()])
    for name in WHEELS:
        wheel = spec.body(name)
        across = [math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0]
        size = [design.wheel_radius, design.wheel_width / 2, 0.0]
        wheel.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=size, quat=across, material="tyre", **contacts.VISUAL)
        _add_visual(wheel, "rim", "rim")


def _add_visual(body: Any, mesh: str, material: str) -> None:
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, material=material, **contacts.VISUAL)


def _both(part: Part) -> list[Part]:
    return [part, mirrored(part)]


def _at(x: float, values: tuple[float, ...]) -> float:
    return float(np.interp(x, LENGTHWISE, values))


def _stations() -> list[float]:
    """Where cross-sections are taken, front to rear: close together where the outline bends."""
    arches = [centre + ARCH * math.cos(k * math.pi / 16) for centre in (-AXLE, AXLE) for k in range(17)]
    return sorted({round(x, 5) for x in (*LENGTHWISE, *arches) if LENGTHWISE[0] <= x <= LENGTHWISE[-1]}, reverse=True)


def _deck() -> Part:
    """Bonnet, shoulders and boot: everything above the waist and below the windows."""

    def section(x: float) -> list[Point3]:
        w, z = _at(x, HALF_WIDTH), _at(x, BONNET)
        shoulder = WAIST + 0.6 * (z - WAIST)
        half = [(x, -w, WAIST - 0.012), (x, -w, shoulder), (x, -w + 0.024, z), (x, -0.02, z + 0.002)]
        return [*half, *[(x, -y, height) for _, y, height in reversed(half)]]

    return loft([section(x) for x in _stations()])


def _flank() -> Part:
    """The left side below the waist, cut out around the wheels."""

    def section(x: float) -> list[Point3]:
        low = _at(x, SILL)
        for centre in (-AXLE, AXLE):
            if abs(x - centre) < ARCH:
                low = max(low, MUSHR.wheel_radius + math.sqrt(ARCH**2 - (x - centre) ** 2))
        w, top = _at(x, HALF_WIDTH), WAIST + 0.006
        low = min(low, top - 0.001)
        return [(x, 0.07, low), (x, 0.07, top), (x, w, top), (x, w - 0.2 * (top - low), low)]

    return loft([section(x) for x in _stations()])


def _underbody() -> Part:
    """Dark tub between the wheels, with the lips of both bumpers."""
    rows = ((0.2135, 0.08, 0.062), (0.2, 0.092, 0.05), (0.195, 0.07, 0.046), (-0.195, 0.07, 0.046),
            (-0.21, 0.092, 0.055), (-0.2235, 0.085, 0.068))  # fmt: skip
    top = WAIST - 0.004
    return loft([[(x, -w, z), (x, -w, top), (x, w, top), (x, w, z)] for x, w, z in rows])


def _frustum(x0: tuple[float, float], w0: float, z0: float, x1: tuple[float, float], w1: float, z1: float) -> Part:
    """Block that narrows upwards: rear and front (x), half width and height at its foot, then at its top."""
    front = [(x0[1], -w0, z0), (x1[1], -w1, z1), (x1[1], w1, z1), (x0[1], w0, z0)]
    rear = [(x0[0], -w0, z0), (x1[0], -w1, z1), (x1[0], w1, z1), (x0[0], w0, z0)]
    return loft([front, rear])


CABIN_FOOT: Final = ((-0.178, 0.098), 0.106, 0.134)
CABIN_TOP: Final = ((-0.135, 0.036), 0.084, 0.19)


def _cabin() -> Part:
    return _frustum(*CABIN_FOOT, *CABIN_TOP)


def _roof() -> list[Part]:
    """Roof and the posts between the windows."""
    (r1, f1), w1, z1 = CABIN_TOP
    roof = _frustum((r1 - 0.004, f1 + 0.004), w1 + 0.002, z1 - 0.006, (r1 + 0.004, f1 - 0.008), w1 - 0.006, 0.197)
    posts = [_post(0.086, 0.024, 0.014), _post(-0.028, -0.038, 0.012), _post(-0.176, -0.133, 0.026)]
    return [roof, *(side for post in posts for side in _both(post))]


def _post(foot: float, top: float, wide: float) -> Part:
    """Post on the left side, `wide` m long, that stands a little out of the windows."""
    (_, w0, z0), (_, w1, z1) = CABIN_FOOT, CABIN_TOP
    out, deep = 0.0015, 0.012
    at_foot: list[Point3] = [(foot, w0 - deep, z0), (foot, w0 + out, z0)]
    at_top: list[Point3] = [(top, w1 + out, z1), (top, w1 - deep, z1)]
    front = [*at_foot, *at_top][::-1]
    return loft([[(x + wide, y, z) for x, y, z in front], front])


def _stripe() -> Part:
    """One of two stripes over the bonnet, just above its surface."""
    rows = [x for x in _stations() if x >= 0.1]
    return loft([[(x, y, _at(x, BONNET) + dz) for y, dz in ((0.014, 0.0), (0.014, 0.0036), (0.034, 0.0032),
                                                           (0.034, 0.0))] for x in rows])  # fmt: skip


def _door_plates() -> list[Part]:
    """Fields for the start number on both doors."""
    angles = [2 * math.pi * k / 24 for k in range(24)]
    disc = [(0.024 * math.cos(a), 0.096 + 0.022 * math.sin(a)) for a in angles]
    plate = loft([[(x, y, z) for x, z in disc] for y in (0.1228, 0.119)])
    return _both(plate)


def _wing() -> list[Part]:
    """Rear wing on two struts."""
    profile = [(-0.222, 0.184), (-0.218, 0.189), (-0.178, 0.178), (-0.178, 0.175)]
    blade = loft([[(x, y, z) for x, z in profile] for y in (0.108, -0.108)])
    ends = [block((-0.2235, 0.106, 0.168), (-0.174, 0.11, 0.194)), block((-0.205, 0.06, 0.13), (-0.19, 0.065, 0.182))]
    return [blade, *(side for end in ends for side in _both(end))]


def _cells() -> list[Part]:
    """Black cells of the marker: a frame around six by six bits, as ArUco's are."""
    cell, origin = 0.15 / 10, (-0.125, -0.075)
    parts = []
    for row, column in product(range(1, 9), repeat=2):
        inside = 2 <= row <= 7 and 2 <= column <= 7
        if inside and BITS[row - 2][column - 2] == "1":
            continue
        x, y = origin[0] + row * cell, origin[1] + column * cell
        parts.append(block((x, y, MARKER_HEIGHT - 0.001), (x + cell, y + cell, MARKER_HEIGHT + 0.0004)))
    return parts


def _rim() -> list[Part]:
    """Ring and six spokes, on both faces of a wheel, about the wheel's axle (y)."""
    angles = [2 * math.pi * k / 32 for k in range(33)]
    outer, inner, face = 0.035, 0.030, MUSHR.wheel_width / 2 + 0.0012
    ring = loft([
        [(r * math.sin(a), y, r * math.cos(a)) for r, y in ((inner, -face), (inner, face), (outer, face),
                                                          (outer, -face))]
        for a in angles
    ])  # fmt: skip
    return [ring, *(_spoke(2 * math.pi * k / 6, face - 0.0004) for k in range(6))]


def _spoke(angle: float, face: float) -> Part:
    c, s = math.cos(angle), math.sin(angle)
    straight = [[(u, v, 0.030), (u, v, 0.0)] for u, v in ((-0.004, -face), (-0.004, face), (0.004, face),
                                                          (0.004, -face))]  # fmt: skip
    sections = [[corner[k] for corner in straight] for k in range(2)]
    return loft([[(x * c + z * s, y, z * c - x * s) for x, y, z in section] for section in sections])


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
