"""Drawings of a snapshot on the floor of MuJoCo's scene: tree, plan, predicted motion, contingency, trail, estimate.

A snapshot has truth, estimate and cycle of a trial at one time.  Colours are the same as in the plots for the same
meaning.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import matplotlib
import mujoco
import numpy as np
from matplotlib.colors import to_rgb

from kraft.driving.messages import Cycle, Reference, ReferenceKind, as_driven
from kraft.planning.workspace import workspace_of
from kraft.plot.scene import outlines
from kraft.plot.style import CYCLE, GOAL, WARNING
from kraft.simulation.floor_frame import Surface
from kraft.simulation.true_world import TrueWorld
from kraft.trial.measures import Step
from kraft.trial.result import TrialSpec
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.exact import ExactClearance
from ompl_ext.interpolation import interpolated_rows
from ompl_ext.plan import TreeView
from ompl_ext.poses import poses_of
from ompl_ext.times import SAME_TIME
from ompl_ext.vehicle import Vehicle

TRAIL_SPACING = 0.04
"""Distance between the points of the trail, m."""


@dataclass(frozen=True)
class Snapshot:
    """State of a trial at one time: truth, estimate and current cycle, where the last two are known.

    Poses are x, y (m) and heading (rad).  `trail` (n, 3) are x, y and speed (m/s) of where the car has been;
    `clearance` is the true distance of its footprint to the nearest obstacle, m; `configuration` (nq,) that of MuJoCo's
    model, `contact` the first point of contact with an obstacle in the floor's frame, m.
    """

    time: float
    pose: Floats
    speed: float
    estimate: Floats | None
    clearance: float
    cycle: Cycle | None
    trail: Matrix
    configuration: Floats
    contact: tuple[float, float, float] | None


class SnapshotRecorder:
    """Makes snapshots from the callbacks of `run_trial`, or of a simulated robot that another program drives."""

    def __init__(self, spec: TrialSpec, *, external: bool = False) -> None:
        """With `external` another program drives, whose plans and estimates are not known."""
        self._vehicle = spec.vehicle
        self._exact = ExactClearance(workspace_of(spec.scenario.task(), spec.vehicle), spec.vehicle.footprint)
        self._cycles: list[Cycle] = []
        self._committed: list[Cycle] = []
        self._cycle: Cycle | None = None
        self._trail: list[tuple[float, float, float]] = []
        start = spec.scenario.start
        self._external = external
        self._estimate: Floats | None = None if external else np.array([start.x, start.y, start.heading])

    def on_cycle(self, cycle: Cycle) -> None:
        """Record a cycle; snapshots contain it from its start on."""
        self._cycles.append(cycle)
        self._committed.append(as_driven(self._cycles)[-1])

    def on_step(self, world: TrueWorld, step: Step) -> Snapshot:
        """Record a tick of the controller and return the snapshot at it."""
        if not self._external:
            self._estimate = poses_of(step.estimate[None, :], self._vehicle)[0]
        return self.now(world)

    def now(self, world: TrueWorld) -> Snapshot:
        """Snapshot of the world as it is; the estimate is that of the last tick, or the start."""
        while self._committed and self._committed[0].time <= world.time + SAME_TIME:
            self._cycle = self._committed.pop(0)
        x, y, theta = map(float, world.pose)
        here = (x, y, world.speed)
        if not self._trail or np.hypot(x - self._trail[-1][0], y - self._trail[-1][1]) >= TRAIL_SPACING:
            self._trail.append(here)
        return Snapshot(
            time=world.time,
            pose=np.array([x, y, theta]),
            speed=world.speed,
            estimate=self._estimate,
            clearance=self._exact.distance(x, y, theta),
            cycle=self._cycle,
            trail=np.array([*self._trail, here]),
            configuration=world.data.qpos.copy(),
            contact=world.collision.point if world.collision is not None else None,
        )


Colour: TypeAlias = tuple[float, float, float, float]
"""Red, green, blue and opacity, 0 to 1."""


def colour(name: str, opacity: float = 1.0) -> Colour:
    """A colour by its code, #rrggbb."""
    red, green, blue = to_rgb(name)
    return red, green, blue, opacity


PLAN: Final = CYCLE
PREDICTED: Final = "#a9d3ee"
CONTINGENCY: Final = WARNING
CONTINGENCY_PALE: Final = "#f6cba8"
TREE: Final = "#44546c"
ESTIMATE: Final = "#a3178f"
SUCCESS: Final = GOAL
FAILURE: Final = "#c1121f"

BACKGROUND: Final = "#14171c"
TEXT: Final = "#ffffff"
SECONDARY_TEXT: Final = "#b9c2cf"


def speed_colours(speeds: Floats, top: float) -> Matrix:
    """Colours (n, 4) of speeds (n,): from standstill to `top` m/s, backwards like forwards."""
    scale = matplotlib.colormaps["viridis"]
    coloured: Matrix = scale(0.85 * np.clip(np.abs(speeds) / top, 0.0, 1.0))
    return coloured


