"""Look of the simulated world: materials, light and visual geoms of a scene and of the car, without mass or contacts.

The visual geoms of the car are a small rally car.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Final, Literal, TypeAlias

import mujoco
import numpy as np

from kraft.scenario import Box, Scenario
from kraft.scenario.schema import MARKER_HEIGHT
from kraft.simulation import contacts
from kraft.simulation.car import MUSHR, WHEELS, CarDesign
from kraft.simulation.floor_frame import FloorFrame
from ompl_ext.arrays import Matrix

BOX, CYLINDER = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER

COLOURS: Final = {
    "obstacle": "#8fa3b8", "wall": "#e9e4da", "bump": "#f2b632", "bump stripe": "#33363b", "ice": "#9fd8ee",
    "cardboard": "#c79a66", "tape": "#e3c79b", "goal": "#2fae74", "goal rim": "#1d8a58", "table": "#4a525d",
    "paint": "#d63a1f", "stripe": "#f7f5ef", "glass": "#1b222b", "trim": "#22252a", "lamp": "#fff6d8",
    "tail lamp": "#a3100c", "plate": "#ffffff", "ink": "#08080a", "tyre": "#1d1e21", "rim": "#d5d8dc",
}  # fmt: skip
SHININESS: Final = {"paint": 0.7, "glass": 0.9, "rim": 0.8, "ice": 0.8, "lamp": 0.5}
EMISSION: Final = {"lamp": 0.5, "tail lamp": 0.3, "plate": 0.15, "goal": 0.1}
OPACITY: Final = {"ice": 0.75, "goal": 0.85}

MARGIN: Final = 0.35
"""Width of the visible floor beyond the bounds, m."""
THICKNESS: Final = 0.06
TABLE: Final = 0.45
"""Width of the table beyond the visible floor, m."""
STRIPE: Final = 0.1
"""Width of a bump's stripes, m, about."""
PROUD: Final = 0.0006
"""Height of tape and stripes above what they are on, m."""


def rgba(name: str) -> list[float]:
    """A colour's red, green, blue and opacity in [0, 1]."""
    return [*(int(COLOURS[name][k : k + 2], 16) / 255 for k in (1, 3, 5)), OPACITY.get(name, 1.0)]


def add_materials(spec: Any) -> None:
    """Add the plain materials that geoms refer to."""
    for name in COLOURS:
        shininess = SHININESS.get(name, 0.15)
        emission = EMISSION.get(name, 0.0)
        spec.add_material(name=name, rgba=rgba(name), specular=shininess, shininess=shininess, emission=emission)


def add_visuals(spec: Any, ground: Any, scenario: Scenario, frame: FloorFrame) -> None:
    """Add all that is only there to be seen, apart from that of the robot."""
    _add_textures(spec)
    _add_light(spec, scenario)
    on_ground = _add_visual_body(ground)
    _add_stripes(spec, on_ground, len(scenario.truth.speed_bumps))
    _add_tape(spec, scenario)
    _add_surroundings(spec, on_ground, scenario, frame)


def _add_visual_body(body: Any) -> Any:
    """Add a body without mass, fixed to another one, for the visual geoms of that.

    MuJoCo looks for contacts of bodies with several geoms in another way than for those with one, and finds others of
    surfaces that just touch: with visual geoms in the body itself, a world that is drawn would move differently.
    """
    return body.add_body(name=f"{body.name} to be seen")


def _add_textures(spec: Any) -> None:
    """Add those of sky and floor, with the floor's material."""
    spec.add_texture(
        name="floor", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        mark=mujoco.mjtMark.mjMARK_EDGE, rgb1=[0.80, 0.79, 0.77], rgb2=[0.76, 0.75, 0.73],
        markrgb=[0.68, 0.67, 0.65], width=512, height=512,
    )  # fmt: skip
    floor = spec.add_material(name="floor", texrepeat=[1.0, 1.0], texuniform=True, specular=0.1)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.50, 0.55, 0.62], rgb2=[0.24, 0.27, 0.32], width=256, height=1536,
    )  # fmt: skip


def _add_light(spec: Any, scenario: Scenario) -> None:
    """Add a directional light that casts shadows, and ambient light."""
    x, y = sum(scenario.bounds.x) / 2, sum(scenario.bounds.y) / 2
    spec.visual.headlight.ambient = [0.38, 0.38, 0.40]
    spec.visual.headlight.diffuse = [0.22, 0.22, 0.22]
    spec.visual.headlight.specular = [0.05, 0.05, 0.05]
    spec.visual.quality.shadowsize = 8192
    spec.visual.map.znear = 0.005
    spec.visual.map.shadowclip = 0.62  # of the extent: just enough for the table, so that shadows are sharp
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1920, 1080
    spec.stat.extent = max(scenario.bounds.x[1] - scenario.bounds.x[0], scenario.bounds.y[1] - scenario.bounds.y[0])
    spec.stat.center = [x, y, 0.0]
    spec.worldbody.add_light(
        name="key", pos=[x - 3.0, y - 2.0, 7.0], dir=[0.42, 0.28, -1.0], castshadow=True,
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, diffuse=[0.55, 0.54, 0.51], specular=[0.35, 0.35, 0.35],
    )  # fmt: skip


