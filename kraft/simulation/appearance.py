"""Materials, light and visual geoms of a scene; those of the car are in `car_visuals`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Literal

import mujoco
import numpy as np

from kraft.scenario import Box, Scenario
from kraft.simulation import contacts
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


def rgba(name: str) -> list[float]:
    """A colour's red, green, blue and opacity in [0, 1]."""
    return [*(int(COLOURS[name][k : k + 2], 16) / 255 for k in (1, 3, 5)), OPACITY.get(name, 1.0)]


def add_materials(spec: Any) -> None:
    """Add all materials that geoms refer to."""
    for name in COLOURS:
        shininess = SHININESS.get(name, 0.15)
        emission = EMISSION.get(name, 0.0)
        spec.add_material(name=name, rgba=rgba(name), specular=shininess, shininess=shininess, emission=emission)
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


def add_light(spec: Any, scenario: Scenario) -> None:
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


def add_surroundings(spec: Any, ground: Any, scenario: Scenario, frame: FloorFrame) -> None:
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
