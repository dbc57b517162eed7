"""The part of a camera's frame that shows the tag: lens, rendering, motion blur, sensor noise, 8 bits.

The lens projects with Brown's distortion; its calibration has errors.
"""

from __future__ import annotations

import importlib
import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final

import mujoco
import numpy as np

from kraft.errors import MissingDependency
from kraft.gl import offscreen_context
from kraft.provenance import install_command
from kraft.scenario.schema import MARKER_HEIGHT
from kraft.simulation.camera import HALF_MARKER
from kraft.simulation.car import MUSHR
from ompl_ext.arrays import Floats, Matrix

CORNERS: Final = HALF_MARKER * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
"""Corners of the tag in its frame, in OpenCV's order, m."""
OVERSAMPLING: Final = 3
"""Rendered pixels along each side of a pixel of the frame."""
ROLL: Final = 0.2
"""Angle between rows of rendered pixels and of the frame, rad: smooth edges also where tag and frame are parallel."""
QUIET: Final = 1.34
"""Side of the paper over that of the tag."""
SIDE_MAX: Final = 512
"""Largest width and height of a picture, px."""
WIDTH_MAX: Final = 2 * SIDE_MAX
NEAR, FAR = 0.05, 200.0
"""Clipping distances of the picture, m: nearer than any camera is to the paper, and farther than any floor is long."""
THICKNESS: Final = 2e-4
"""Height of the layers of roof, paper and ink above each other, m."""
FLOOR, ROOF, PAPER, INK = 0.35, 0.15, 0.80, 0.05
"""Reflectances."""
GRID: Final = np.stack(np.meshgrid(np.linspace(-1.0, 1.0, 7), np.linspace(-1.0, 1.0, 7)), axis=-1).reshape(-1, 2)
"""Points (n, 2) of the square from -1 to 1 through which the lens is computed exactly."""
POWERS: Final = np.array([(i, j) for i in range(4) for j in range(4 - i)])
MONOMIALS: Final = GRID[:, :1] ** POWERS[:, 0] * GRID[:, 1:] ** POWERS[:, 1]
"""Monomials (n, m) of a cubic, with these powers (m, 2), at the points."""


@dataclass(frozen=True)
class Imaging:
    """What light suffers on its way to 8 bits.

    Attributes:
        exposure: time for which the sensor collects light, s.
        blur: standard deviation of the lens' point spread, px.
        full_well: electrons of a pixel at value 1.
        read_noise: standard deviation, electrons.
        gain: standard deviation of the logarithm of the brightness, of a trial and of its frames about that.
        gamma: exponent with which the camera encodes light; 2.2 as sRGB.
    """

    exposure: float = 0.010
    blur: float = 0.5
    full_well: float = 6000.0
    read_noise: float = 12.0
    gain: tuple[float, float] = (0.15, 0.01)
    gamma: float = 2.2


