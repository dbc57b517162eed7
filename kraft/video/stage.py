"""The rendered picture: the scene from behind the car and, beside it, from above."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final

import mujoco
import numpy as np

from kraft.driving.messages import Cycle
from kraft.simulation.surface import Surface
from kraft.simulation.world import World
from kraft.trial.result import TrialSpec
from kraft.video.camera import Aim, ChaseCamera, map_aim
from kraft.video.drawing import draw_crash, draw_cycle, draw_moment
from kraft.video.moment import Moment
from kraft.video.mp4 import Image
from kraft.video.pen import Pen
from kraft.video.smooth import smoothed
from ompl_ext.arrays import Floats

GEOMS_MAX: Final = 12_000
NEAR, FAR = 0.05, 60.0
"""Limits of what is seen, m."""
SHADOW_MAP: Final = 2048
SHADOW_REACH: Final = 4.2
"""Shadows are seen this far around a point that moves with the car, m; the smaller, the sharper."""
LAMP: Final = 8.0
"""Distance from there to the lamp that casts them, m."""
MAP_STROKES: Final = 1.5
"""By how much strokes are wider on the map, where everything is small."""
EVERYTHING: Final = int(mujoco.mjtCatBit.mjCAT_ALL)


class View:
    """One scene with one camera in one part of the picture."""

    def __init__(self, world: World, pen_of: Callable[[Any], Pen], part: tuple[int, int, int, int]) -> None:
        """`part` is left, bottom, width and height, px."""
        self.scene: Any = mujoco.MjvScene(world.model, GEOMS_MAX)
        self.pen = pen_of(self.scene)
        self._world, self._rectangle = world, mujoco.MjrRect(*part)
        self._options = mujoco.MjvOption()
        self._options.geomgroup[3] = 0  # what only touches
        self._kept = 0

    def keep(self, draw: Callable[[Pen], None]) -> None:
        """Draw what stays in the scene until this is called again."""
        self.scene.ngeom = 0
        draw(self.pen)
        self._kept = self.scene.ngeom

    def render(self, context: Any, aim: Aim, draw: Callable[[Pen], None]) -> None:
        """Render what stays, the world as it is, and what is drawn now.

        Without a GPU multisampling would double the time; `kraft.video.smooth` takes its place.
        """
        scene, world = self.scene, self._world
        scene.ngeom = self._kept
        aim.apply(scene, NEAR, FAR)
        mujoco.mjv_addGeoms(world.model, world.data, self._options, mujoco.MjvPerturb(), EVERYTHING, scene)
        draw(self.pen)
        mujoco.mjv_makeLights(world.model, world.data, scene)
        for light in scene.lights[: scene.nlight]:
            if light.castshadow and light.type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL:
                light.pos = self._seen() - LAMP * light.dir
        mujoco.mjr_render(self._rectangle, scene, context)

    def _seen(self) -> Floats:
        """The middle of what the view from behind shows, in the world's frame."""
        x, y, theta = map(float, self._world.pose)
        return self._world.frame.to_world(np.array([x + math.cos(theta), y + math.sin(theta), 0.0]))


class Stage:
    """Both views of a trial.  Needs a current graphics context; `close` frees what it holds there."""

    def __init__(self, world: World, spec: TrialSpec, size: tuple[int, int], map_width: int, foot: int) -> None:
        """`size` is the picture's width and height, px.

        The map takes `map_width` of it at the right; beside it `foot` stays free below the view from behind.
        """
        width, height = size
        self._world, self._spec, self._cycle = world, spec, -1
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
        self._chase = View(world, lambda scene: Pen(scene, surface), (0, foot, left, height - foot))
        self._map = View(world, lambda scene: Pen(scene, surface, MAP_STROKES), (left, 0, map_width, height))
        self._map.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        for view in (self._chase, self._map):
            view.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._camera, self._above = ChaseCamera(), map_aim(world, spec.scenario.bounds, map_width / height)

    def picture(self, moment: Moment) -> Image:
        """The picture of the world as it is: uint8 (height, width, 3)."""
        if moment.cycle is not None and moment.cycle.number != self._cycle:
            self._begin(moment.cycle)
        for view, aim in ((self._chase, self._camera.aim(self._world)), (self._map, self._above)):
            view.render(self._context, aim, lambda pen: self._draw(pen, moment))
        mujoco.mjr_readPixels(self._image, None, self._whole, self._context)
        return smoothed(np.ascontiguousarray(self._image[::-1]))

    def _draw(self, pen: Pen, moment: Moment) -> None:
        draw_moment(pen, moment, self._spec.vehicle)
        if self._world.collision is not None:
            draw_crash(pen, self._world.collision.point)

    def close(self) -> None:
        """Free buffers and textures."""
        self._context.free()

    def _begin(self, cycle: Cycle) -> None:
        self._cycle = cycle.number
        for view in (self._chase, self._map):
            view.keep(lambda pen: draw_cycle(pen, cycle, self._spec.vehicle))
