"""Scene on the map: workspace, obstacles, tree and goal; plans with their poses and footprints, and contingency."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize, to_rgb
from matplotlib.patches import Circle as Disc
from matplotlib.patches import Patch, Wedge
from matplotlib.patches import Polygon as Area
from matplotlib.path import Path as Outline
from matplotlib.ticker import FuncFormatter, MultipleLocator
from matplotlib.transforms import Affine2D

from kraft.plot.page import Frame
from kraft.plot.style import (
    CYCLE,
    CYCLE_PALE,
    DASHED,
    GOAL,
    GOAL_HALF,
    GOAL_PALE,
    GREY,
    INK,
    OUTSIDE,
    SMALL,
    SOLID,
    SOLID_EDGE,
    TINY,
    WARNING,
    WARNING_PALE,
    Dashes,
    Style,
    cost_colours,
    text_width,
)
from kraft.scenario import Bounds, Box, Circle, Goal, Obstacle, OccupancyMap, Polygon
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.interpolation import interpolated_rows
from ompl_ext.plan import TreeView
from ompl_ext.poses import poses_of
from ompl_ext.vehicle import Footprint, Vehicle

EDGES_MAX = 30_000  # more edges cannot be distinguished
EDGES_AS_LINES = 2_000  # more would make vector pictures too large: they become pixels
TICK_SPACING = 0.5  # at least, inches


@dataclass(frozen=True)
class PoseTrajectory:
    """Poses (m, 3), x, y in m and theta in rad, at increasing `times` (m,) in s."""

    times: Floats
    poses: Matrix

    @classmethod
    def of(cls, times: Floats, states: Matrix, vehicle: Vehicle) -> PoseTrajectory:
        """The poses of states (m, nx); a vehicle without theta never turns."""
        poses = poses_of(states, vehicle)
        poses[:, 2] = np.unwrap(poses[:, 2])
        return cls(times, poses)

    @property
    def end(self) -> float:
        """Time of the last pose, s."""
        return float(self.times[-1])

    def at(self, times: Floats) -> Matrix:
        """Poses (k, 3) at `times` (k,), s, by linear interpolation."""
        return interpolated_rows(times, self.times, self.poses)

    def between(self, begin: float, end: float) -> Matrix:
        """Poses from `begin` to `end`, s, including the interpolated poses at both."""
        inside = self.times[(self.times > begin) & (self.times < end)]
        return self.at(np.concatenate([[begin], inside, [end]]))

    @property
    def length(self) -> float:
        """Distance travelled, m."""
        return float(np.hypot(*np.diff(self.poses[:, :2], axis=0).T).sum())


def outlines(footprint: Footprint, poses: Matrix) -> Floats:
    """The footprint at each pose (k, 3): corners in the world, shape (k, 4, 2), m."""
    return _placed(footprint.corners(), poses)


def arrowheads(footprint: Footprint, poses: Matrix) -> Floats:
    """Mark at the front of each footprint that shows the heading: shape (k, 3, 2), m."""
    (_, front), half = footprint.ends, footprint.width / 2
    tip, back = front - 0.08 * footprint.length, front - 0.25 * footprint.length
    return _placed(np.array([[back, 0.5 * half], [tip, 0.0], [back, -0.5 * half]]), poses)


def _placed(points: Floats, poses: Matrix) -> Floats:
    """Points (n, 2) of the body frame in the world, at each pose (k, 3): shape (k, n, 2)."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    turn = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
    placed: Floats = np.einsum("kij,nj->kni", turn, points) + poses[:, None, :2]
    return placed


def draw_workspace(axes: Axes, frame: Frame, bounds: Bounds, scale: float) -> None:
    """The free floor, and ticks in the world's metres; `scale` is inches per m."""
    axes.set(xlim=frame.limits[0], ylim=frame.limits[1], aspect="equal", facecolor=OUTSIDE)
    (x0, x1), (y0, y1) = bounds.x, bounds.y
    corners = frame.points(np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]))
    axes.add_patch(Area(corners, facecolor="white", edgecolor=GREY, linewidth=0.6, zorder=0))
    for axis, size in zip((axes.xaxis, axes.yaxis), frame.size, strict=True):
        axis.set_major_locator(MultipleLocator(_round_step(min(TICK_SPACING / scale, size / 5))))
        axis.set_major_formatter(FuncFormatter(lambda value, _: _tick(value)))
    axes.set_xlabel("y, m (the map is turned by 90°: x points down)" if frame.turned else "x, m", labelpad=2)
    axes.set_ylabel("x, m" if frame.turned else "y, m", labelpad=2)
    if frame.turned:  # the page's vertical is -x
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _tick(-value)))


