"""Strokes, dashes, outlines and lines on the ground of a MuJoCo scene, in the map's coordinates."""

from __future__ import annotations

from typing import Any, Final, TypeAlias

import mujoco
import numpy as np

from kraft.simulation.surface import Surface
from ompl_ext.arrays import Floats, Matrix

Colour: TypeAlias = tuple[float, float, float, float]

SPACING: Final = 0.05
"""Length of the straight pieces of a stroke, m: short enough for curves and bumps."""
THICKNESS: Final = 0.002
STAGGER: Final = 2e-5
"""Each piece lies this much above the one before it, m: where they overlap one of them is in front."""

LINE, BOX, SPHERE = mujoco.mjtGeom.mjGEOM_LINE, mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE


class Pen:
    """Adds geoms to a scene, as long as it has room for them; `scale` widens every stroke."""

    def __init__(self, scene: Any, surface: Surface, scale: float = 1.0) -> None:
        self._scene, self._surface, self._scale = scene, surface, scale

    def stroke(self, path: Matrix, width: float, rise: float, colour: Colour) -> None:
        """A flat band along a path (n, 2), `rise` above the ground; m."""
        if len(path) > 1:
            pieces = segments(self._surface.raised(resampled(path, SPACING), rise))
            self._bands(pieces, width, np.tile(colour, (len(pieces), 1)))

    def shaded(self, path: Matrix, width: float, rise: float, colours: Matrix) -> None:
        """A flat band along a path (n, 2) without resampling; piece i has the colour `colours[i]` of (n - 1, 4)."""
        if len(path) > 1:
            self._bands(segments(self._surface.raised(path, rise)), width, colours)

    def dashes(self, path: Matrix, width: float, rise: float, colour: Colour, length: float = 0.045) -> None:
        """A band in dashes of `length` with gaps a little shorter."""
        if len(path) > 1:
            places = self._surface.raised(resampled(path, length / 3), rise)
            pieces = segments(places)
            shown = np.arange(len(pieces)) % 5 < 3
            self._bands(pieces[shown], width, np.tile(colour, (int(shown.sum()), 1)))

    def outline(self, corners: Matrix, width: float, rise: float, colour: Colour) -> None:
        """A closed band through corners (n, 2)."""
        closed = np.vstack([corners, corners[:1]])
        for side in segments(closed):
            self.stroke(side, width, rise, colour)

    def sphere(self, centre: Floats, radius: float, colour: Colour) -> None:
        """A sphere around a point (3,) of the floor's frame."""
        place = self._surface.to_world(centre[None, :])[0]
        self._add(SPHERE, np.full(3, radius), place, np.eye(3), np.array(colour))

    def lines(self, pieces: Floats, rise: float, colour: Colour, pixels: float) -> None:
        """Straight lines (n, 2, 2), `pixels` wide however far they are."""
        ends = self._surface.to_world(self._surface.raised(pieces.reshape(-1, 2), rise)).reshape(-1, 2, 3)
        zero, eye, rgba = np.zeros(3), np.eye(3).ravel(), np.array(colour, np.float32)
        for begin, end in ends:
            geom = self._next()
            if geom is None:
                return
            mujoco.mjv_initGeom(geom, LINE, zero, zero, eye, rgba)
            mujoco.mjv_connector(geom, LINE, pixels, begin, end)
            geom.emission, geom.castshadow = 1.0, 0

    def _bands(self, pieces: Floats, width: float, colours: Matrix) -> None:
        """A thin box for each piece (n, 2, 3) of the floor's frame; each is a little longer, to close bends."""
        along = pieces[:, 1] - pieces[:, 0]
        length = np.linalg.norm(along, axis=1)
        kept = length > 1e-9
        pieces, along, length, colours = pieces[kept], along[kept], length[kept], colours[kept]
        forward = along / length[:, None]
        side = np.cross([0.0, 0.0, 1.0], forward)
        side /= np.linalg.norm(side, axis=1)[:, None]
        axes = self._surface.frame.rotation @ np.stack([forward, side, np.cross(forward, side)], axis=-1)
        pieces[:, :, 2] += STAGGER * np.arange(len(pieces))[:, None]
        middles = self._surface.to_world(pieces.mean(axis=1))
        wide = self._scale * width
        for k in range(len(pieces)):
            half = np.array([length[k] / 2 + 0.03 * wide, wide / 2, THICKNESS / 2])
            self._add(BOX, half, middles[k], axes[k], colours[k])

    def _add(self, kind: int, half: Floats, place: Floats, axes: Matrix, colour: Floats) -> None:
        geom = self._next()
        if geom is not None:
            mujoco.mjv_initGeom(geom, kind, half, place, axes.ravel(), colour.astype(np.float32))
            geom.specular, geom.castshadow = 0.0, 0

    def _next(self) -> Any:
        scene = self._scene
        if scene.ngeom >= scene.maxgeom:
            return None
        scene.ngeom += 1
        return scene.geoms[scene.ngeom - 1]


def lengths(points: Matrix) -> Floats:
    """Length of the curve up to each of its points (n, k), (n,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def resampled(points: Matrix, spacing: float) -> Matrix:
    """Points (m, k) along the curve `spacing` apart, or a little less, with the same ends."""
    along = lengths(points)
    if along[-1] <= 0.0:
        return points[:1]
    places = np.linspace(0.0, along[-1], max(2, int(np.ceil(along[-1] / spacing)) + 1))
    return np.column_stack([np.interp(places, along, column) for column in points.T])


def segments(points: Matrix) -> Floats:
    """The pieces between neighbouring points (n, k): (n - 1, 2, k)."""
    return np.stack([points[:-1], points[1:]], axis=1)
