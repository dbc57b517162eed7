"""Plan on the map: path, first cycle, footprints and contingency."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection

from kraft.plot.frame import Frame, PoseTrajectory, arrowheads, outlines
from kraft.plot.style import CYCLE, CYCLE_PALE, DASHED, INK, WARNING, WARNING_PALE, Dashes, Style
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.vehicle import Vehicle

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