class Imager:
    """Makes the frames of one trial, reproducibly for a generator."""

    def __init__(self, lens: Lens, view: View, imaging: Imaging, generator: np.random.Generator) -> None:
        """Lens and pose of the camera are the true ones.

        Raises:
            MissingDependency: if OpenCV or OpenGL is missing.
        """
        self.lens, self.view, self.imaging = lens, view, imaging
        self._cells = tag_cells()
        tag_renderer(self._cells, 2.0 * HALF_MARKER, MARKER_HEIGHT)
        self._generator = generator
        self._gain = imaging.gain[0] * float(generator.standard_normal())
        self._last: tuple[float, Floats, Matrix] | None = None

    def frame(self, time: float, position: Floats, rotation: Matrix) -> tuple[Any, Floats] | None:
        """Part of the frame at `time` (s) with the tag, uint8, and its first column and row; None if it is not in it.

        The tag's motion during the exposure, the middle of which is `time`, is that since the frame before.
        """
        # as many draws in every frame, whatever it shows
        noise = np.random.Generator(np.random.PCG64(self._generator.integers(2**63)))
        poses = self._motion(time, position, rotation)
        corners = self.corners(position, rotation)
        if corners is None:
            return None
        low, high = corners.min(axis=0), corners.max(axis=0)
        size = 8 * math.ceil((QUIET * float((high - low).max()) + 14.0) / 8.0)
        first = np.round(0.5 * (low + high) - 0.5 * size).astype(int)
        start, end = np.maximum(first, 0), np.minimum(first + size, (WIDTH, HEIGHT))
        if (end <= start).any():
            return None
        part = self._developed(self._light(first.astype(float), size, poses), noise)
        (left, top), (right, bottom) = start - first, end - first
        return np.ascontiguousarray(part[top:bottom, left:right]), start.astype(float)

    def corners(self, position: Floats, rotation: Matrix) -> Matrix | None:
        """True pixels (4, 2) of the tag's corners, None if it is not before the camera or turned away."""
        return tag_corners(self.lens, self.view, position, rotation)

    def _motion(self, time: float, position: Floats, rotation: Matrix) -> list[tuple[Floats, Matrix]]:
        """Poses at equal intervals during the exposure, as many as the motion in the frame needs."""
        last, self._last = self._last, (time, position, rotation)
        if last is None or time <= last[0]:
            return [(position, rotation)]
        share = self.imaging.exposure / (time - last[0])
        moved, turned = share * (position - last[1]), share * _rotation_vector(rotation @ last[2].T)
        reach = math.sqrt(moved.dot(moved)) + HALF_MARKER * math.sqrt(turned.dot(turned))
        distance = float(np.linalg.norm(position - self.view.position))
        count = min(8, 1 + math.ceil(1.5 * reach * self.lens.focal / distance - 0.05))
        times = (np.arange(count) + 0.5) / count - 0.5
        return [(position + at * moved, rotation_about(at * turned) @ rotation) for at in times]

    def _light(self, first: Floats, size: int, poses: list[tuple[Floats, Matrix]]) -> Any:
        """Light (size, size), 0 to 1, that reaches the pixels from column and row `first` on."""
        cv2, fine = opencv(), max(1, min(OVERSAMPLING, SIDE_MAX // (2 * size)))
        turn = np.array([[math.cos(ROLL), -math.sin(ROLL)], [math.sin(ROLL), math.cos(ROLL)]])
        rolled = View(self.view.position, np.column_stack([self.view.rotation[:, :2] @ turn, self.view.rotation[:, 2]]))
        rays = self.lens.undistorted(first + 0.5 * size * (GRID + 1.0) - 0.5) @ turn
        low, high = rays.min(axis=0), rays.max(axis=0)
        count = math.ceil(1.17 * size * fine) + 4
        step = float((high - low).max()) / (count - 2)
        corner = 0.5 * (low + high) - 0.5 * step * count
        picture = tag_renderer(self._cells, 2.0 * HALF_MARKER, MARKER_HEIGHT).mean(rolled, corner, step, count, poses)
        columns, rows = _smooth_maps((rays - corner) / step - 0.5, size * fine)
        light = cv2.remap(picture, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        light = cv2.GaussianBlur(light, (0, 0), self.imaging.blur * fine)
        return cv2.resize(light, (size, size), interpolation=cv2.INTER_AREA) / 255.0

    def _developed(self, light: Any, noise: np.random.Generator) -> Any:
        """The frame, uint8, that the camera makes of light: gain, shot and read noise, gamma."""
        imaging = self.imaging
        gain = math.exp(self._gain + imaging.gain[1] * float(noise.standard_normal()))
        electrons = imaging.full_well * gain * light
        deviation = np.sqrt(electrons + imaging.read_noise**2)
        electrons = electrons + deviation * noise.standard_normal(light.shape, np.float32)
        linear = np.clip(electrons / imaging.full_well, 0.0, 1.0)
        return np.round(255.0 * linear ** (1.0 / imaging.gamma)).astype(np.uint8)


def tag_corners(lens: Lens, view: View, position: Floats, rotation: Matrix) -> Matrix | None:
    """Pixels (4, 2) of a tag's corners, position (3,) in m; None if it is not before the camera or turned away."""
    inside = view.points(position + CORNERS @ rotation.T)
    if (inside[:, 2] < 0.1).any() or rotation[:, 2].dot(view.position - position) <= 0.0:
        return None
    ahead = inside[:, :2] / inside[:, 2:]
    return lens.distorted(ahead) if (np.abs(ahead) < 1.0).all() else None


def _smooth_maps(values: Matrix, count: int) -> tuple[Any, Any]:
    """Two maps (count, count), float32, over the square from -1 to 1: cubics through values (n, 2) at `GRID`.

    Across a tag they fit a lens to 0.001 px.
    """
    fitted = np.zeros((4, 4, 2))
    fitted[POWERS[:, 0], POWERS[:, 1]] = np.linalg.lstsq(MONOMIALS, values, rcond=None)[0]
    at = _pixel_powers(count)
    columns, rows = ((at @ fitted[:, :, axis].T @ at.T).astype(np.float32) for axis in (0, 1))
    return columns, rows


@lru_cache(64)  # a tag has few sizes
def _pixel_powers(count: int) -> Matrix:
    """Powers 0 to 3 (count, 4) of the centres of `count` pixels across the square from -1 to 1."""
    return np.vander((2.0 * np.arange(count) + 1.0) / count - 1.0, 4, increasing=True)


def _rotation_vector(rotation: Matrix) -> Floats:
    """Rotation vector (3,) of a small rotation, rad."""
    return 0.5 * np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )


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
        self._scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = 1  # the undersides of plates are half of all pixels
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
    plate((0.5 * (MUSHR.front + MUSHR.rear), 0.0), (MUSHR.front - MUSHR.rear, 2.0 * MUSHR.side), -2 * THICKNESS, ROOF)
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


WIDTH, HEIGHT = 1280, 720
"""Size of a frame, px."""
FIELD_OF_VIEW: Final = math.radians(70.4)
"""Along the width of a frame; as of a Logitech C920 (78 degrees along the diagonal), a RealSense D435 has 69."""


@dataclass(frozen=True)
class Lens:
    """Intrinsic parameters: focal length and principal point in px, OpenCV's distortion k1, k2, p1, p2, k3."""

    focal: float = 0.5 * WIDTH / math.tan(0.5 * FIELD_OF_VIEW)
    centre: tuple[float, float] = (0.5 * WIDTH - 0.5, 0.5 * HEIGHT - 0.5)
    distortion: tuple[float, float, float, float, float] = (0.10, -0.18, 0.0005, -0.0005, 0.0)

    @property
    def matrix(self) -> Matrix:
        """Camera matrix (3, 3)."""
        return np.array([[self.focal, 0.0, self.centre[0]], [0.0, self.focal, self.centre[1]], [0.0, 0.0, 1.0]])

    def distorted(self, points: Matrix) -> Matrix:
        """Pixels (n, 2) of points (n, 2) in the plane at distance 1 before the camera, x right and y down."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = points.T
        squared = x * x + y * y
        radial = 1.0 + squared * (k1 + squared * (k2 + squared * k3))
        pixels = np.empty((len(points), 2))
        pixels[:, 0] = x * radial + 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x)
        pixels[:, 1] = y * radial + p1 * (squared + 2.0 * y * y) + 2.0 * p2 * x * y
        return self.focal * pixels + self.centre

    def undistorted(self, pixels: Matrix) -> Matrix:
        """Inverse of `distorted`, by fixed-point iteration."""
        wanted = (pixels - self.centre) / self.focal
        points = wanted.copy()
        for _ in range(8):
            points += wanted - (self.distorted(points) - self.centre) / self.focal
        return points


@dataclass(frozen=True)
class View:
    """Pose of a camera: position (3,), m, and rotation (3, 3) whose columns are its right, down and forward axes."""

    position: Floats
    rotation: Matrix

    @classmethod
    def towards(cls, position: Floats, target: Floats, along: Floats) -> View:
        """Camera at `position` that looks at `target`; the width of its frame lies along the direction `along`."""
        forward = (target - position) / np.linalg.norm(target - position)
        right = along - forward * forward.dot(along)
        right /= np.linalg.norm(right)
        return cls(position, np.stack([right, np.cross(forward, right), forward], axis=1))

    def points(self, world: Matrix) -> Matrix:
        """Points (n, 3) of the world in the camera's frame."""
        inside: Matrix = (world - self.position) @ self.rotation
        return inside


@dataclass(frozen=True)
class Calibration:
    """Standard deviations of what a calibration gets wrong: lens (px, and k1 and k2), position (m), rotation (rad)."""

    focal: float = 2.0
    centre: float = 1.0
    distortion: tuple[float, float] = (0.005, 0.01)
    position: float = 0.005
    rotation: float = math.radians(0.1)

    def of(self, lens: Lens, view: View, generator: np.random.Generator) -> tuple[Lens, View]:
        """Lens and pose as a calibration finds them."""
        draws = generator.standard_normal(11)
        k1, k2, *others = lens.distortion
        found = replace(
            lens,
            focal=lens.focal + self.focal * draws[0],
            centre=(lens.centre[0] + self.centre * draws[1], lens.centre[1] + self.centre * draws[2]),
            distortion=(k1 + self.distortion[0] * draws[3], k2 + self.distortion[1] * draws[4], *others),
        )
        turned = view.rotation @ rotation_about(self.rotation * draws[8:11])
        return found, View(view.position + self.position * draws[5:8], turned)


def rotation_about(vector: Floats) -> Matrix:
    """Rotation (3, 3) about a vector by its length, rad."""
    angle = math.sqrt(vector.dot(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = (vector / angle).tolist()
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Matrix = np.eye(3) + math.sin(angle) * skew + (1.0 - math.cos(angle)) * skew @ skew
    return rotation


PURPOSE: Final = "sensing.preset rendered"
DICTIONARY: Final = "DICT_4X4_50"


def opencv() -> Any:
    """The module.

    Raises:
        MissingDependency: if it is not installed, does not load or lacks the detector of tags.
    """
    try:
        cv2 = importlib.import_module("cv2")
        cv2.aruco.ArucoDetector  # noqa: B018 - builds of OpenCV may lack it
    except (ImportError, OSError, AttributeError) as error:
        problem = f"{PURPOSE} needs OpenCV with its detector of ArUco tags ({error})"
        raise MissingDependency(f"{problem}; {install_command('vision')}") from None
    return cv2


def dictionary() -> Any:
    """Dictionary of the tag; the car has number 0."""
    aruco = opencv().aruco
    return aruco.getPredefinedDictionary(getattr(aruco, DICTIONARY))


def tag_cells() -> Matrix:
    """Cells (n, n) of the tag with its black border, 1 for white, its picture's first row first."""
    words = dictionary()
    cells: Matrix = (opencv().aruco.generateImageMarker(words, 0, words.markerSize + 2) > 127).astype(float)
    return cells