def _add_stripes(spec: Any, ground: Any, bumps: int) -> None:
    """Add stripes around the cylinders of bumps."""
    for i in range(bumps):
        bump = spec.geom(f"bump {i}")
        (radius, half, _), axis = bump.size.tolist(), np.empty(3)
        mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, 1.0]), bump.quat)
        stripes = max(1, round(half / STRIPE))
        for k in range(stripes):
            place = bump.pos + ((k + 0.5) / stripes - 0.5) * 2 * half * axis
            size = [radius + PROUD, half / stripes / 2, 0.0]
            ground.add_geom(
                type=CYLINDER, pos=place, quat=bump.quat, size=size, material="bump stripe", **contacts.VISUAL
            )


def _add_tape(spec: Any, scenario: Scenario) -> None:
    """Add tape around the movable boxes."""
    for i, box in enumerate(scenario.truth.movable_boxes):
        length, _, height = box.size
        tape = [length / 2 + PROUD, 0.025, height / 2 + PROUD]
        seen = _add_visual_body(spec.body(f"movable {i}"))
        seen.add_geom(type=BOX, size=tape, material="tape", **contacts.VISUAL)


def _add_surroundings(spec: Any, ground: Any, scenario: Scenario, frame: FloorFrame) -> None:
    """Add a slab under the scene, which shows the tilt, a level table below it, and the goal."""
    bounds, goal = scenario.bounds, scenario.goal
    half = [(bounds.x[1] - bounds.x[0]) / 2 + MARGIN, (bounds.y[1] - bounds.y[0]) / 2 + MARGIN]
    centre = [sum(bounds.x) / 2, sum(bounds.y) / 2]
    ground.add_geom(
        type=BOX, pos=[*centre, -THICKNESS / 2], size=[*half, THICKNESS / 2], material="floor", **contacts.VISUAL
    )
    corners = [np.array([centre[0] + a * half[0], centre[1] + b * half[1], 0.0]) for a in (-1, 1) for b in (-1, 1)]
    lowest = min(float(frame.to_world(corner)[2]) for corner in corners) - THICKNESS - 0.01
    table = [half[0] + TABLE, half[1] + TABLE, 0.02]
    spec.worldbody.add_geom(type=BOX, pos=[*centre, lowest - 0.02], size=table, material="table", **contacts.VISUAL)
    for name, radius, top in (("goal rim", goal.radius, 0.0012), ("goal", 0.92 * goal.radius, 0.0018)):
        ground.add_geom(
            type=CYLINDER, pos=[*goal.center, top / 2], size=[radius, top / 2, 0.0], material=name, **contacts.VISUAL
        )


@dataclass(frozen=True)
class HiddenFeature:
    """Outline (n, 2) of a hidden feature in the map's frame, m."""

    kind: Literal["patch", "bump", "box"]
    corners: Matrix


def hidden_features(scenario: Scenario, movable_poses: Matrix | None = None) -> list[HiddenFeature]:
    """Patches, bumps and movable boxes; boxes are at `movable_poses` (n, 3), m and rad, or at their initial poses."""
    truth = scenario.truth
    found = [
        HiddenFeature("patch", np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]))
        for (x0, x1), (y0, y1) in ((patch.x, patch.y) for patch in truth.friction_patches)
    ]
    found += [HiddenFeature("bump", _corners(Box(bump.center, bump.size, bump.yaw))) for bump in truth.speed_bumps]
    for i, box in enumerate(truth.movable_boxes):
        x, y, yaw = (*box.center, box.yaw) if movable_poses is None else map(float, movable_poses[i])
        found.append(HiddenFeature("box", _corners(Box((x, y), box.size[:2], yaw))))
    return found


def _corners(box: Box) -> Matrix:
    return np.array(box.corners)


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
    seen = _add_visual_body(body)
    stretch = [(design.front - design.rear) / (MUSHR.front - MUSHR.rear), design.side / MUSHR.side, 1.0]
    for material, parts in meshes.items():
        scaled = parts if design == MUSHR else [(vertices * stretch, faces) for vertices, faces in parts]
        _add_visual(seen, add_mesh(spec, f"car {material}", scaled), material)
    sides = [design.wheel_radius / MUSHR.wheel_radius, design.wheel_width / MUSHR.wheel_width]
    rim = [sides[0], sides[1], sides[0]]
    add_mesh(spec, "rim", _rim() if design == MUSHR else [(vertices * rim, faces) for vertices, faces in _rim()])
    for name in WHEELS:
        wheel = _add_visual_body(spec.body(name))
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