def _tick(value: float) -> str:
    return f"{round(value, 9) + 0.0:.12g}".replace("-", "\N{MINUS SIGN}")


def _round_step(least: float) -> float:
    """The smallest 1, 2 or 5 times a power of ten that is not below `least`."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= least * (1 - 1e-9))


def draw_obstacle(axes: Axes, frame: Frame, obstacle: Obstacle, number: int, scale: float) -> None:
    """One obstacle, with its name where there is room for it.

    One without a name, or whose name does not fit, has its `number` instead: the place in the scenario's list by which
    messages call those without a name.
    """
    if isinstance(obstacle, OccupancyMap):
        _draw_cells(axes, frame, obstacle)
        return
    # all outlines lie below all fillings, so that overlapping obstacles appear as one
    for shape_style in (
        {"edgecolor": SOLID_EDGE, "linewidth": 1.4, "zorder": 2.8},
        {"facecolor": SOLID, "zorder": 2.9},
    ):
        axes.add_patch(_shape(frame, obstacle, shape_style))
    center, _ = widest_place(obstacle)
    texts = [obstacle.name, str(number)] if obstacle.name else [str(number)]
    written = [(text, size, turn) for text in texts for size in (SMALL, TINY) for turn in (0.0, math.pi / 2)]
    fitting = next((each for each in written if _has_room(frame, obstacle, *each, scale)), None)
    if fitting is not None:
        text, size, turn = fitting
        style: Style = {"fontsize": size, "color": "#4a515c", "ha": "center", "va": "center", "zorder": 3.1}
        style["rotation"] = math.degrees(turn)
        axes.text(*_pair(frame.points(center)), text, parse_math=False, clip_on=True, **style)


def _has_room(
    frame: Frame, obstacle: Box | Circle | Polygon, text: str, size: float, turn: float, scale: float
) -> bool:
    """Whether a text of `size` pt is as wide as the obstacle's largest disc at most, or lies inside a box.

    The text is turned by `turn`, rad, on the page; `scale` is inches per m.
    """
    width, height = text_width(text, size) / 72 / scale, size / 72 / scale  # m
    if width < 0.9 * widest_place(obstacle)[1]:  # digits may touch the edges of a thin wall
        return True
    if not isinstance(obstacle, Box):
        return False
    angle = frame.heading(obstacle.yaw) - turn
    c, s = abs(math.cos(angle)), abs(math.sin(angle))
    length, breadth = obstacle.size
    return width * c + height * s < 0.9 * length and width * s + height * c < 0.9 * breadth


def _shape(frame: Frame, obstacle: Box | Circle | Polygon, shape_style: Mapping[str, Any]) -> Patch:
    if isinstance(obstacle, Circle):
        return Disc(_pair(frame.points(np.array(obstacle.center))), obstacle.radius, **shape_style)
    vertices = np.array(obstacle.corners if isinstance(obstacle, Box) else obstacle.vertices)
    return Area(frame.points(vertices), **shape_style)


def widest_place(obstacle: Box | Circle | Polygon) -> tuple[Floats, float]:
    """Middle of the largest disc inside the obstacle and its diameter, m; for a polygon, to a grid's accuracy."""
    if isinstance(obstacle, Circle):
        return np.array(obstacle.center), 2 * obstacle.radius
    if isinstance(obstacle, Box):
        return np.array(obstacle.center), min(obstacle.size)
    vertices = np.array(obstacle.vertices)
    grid = points_inside(obstacle, 30)
    if not len(grid):  # a sliver
        return vertices.mean(axis=0), 0.0
    along = np.roll(vertices, -1, axis=0) - vertices
    part = np.einsum("gvj,vj->gv", grid[:, None] - vertices, along) / (along**2).sum(axis=1)
    nearest = vertices + np.clip(part, 0.0, 1.0)[..., None] * along
    room = np.linalg.norm(grid[:, None] - nearest, axis=-1).min(axis=1)
    return grid[room.argmax()], 2 * float(room.max())


def points_inside(obstacle: Box | Circle | Polygon, count: int) -> Matrix:
    """Points (n, 2), m, of a grid of `count` x `count` over the obstacle's extent that are inside it."""
    if isinstance(obstacle, Circle):
        low, high = (np.array(obstacle.center) + sign * obstacle.radius for sign in (-1.0, 1.0))
    else:
        vertices = np.array(obstacle.corners if isinstance(obstacle, Box) else obstacle.vertices)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
    grid: Matrix = np.stack(np.meshgrid(*np.linspace(low, high, count + 2)[1:-1].T), axis=-1).reshape(-1, 2)
    if isinstance(obstacle, Circle):
        is_inside = np.hypot(*(grid - obstacle.center).T) < obstacle.radius
    else:
        is_inside = Outline(vertices).contains_points(grid)
    found: Matrix = grid[is_inside]
    return found


