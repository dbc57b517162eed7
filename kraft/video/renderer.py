"""Renderer of a trial: a view from behind the car and a map from above, with their cameras; and the film of them.

A film, MP4 or animated WebP, appears at its path only when it is complete.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any, Final, TypeAlias

import av
import mujoco
import numpy as np
from av.video.reformatter import ColorRange, Colorspace
from numpy.typing import NDArray

from kraft.driving.messages import Cycle
from kraft.files import Replacement, unwritable
from kraft.scenario import Bounds
from kraft.simulation.floor_frame import FloorFrame, Surface
from kraft.simulation.true_world import TrueWorld
from kraft.trial.result import TrialSpec
from kraft.video.drawing import Pen, Snapshot, draw_collision, draw_cycle, draw_snapshot
from ompl_ext.arrays import Floats
from ompl_ext.jit import compiled

GEOMS_MAX: Final = 12_000
NEAR, FAR = 0.05, 60.0
"""Clipping distances of the cameras, m."""
SHADOW_MAP: Final = 2048
SHADOW_REACH: Final = 4.2
"""Distance up to which shadows are drawn around a point that moves with the car, m; smaller is sharper."""
LAMP: Final = 8.0
"""Distance from that point to the light that casts them, m."""
MAP_STROKES: Final = 1.5
"""Factor by which strokes are wider on the map, which has a smaller scale."""
EVERYTHING: Final = int(mujoco.mjtCatBit.mjCAT_ALL)

FIELD_OF_VIEW: Final = math.radians(45.0)
DISTANCE: Final = 2.1
"""Distance between the camera and its target, m."""
AHEAD: Final = 0.5
"""Distance in front of the car to which the camera points, m."""
MIN_ELEVATION, MAX_ELEVATION, ELEVATION_STEP = math.radians(36.0), math.radians(80.0), math.radians(3.0)
"""Elevation of the camera above the floor: the lowest one without an obstacle between camera and car."""
SETTLING: Final = 0.35
"""Time in which the camera follows a turn, s."""
ROOF: Final = 0.26
SOLID: Final = np.array([1, 1, 0, 0, 0, 0], np.uint8)
"""Groups of geoms that can hide the car."""


class View:
    """One scene with one camera in one part of the picture."""

    def __init__(self, model: Any, pen_of: Callable[[Any], Pen], part: tuple[int, int, int, int]) -> None:
        """`model` is MuJoCo's, `part` left, bottom, width and height, px."""
        self.scene: Any = mujoco.MjvScene(model, GEOMS_MAX)
        self.pen = pen_of(self.scene)
        self._model, self._rectangle = model, mujoco.MjrRect(*part)
        self._options = mujoco.MjvOption()
        self._options.geomgroup[3] = 0  # what only touches
        self._static_geoms = 0

    def set_static(self, draw: Callable[[Pen], None]) -> None:
        """Draw the static content of the scene, which stays until the next call."""
        self.scene.ngeom = 0
        draw(self.pen)
        self._static_geoms = self.scene.ngeom

    def render(self, context: Any, data: Any, aim: Aim, centre: Floats, draw: Callable[[Pen], None]) -> None:
        """Render the static content, the world of MuJoCo's `data`, and what `draw` adds; shadows are around `centre`.

        Without a GPU multisampling would double the time; `smoothed` takes its place.
        """
        scene, model = self.scene, self._model
        scene.ngeom = self._static_geoms
        aim.apply(scene, NEAR, FAR)
        mujoco.mjv_addGeoms(model, data, self._options, mujoco.MjvPerturb(), EVERYTHING, scene)
        draw(self.pen)
        mujoco.mjv_makeLights(model, data, scene)
        for light in scene.lights[: scene.nlight]:
            if light.castshadow and light.type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL:
                light.pos = centre - LAMP * light.dir
        mujoco.mjr_render(self._rectangle, scene, context)


