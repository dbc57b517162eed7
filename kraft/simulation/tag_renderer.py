"""Pictures of an ArUco tag on a car's roof, rendered by MuJoCo without lens and noise."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any, Final

import mujoco
import numpy as np

from kraft.gl import offscreen_context
from kraft.simulation.car import FRONT, REAR, SIDE
from kraft.simulation.opencv import PURPOSE
from kraft.simulation.optics import View
from ompl_ext.arrays import Floats, Matrix

SIDE_MAX: Final = 512
"""Largest width and height of a picture, px."""
WIDTH_MAX: Final = 2 * SIDE_MAX
NEAR, FAR = 0.05, 200.0
THICKNESS: Final = 2e-4
"""Height of the layers of roof, paper and ink above each other, m."""
FLOOR, ROOF, PAPER, INK = 0.35, 0.15, 0.80, 0.05
"""Reflectances."""


class TagRenderer:
    """Renders a tag of black and white cells in the middle of a car's roof, above a plain floor.

    The model has nothing but these, evenly lit: a picture's values are reflectances of 0 to 255, without shadows.
    """

    def __init__(self, cells: Matrix, side: float, height: float) -> None:
        """Compile the model and make the graphics context.

        Args:
            cells: (n, n), 1 for white; the first row is the tag's left edge in the direction of the car's x axis.
            side: length of the tag, m.
            height: of the tag above the floor, m.

        Raises:
            MissingDependency: if nothing can be drawn without a window here.
        """
        self._gl: Any = offscreen_context(WIDTH_MAX, SIDE_MAX, PURPOSE)
        self._model: Any = _model(cells, side, height)
        self._data: Any = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)
        self._context: Any = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_50)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene: Any = mujoco.MjvScene(self._model, self._model.ngeom + 8)
        self._scene.flags[:] = 0
        self._options: Any = mujoco.MjvOption()
        self._camera: Any = mujoco.MjvCamera()

    def make_current(self) -> None:
        """Make the graphics context current, after others may have been."""
        self._gl.make_current()

    def mean(self, view: View, corner: Floats, step: float, size: int, poses: Sequence[tuple[Floats, Matrix]]) -> Any:
        """Mean (size, size), float32, of the pictures of the tag at positions (3,), m, with rotations (3, 3).

        The pixel in row i and column j is the ray through `corner` + `step` (j + 1/2, i + 1/2) in the plane at distance
        1 before the camera.
        """
        x, y = corner.tolist()
        half = 0.5 * step * size
        total = np.zeros((size, size), np.float32)
        abreast = max(1, WIDTH_MAX // size)
        for first in range(0, len(poses), abreast):  # reading pixels costs more than rendering, so once for many
            some = poses[first : first + abreast]
            for k, pose in enumerate(some):
                self._place(*pose)
                for camera in self._scene.camera:
                    camera.pos, camera.forward, camera.up = view.position, view.rotation[:, 2], -view.rotation[:, 1]
                    camera.frustum_near, camera.frustum_far = NEAR, FAR
                    camera.frustum_center, camera.frustum_width = NEAR * (x + half), NEAR * half
                    camera.frustum_top, camera.frustum_bottom = -NEAR * y, -NEAR * (y + 2.0 * half)
                mujoco.mjr_render(mujoco.MjrRect(k * size, 0, size, size), self._scene, self._context)
            pixels = np.empty((size, len(some) * size, 3), np.uint8)
            mujoco.mjr_readPixels(pixels, None, mujoco.MjrRect(0, 0, len(some) * size, size), self._context)
            for k in range(len(some)):
                total += pixels[::-1, k * size : (k + 1) * size, 0]
        return total / len(poses)

    def _place(self, position: Floats, rotation: Matrix) -> None:
        """Move the tag, and with it roof and floor."""
        data = self._data
        data.mocap_pos[0] = position
        mujoco.mju_mat2Quat(data.mocap_quat[0], np.ascontiguousarray(rotation).ravel())
        mujoco.mj_kinematics(self._model, data)
        every = int(mujoco.mjtCatBit.mjCAT_ALL)
        mujoco.mjv_updateScene(self._model, data, self._options, None, self._camera, every, self._scene)


def _model(cells: Matrix, side: float, height: float) -> Any:
    spec = mujoco.MjSpec()
    visual = spec.visual
    visual.headlight.ambient, visual.headlight.diffuse, visual.headlight.specular = [1] * 3, [0] * 3, [0] * 3
    visual.global_.offwidth, visual.global_.offheight = WIDTH_MAX, SIDE_MAX
    visual.quality.offsamples = visual.quality.shadowsize = 0
    body = spec.worldbody.add_body(mocap=True)

    def plate(at: tuple[float, float], size: tuple[float, float], top: float, reflectance: float) -> None:
        half = 0.5 * THICKNESS
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, pos=[*at, top - half], size=[0.5 * size[0], 0.5 * size[1], half],
            rgba=[reflectance] * 3 + [1.0], contype=0, conaffinity=0,
        )  # fmt: skip

    count = len(cells)
    cell = side / count
    plate((0.0, 0.0), (200.0, 200.0), -height, FLOOR)
    plate((0.5 * (FRONT + REAR), 0.0), (FRONT - REAR, 2.0 * SIDE), -2 * THICKNESS, ROOF)
    plate((0.0, 0.0), (side + 2 * cell, side + 2 * cell), -THICKNESS, PAPER)
    for row, line in enumerate(cells):
        edges = np.flatnonzero(np.diff(line == 0, prepend=False, append=False)).reshape(-1, 2)
        for begin, end in edges.tolist():  # a plate for every run of black cells
            at = (0.5 * (begin + end) * cell - 0.5 * side, 0.5 * side - (row + 0.5) * cell)
            plate(at, ((end - begin) * cell, cell), 0.0, INK)
    return spec.compile()


_LOCAL: Final = threading.local()


def tag_renderer(cells: Matrix, side: float, height: float) -> TagRenderer:
    """Renderer of a tag, made once in each thread, because graphics contexts belong to threads."""
    made: dict[Any, TagRenderer] = _LOCAL.__dict__.setdefault("made", {})
    key = (cells.tobytes(), side, height)
    if key not in made:
        made[key] = TagRenderer(cells, side, height)
    made[key].make_current()
    return made[key]