def _draw_cells(axes: Axes, frame: Frame, cells: OccupancyMap) -> None:
    """Draw the occupied cells as an image, without seams between them."""
    x, y, yaw = cells.origin
    rows, columns = cells.occupied.shape
    image = np.zeros((rows, columns, 4), np.uint8)
    image[..., :3] = np.round(255 * np.array(to_rgb("#a3a9b4")))
    image[..., 3] = 255 * cells.occupied
    placed = Affine2D().rotate(yaw).translate(x, y)
    if frame.turned:
        placed = placed.rotate_deg(-90)
    extent = (0.0, columns * cells.resolution, 0.0, rows * cells.resolution)
    drawn = axes.imshow(image, origin="lower", extent=extent, aspect="equal", zorder=2.9)
    drawn.set_transform(placed + axes.transData)
    axes.set(xlim=frame.limits[0], ylim=frame.limits[1])  # imshow moves them


def tree_lines(frame: Frame, tree: TreeView, vehicle: Vehicle) -> LineCollection | None:
    """Each edge as a straight line, coloured by the cost-to-come at its end; None if there are no edges."""
    nodes = np.flatnonzero(tree.parents >= 0)
    if not len(nodes):
        return None
    if len(nodes) > EDGES_MAX:
        nodes = nodes[np.linspace(0, len(nodes) - 1, EDGES_MAX).astype(np.int64)]
    nodes = nodes[np.argsort(-tree.costs[nodes], kind="stable")]  # what is reached sooner lies on top
    places = frame.points(tree.states[:, [vehicle.index("x"), vehicle.index("y")]])
    segments = np.stack([places[tree.parents[nodes]], places[nodes]], axis=1)
    scale = Normalize(0.0, float(tree.costs.max()) or 1.0)
    width = float(np.clip(26 / math.sqrt(len(nodes)), 0.3, 0.9))
    lines = LineCollection(list(segments), cmap=cost_colours(), norm=scale, linewidths=width, zorder=2)
    lines.set_array(tree.costs[nodes])
    lines.set_rasterized(len(nodes) > EDGES_AS_LINES)
    return lines


def draw_goal(axes: Axes, frame: Frame, goal: Goal) -> None:
    """Draw the goal region, with a wedge for the accepted headings if the goal has a heading."""
    center = _pair(frame.points(np.array(goal.center)))
    axes.add_patch(Disc(center, goal.radius, facecolor=GOAL_PALE, zorder=4))
    axes.add_patch(Disc(center, goal.radius, fill=False, edgecolor=GOAL, linewidth=1.6, zorder=7))
    if goal.heading is not None and goal.heading_tolerance is not None:
        middle, half = math.degrees(frame.heading(goal.heading)), math.degrees(goal.heading_tolerance)
        wedge = Wedge(center, goal.radius, middle - half, middle + half, facecolor=GOAL_HALF, zorder=4)
        axes.add_patch(wedge)
    axes.plot(*center, marker="+", color=GOAL, markersize=6, markeredgewidth=1.2, zorder=7)


def _pair(point: Floats) -> tuple[float, float]:
    return float(point[0]), float(point[1])


INTERVALS = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)  # between drawn footprints, s
FOOTPRINTS_MAX = 40
SWEPT = 64  # footprints of a swept area


def footprint_interval(motion: PoseTrajectory, vehicle: Vehicle) -> float:
    """Seconds between the footprints that are drawn, so that they do not cover each other."""
    duration = motion.end - float(motion.times[0])
    spacing = 1.1 * vehicle.footprint.length * duration / max(motion.length, 1e-9)
    least = max(duration / FOOTPRINTS_MAX, min(spacing, 1.0))
    return next((interval for interval in INTERVALS if interval >= least), least)


def path_width(vehicle: Vehicle, scale: float) -> float:
    """Width of the plan's line, pt, on a page of `scale` inches per m: thinner where the vehicle is small."""
    return float(np.clip(0.06 * 72 * scale * vehicle.footprint.width, 1.1, 1.8))