class SceneRenderer:
    """Both views of a trial.  Needs a current graphics context; `close` frees its buffers.

    It draws snapshots, each with the configuration of its time, so that a drive can be drawn when it is over.
    """

    def __init__(self, world: TrueWorld, spec: TrialSpec, size: tuple[int, int], map_width: int, foot: int) -> None:
        """`size` is the picture's width and height, px.

        The map takes `map_width` of it at the right; beside it `foot` stays free below the view from behind.
        """
        width, height = size
        self._spec, self._cycle, self._frame = spec, -1, world.frame
        self._model, self._data = world.model, mujoco.MjData(world.model)
        self._image: Image = np.empty((height, width, 3), np.uint8)
        self._whole = mujoco.MjrRect(0, 0, width, height)
        visual = world.model.vis
        visual.global_.offwidth, visual.global_.offheight = width, height
        visual.quality.offsamples, visual.quality.shadowsize = 0, SHADOW_MAP
        visual.map.shadowclip = SHADOW_REACH / world.model.stat.extent
        self._context: Any = mujoco.MjrContext(world.model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        surface = Surface.of(spec.scenario, world.frame)
        left = width - map_width
        self._chase = View(self._model, lambda scene: Pen(scene, surface), (0, foot, left, height - foot))
        self._map = View(self._model, lambda scene: Pen(scene, surface, MAP_STROKES), (left, 0, map_width, height))
        self._map.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        for view in (self._chase, self._map):
            view.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._camera = ChaseCamera(self._model, self._frame)
        self._above = map_aim(self._frame, spec.scenario.bounds, map_width / height)

    def picture(self, snapshot: Snapshot) -> Image:
        """The picture at a time of the trial: uint8 (height, width, 3); calls have to be in the order of time."""
        if snapshot.cycle is not None and snapshot.cycle.number != self._cycle:
            self._begin_cycle(snapshot.cycle)
        self._data.qpos[:] = snapshot.configuration
        mujoco.mj_forward(self._model, self._data)
        x, y, theta = snapshot.pose.tolist()
        centre = self._frame.to_world(np.array([x + math.cos(theta), y + math.sin(theta), 0.0]))
        aim = self._camera.aim(self._data, snapshot.time, snapshot.pose)
        for view, camera in ((self._chase, aim), (self._map, self._above)):
            view.render(self._context, self._data, camera, centre, lambda pen: self._draw(pen, snapshot))
        mujoco.mjr_readPixels(self._image, None, self._whole, self._context)
        return smoothed(np.ascontiguousarray(self._image[::-1]))

    def _draw(self, pen: Pen, snapshot: Snapshot) -> None:
        draw_snapshot(pen, snapshot, self._spec.vehicle)
        if snapshot.contact is not None:
            draw_collision(pen, snapshot.contact)

    def close(self) -> None:
        """Free buffers and textures."""
        self._context.free()

    def _begin_cycle(self, cycle: Cycle) -> None:
        self._cycle = cycle.number
        for view in (self._chase, self._map):
            view.set_static(lambda pen: draw_cycle(pen, cycle, self._spec.vehicle))


@dataclass(frozen=True)
class Aim:
    """A camera in the world's frame; `half` is half the picture's height: a tangent, or metres without perspective."""

    position: Floats
    forward: Floats
    up: Floats
    half: float
    perspective: bool

    def apply(self, scene: Any, near: float, far: float) -> None:
        """Set the camera of a scene, with clipping distances `near` and `far`, m."""
        top = self.half * near if self.perspective else self.half
        for camera in scene.camera:
            camera.pos, camera.forward, camera.up = self.position, self.forward, self.up
            camera.frustum_near, camera.frustum_far = near, far
            camera.frustum_bottom, camera.frustum_top = -top, top
            camera.frustum_center = camera.frustum_width = 0.0
            camera.orthographic = int(not self.perspective)


class ChaseCamera:
    """Behind and above the car; turns smoothly, and rises where an obstacle would hide the car."""

    def __init__(self, model: Any, frame: FloorFrame) -> None:
        """`model` is MuJoCo's of the world, `frame` that of its floor."""
        self._model, self._frame = model, frame
        self._time, self._dt = -math.inf, math.inf
        self._heading = self._rate = 0.0
        self._elevation = MIN_ELEVATION

    def aim(self, data: Any, time: float, pose: Floats) -> Aim:
        """Aim at a car with a pose (3,) in the world of MuJoCo's `data`; calls have to be in the order of time."""
        x, y, theta = pose.tolist()
        self._turn(time, theta)
        self._rise(self._clear_elevation(data, x, y))
        target, offset = self._place(x, y, self._elevation)
        position = self._frame.to_world(target + offset)
        return Aim(position, *_level_axes(self._frame.rotation @ -offset), math.tan(FIELD_OF_VIEW / 2), True)

    def _place(self, x: float, y: float, elevation: float) -> tuple[Floats, Floats]:
        """Target of the camera, and position of the camera relative to it, in the floor's frame, m."""
        along, up = np.array([math.cos(self._heading), math.sin(self._heading), 0.0]), np.array([0.0, 0.0, 1.0])
        offset = DISTANCE * (math.sin(elevation) * up - math.cos(elevation) * along)
        return np.array([x, y, 0.08]) + AHEAD * along, offset

    def _turn(self, time: float, heading: float) -> None:
        """Follow the heading like a critically damped spring; the first call sets it."""
        self._dt, self._time = time - self._time, time
        if not math.isfinite(self._dt):
            self._heading = heading
            return
        pull = 2.0 / SETTLING
        ahead = math.remainder(heading - self._heading, math.tau)
        slope, decay = self._rate - pull * ahead, math.exp(-pull * self._dt)
        self._heading += ahead + (slope * self._dt - ahead) * decay
        self._rate = (self._rate - pull * slope * self._dt) * decay

    def _rise(self, elevation: float) -> None:
        """Rise immediately, so that nothing hides the car, and descend slowly."""
        share = 1.0 - math.exp(-self._dt / SETTLING)
        self._elevation = max(elevation, self._elevation + (elevation - self._elevation) * share)

    def _clear_elevation(self, data: Any, x: float, y: float) -> float:
        """Lowest elevation from which nothing hides the roof."""
        roof = np.array([x, y, ROOF])
        start, hit = self._frame.to_world(roof), np.zeros(1, np.int32)
        for elevation in np.arange(MIN_ELEVATION, MAX_ELEVATION, ELEVATION_STEP):
            target, offset = self._place(x, y, float(elevation))
            sight = self._frame.rotation @ (target + offset - roof)
            distance = mujoco.mj_ray(self._model, data, start, sight, SOLID, True, -1, hit)
            if distance < 0.0 or distance > 1.0:  # in lengths of the sight
                return float(elevation)
        return MAX_ELEVATION


def _level_axes(sight: Floats) -> tuple[Floats, Floats]:
    """Unit vectors forward and up of a camera that points along `sight` with a level horizon."""
    forward = sight / np.linalg.norm(sight)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return forward, np.cross(right, forward)


def is_turned(bounds: Bounds) -> bool:
    """Whether +x points up in the map instead of +y: in a scene that is wider than high."""
    return bounds.x[1] - bounds.x[0] > bounds.y[1] - bounds.y[0]


def map_aim(frame: FloorFrame, bounds: Bounds, aspect: float) -> Aim:
    """From above, square to the floor, without perspective; `aspect` is the picture's width over its height.

    +y points up in the picture, or +x if the scene is wider than high.
    """
    size = np.array([bounds.x[1] - bounds.x[0], bounds.y[1] - bounds.y[0]])
    wide = is_turned(bounds)
    across, along = size[::-1] if wide else size
    half = 0.5 * max(along, across / aspect) + 0.12
    rotation = frame.rotation
    centre = frame.to_world(np.array([sum(bounds.x) / 2, sum(bounds.y) / 2, 0.0]))
    up = rotation[:, 0] if wide else rotation[:, 1]
    return Aim(centre + 10.0 * rotation[:, 2], -rotation[:, 2], up, half, False)


CONTRAST: Final = 0.11
"""Contrast from which on neighbours are an edge, as a share of the brightest."""
MIN_CONTRAST: Final = 6.0
"""Contrast below which there is no edge, of 255."""
MAX_SEARCH: Final = 6.0
"""Largest distance of samples along an edge, px."""


def smoothed(image: Image) -> Image:
    """Picture, uint8 (height, width, 3), with aliased edges blurred along their direction."""
    result = image.copy()
    brightness = image @ np.array([0.299, 0.587, 0.114], np.float32)
    _filter()(image, brightness, result)
    return result


@cache
def _filter() -> Any:
    """Compiled when it is first needed."""
    return compiled(_fxaa)


def _fxaa(image: Image, luma: NDArray[np.float32], result: Image) -> None:
    height, width, _ = image.shape
    for i in range(1, height - 1):
        for j in range(1, width - 1):
            nw, ne, sw, se = luma[i - 1, j - 1], luma[i - 1, j + 1], luma[i + 1, j - 1], luma[i + 1, j + 1]
            here = luma[i, j]
            low, high = min(nw, ne, sw, se, here), max(nw, ne, sw, se, here)
            if high - low < max(MIN_CONTRAST, CONTRAST * high):
                continue
            # along the edge: square to the gradient
            dx, dy = (sw + se) - (nw + ne), (nw + sw) - (ne + se)
            least = min(abs(dx), abs(dy)) + max(0.03125 * (nw + ne + sw + se), 2.0)
            dx, dy = max(-MAX_SEARCH, min(MAX_SEARCH, dx / least)), max(-MAX_SEARCH, min(MAX_SEARCH, dy / least))
            for k in range(3):
                near = far = 0.0
                for share in (-0.5, -1.0 / 6.0, 1.0 / 6.0, 0.5):
                    y = max(0.0, min(height - 1.001, i + share * dy))
                    x = max(0.0, min(width - 1.001, j + share * dx))
                    a, b = int(y), int(x)
                    v, u = y - a, x - b
                    upper = (1 - u) * image[a, b, k] + u * image[a, b + 1, k]
                    lower = (1 - u) * image[a + 1, b, k] + u * image[a + 1, b + 1, k]
                    value = (1 - v) * upper + v * lower
                    if abs(share) < 0.4:
                        near += 0.5 * value
                    far += 0.25 * value
                blurred = far if low <= far <= high else near
                result[i, j, k] = np.uint8(blurred + 0.5)


Image: TypeAlias = NDArray[np.uint8]

BT709: Final = 1
"""Code of ITU-R BT.709 for primaries and transfer (ITU-T H.273): the default of players at this size."""


@dataclass(frozen=True)
class Format:
    """Container and codec of a film, its frames per second, and the divisor of the pictures' size."""

    container: str
    codec: str
    fps: int
    divisor: int
    options: tuple[tuple[str, str], ...]
    settings: tuple[tuple[str, str], ...]


FORMATS: Final = {
    ".mp4": Format("mp4", "libx264", 30, 1, (("movflags", "faststart"),), (("preset", "veryfast"), ("crf", "20"))),
    ".webp": Format("webp", "libwebp_anim", 8, 2, (("loop", "0"),), (("quality", "50"), ("compression_level", "6"))),
}
"""Formats by suffix: H.264, and a small animation for pages, half as wide, which repeats without end."""


class FilmWriter:
    """Writes pictures in yuv420p beside `path`; `finish` moves the file to `path`, `discard` removes it.

    `fps` is the number of frames per second, `frames` that of the frames so far.
    """

    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        """Open the file; `size` is width and height of the pictures, px, both multiples of 4.

        Raises:
            InputError: if it cannot be written.
        """
        form = FORMATS[path.suffix.lower()]
        self._path, self._file, self.fps = path, Replacement(path), form.fps
        temporary = str(self._file.temporary)
        self._container: Any = av.open(temporary, "w", format=form.container, options=dict(form.options))
        stream: Any = self._container.add_stream(form.codec, rate=form.fps, options=dict(form.settings))
        stream.width, stream.height = self._size = size[0] // form.divisor, size[1] // form.divisor
        stream.pix_fmt, stream.time_base = "yuv420p", Fraction(1, form.fps)
        coding = stream.codec_context
        coding.color_range, coding.colorspace = ColorRange.MPEG, Colorspace.ITU709
        coding.color_primaries = coding.color_trc = BT709
        self._stream, self.frames = stream, 0

    def add(self, image: Image) -> None:
        """Append a picture, uint8 (height, width, 3)."""
        picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        width, height = self._size
        frame = picture.reformat(
            width, height, "yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
        )
        frame.pts = self.frames
        self.frames += 1
        self._mux(frame)

    def finish(self) -> None:
        """Complete the file and put it in its place.

        Raises:
            InputError: if there is no room for it.
        """
        try:
            self._mux(None)
            self._container.close()
        except OSError as error:
            raise unwritable(self._path, error) from error
        self._file.commit()

    def discard(self) -> None:
        """Close and remove what has been written; does nothing after `finish`."""
        try:
            with suppress(OSError):  # a full disk, which `add` has reported
                self._container.close()
        finally:
            self._file.discard()

    def _mux(self, frame: Any) -> None:
        try:
            for packet in self._stream.encode(frame):
                self._container.mux(packet)
        except OSError as error:
            raise unwritable(self._path, error) from error