EDGES_MAX: Final = 1500
"""Number of edges above which only a part of the tree is drawn."""
TREE_HEIGHT, PREDICTED_HEIGHT, TRAIL_HEIGHT = 0.001, 0.0025, 0.006
PLAN_HEIGHT, CONTINGENCY_HEIGHT, ESTIMATE_HEIGHT = 0.009, 0.012, 0.014
"""Height above the ground, m: what is higher covers what is lower."""
SPACING: Final = 0.05
"""Length of the straight pieces of a stroke, m: short enough for curves and bumps."""
DASH: Final = 0.045
"""Length of a dash, m."""
THICKNESS: Final = 0.002
"""Height of a stroke, m."""
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

    def dashes(self, path: Matrix, width: float, rise: float, colour: Colour) -> None:
        """A band in dashes with gaps a little shorter."""
        if len(path) > 1:
            places = self._surface.raised(resampled(path, DASH / 3), rise)
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
        """A thin box for each piece (n, 2, 3) of the floor's frame; each is longer than that, to close bends."""
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
        longer = np.maximum(0.03, bend_gaps(pieces, forward)) * wide
        for k in range(len(pieces)):
            half = np.array([length[k] / 2 + longer[k], wide / 2, THICKNESS / 2])
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


SHARPEST: Final = 1.2
"""Bend up to which a gap is closed, rad: in a sharper one the vehicle reverses, and the pieces lie on each other."""


def bend_gaps(pieces: Floats, forward: Matrix) -> Floats:
    """By how much each piece (n, 2, 3) with its direction (n, 3) has to be longer at both ends, (n,), in widths.

    Where two pieces meet in a bend, their outer corners leave a wedge open, as long as the tangent of half the bend.
    """
    found = np.zeros(len(pieces))
    if len(pieces) > 1:
        meet = np.linalg.norm(pieces[1:, 0, :2] - pieces[:-1, 1, :2], axis=1) < 1e-9
        bend = np.arccos(np.clip((forward[1:] * forward[:-1]).sum(axis=1), -1.0, 1.0))
        gap = np.where(meet & (bend < SHARPEST), np.tan(bend / 2) / 2, 0.0)
        found[:-1], found[1:] = gap, np.maximum(found[1:], gap)
        found[1:-1] = np.maximum(gap[:-1], gap[1:])
    return found


def lengths(points: Matrix) -> Floats:
    """Length of the curve up to each of its points (n, k), (n,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def resampled(points: Matrix, spacing: float) -> Matrix:
    """Points (m, k) along the curve `spacing` apart, or a little less, with the same ends."""
    along = lengths(points)
    if along[-1] <= 0.0:
        return points[:1]
    places = np.linspace(0.0, along[-1], max(2, int(np.ceil(along[-1] / spacing)) + 1))
    return interpolated_rows(places, along, points)


def segments(points: Matrix) -> Floats:
    """The pieces between neighbouring points (n, k): (n - 1, 2, k)."""
    return np.stack([points[:-1], points[1:]], axis=1)


def draw_cycle(pen: Pen, cycle: Cycle, vehicle: Vehicle) -> None:
    """Draw everything that does not change during a cycle."""
    if cycle.tree is not None:
        _draw_tree(pen, cycle.tree, vehicle)
    planned = cycle.kind is ReferenceKind.PLAN
    predicted = poses_of(cycle.predicted.states, vehicle)[:, :2]
    pale = PREDICTED if planned else CONTINGENCY_PALE
    pen.stroke(predicted, vehicle.footprint.width, PREDICTED_HEIGHT, colour(pale))
    if planned:
        pen.stroke(_path(cycle.reference, vehicle), 0.03, PLAN_HEIGHT, colour(PLAN))
    if cycle.contingency is not None:
        _draw_contingency(pen, cycle.contingency, vehicle)


def _draw_tree(pen: Pen, tree: TreeView, vehicle: Vehicle) -> None:
    nodes = np.flatnonzero(tree.parents >= 0)
    if len(nodes) > EDGES_MAX:
        nodes = nodes[np.linspace(0, len(nodes) - 1, EDGES_MAX).astype(np.int64)]
    places = poses_of(tree.states, vehicle)[:, :2]
    edges = np.stack([places[tree.parents[nodes]], places[nodes]], axis=1)
    pen.lines(edges, TREE_HEIGHT, colour(TREE, 0.35), 1.0)


def _draw_contingency(pen: Pen, safe: Reference, vehicle: Vehicle) -> None:
    """Draw the path and the final footprint of a contingency."""
    pen.dashes(_path(safe, vehicle), 0.03, CONTINGENCY_HEIGHT, colour(CONTINGENCY))
    corners = outlines(vehicle.footprint, poses_of(safe.states[-1:], vehicle))[0]
    pen.outline(corners, 0.014, CONTINGENCY_HEIGHT, colour(CONTINGENCY))


def _path(reference: Reference, vehicle: Vehicle) -> Matrix:
    return poses_of(reference.states, vehicle)[:, :2]


def draw_collision(pen: Pen, point: tuple[float, float, float]) -> None:
    """Draw the first point of contact with an obstacle, in the floor's frame, m."""
    pen.sphere(np.array(point), 0.035, colour(FAILURE))


def draw_snapshot(pen: Pen, snapshot: Snapshot, vehicle: Vehicle) -> None:
    """Draw the trail, coloured by speed, and the footprint at the estimated pose, where that is known."""
    speeds = (snapshot.trail[1:, 2] + snapshot.trail[:-1, 2]) / 2
    pen.shaded(snapshot.trail[:, :2], 0.022, TRAIL_HEIGHT, speed_colours(speeds, vehicle.top_speed))
    if snapshot.estimate is not None:
        estimated = outlines(vehicle.footprint, snapshot.estimate[None, :])[0]
        pen.outline(estimated, 0.01, ESTIMATE_HEIGHT, colour(ESTIMATE))