def draw_plan(axes: Axes, frame: Frame, vehicle: Vehicle, motion: PoseTrajectory, cycle: float, scale: float) -> None:
    """Draw path and footprints; those before the end of the cycle (s) are emphasised."""
    begin, cycle_end, width = float(motion.times[0]), min(cycle, motion.end), path_width(vehicle, scale)
    times = _footprint_times(motion, footprint_interval(motion, vehicle), cycle_end)
    before = times <= cycle_end
    _draw_swept(axes, frame, vehicle, motion.at(np.linspace(begin, cycle_end, SWEPT)), CYCLE_PALE, 4.3)
    for poses, colour in ((motion.at(times[~before]), INK), (motion.at(times[before]), CYCLE)):
        _draw_vehicle(axes, frame, vehicle, poses, colour, linewidths=0.8, facecolors=(1.0, 1.0, 1.0, 0.35))
    _draw_path(axes, frame, motion.between(cycle_end, motion.end), INK, width)
    _draw_path(axes, frame, motion.between(begin, cycle_end), CYCLE, 2 * width)


def _footprint_times(motion: PoseTrajectory, interval: float, cycle_end: float) -> Floats:
    """Regular times (s), the end of the cycle and the end of the plan; none of the first close to these two."""
    regular = np.arange(interval, motion.end, interval)
    fixed = np.unique([cycle_end, motion.end])
    far = (np.abs(regular[:, None] - fixed) > interval / 3).all(axis=1)
    return np.sort(np.concatenate([regular[far], fixed]))


def draw_start(axes: Axes, frame: Frame, vehicle: Vehicle, pose: Floats) -> None:
    """The vehicle at `pose` (3,), where it starts."""
    _draw_vehicle(axes, frame, vehicle, pose[None, :], "white", linewidths=1.2, facecolors=INK, zorder=6.0)


def draw_contingency(axes: Axes, frame: Frame, vehicle: Vehicle, contingency: PoseTrajectory, scale: float) -> None:
    """Draw the path until standstill, the swept area, and the final footprint."""
    last, width = contingency.poses[-1:], path_width(vehicle, scale)
    times = np.linspace(float(contingency.times[0]), contingency.end, SWEPT)
    _draw_swept(axes, frame, vehicle, contingency.at(times), WARNING_PALE, 4.2)
    _draw_vehicle(axes, frame, vehicle, last, WARNING, linestyles=[DASHED], linewidths=1.6, zorder=5.3)
    _draw_path(axes, frame, contingency.poses, WARNING, 1.4 * width, DASHED)
    ring: Style = {"markerfacecolor": "white", "markeredgecolor": WARNING, "markeredgewidth": 0.9 * width}
    where = frame.points(contingency.poses[0, :2])
    axes.plot(*where, marker="o", markersize=3.4 * width, zorder=6.7, **ring)


def _draw_swept(axes: Axes, frame: Frame, vehicle: Vehicle, poses: Matrix, colour: str, zorder: float) -> None:
    """Draw the swept area of the footprint, opaque, so that overlaps do not show."""
    shapes = list(frame.points(outlines(vehicle.footprint, poses)))
    style: Style = {"facecolors": colour, "edgecolors": colour, "linewidths": 0.5, "zorder": zorder}
    axes.add_collection(PolyCollection(shapes, **style))


def _draw_vehicle(
    axes: Axes, frame: Frame, vehicle: Vehicle, poses: Matrix, colour: str, *, linewidths: float, **style: Any
) -> None:
    """Draw footprints and, if the vehicle has a heading, marks that show it."""
    shapes = list(frame.points(outlines(vehicle.footprint, poses)))
    drawn: Style = {
        "facecolors": "none",
        "edgecolors": colour,
        "linewidths": linewidths,
        "zorder": 5.0,
        **style,
    }
    axes.add_collection(PolyCollection(shapes, **drawn))
    if vehicle.index("theta") >= 0:
        marks = list(frame.points(arrowheads(vehicle.footprint, poses)))
        axes.add_collection(LineCollection(marks, colors=colour, linewidths=linewidths, zorder=drawn["zorder"]))


def _draw_path(
    axes: Axes, frame: Frame, poses: Matrix, colour: str, width: float, dashes: Dashes | None = None
) -> None:
    path = frame.points(poses[:, :2])
    below: Style = {
        "color": "white",
        "linewidth": width + 1.6,
        "zorder": 6.2,
    }  # a casing, whole even under dashes
    above: Style = {"color": colour, "linewidth": width, "zorder": 6.3, "linestyle": dashes or "solid"}
    for style in (below, above):
        axes.plot(path[:, 0], path[:, 1], **style)
