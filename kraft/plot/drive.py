"""A drive on the map: where the car was and how fast, what each cycle had planned, and what the camera saw."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import ListedColormap, Normalize

from kraft.driving.messages import Kind
from kraft.plot.frame import Frame, Motion, arrowheads, outlines
from kraft.plot.style import CYCLE, DASHED, INK, WARNING, Look
from kraft.simulation.hidden import Hidden
from kraft.trial.result import Outcome, TrialResult
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle

SEEN: Final = "#7d8896"
SEEN_SIZE: Final = 2.4  # pt
CRASH: Final = "#c1121f"
HIDDEN: Final = {"patch": ("#d6eef8", "#7cb9d6"), "bump": ("#fbe7b4", "#c79a1e"), "box": ("#ecd5b5", "#a87a44")}
"""Face and edge of what the planner did not know."""


@dataclass(frozen=True)
class Drive:
    """A result as a motion: true poses and speeds (n,) at the ticks of the controller."""

    result: TrialResult
    motion: Motion
    speeds: Floats

    @classmethod
    def of(cls, result: TrialResult) -> Drive:
        """Take the ticks of a result, of which there is at least one."""
        times = np.array([step.time for step in result.steps])
        poses = np.array([step.pose for step in result.steps])
        poses[:, 2] = np.unwrap(poses[:, 2])
        return cls(result, Motion(times, poses), np.array([step.speed for step in result.steps]))


def draw_hidden(axes: Axes, frame: Frame, things: Sequence[Hidden]) -> None:
    """Patches and bumps on the floor, boxes on them."""
    for thing in things:
        face, edge = HIDDEN[thing.kind]
        order = {"patch": 1.2, "bump": 1.4, "box": 3.2}[thing.kind]
        look: Look = {"facecolors": face, "edgecolors": edge, "linewidths": 0.8, "zorder": order}
        axes.add_collection(PolyCollection([frame.points(thing.corners)], **look))


def draw_seen(axes: Axes, frame: Frame, result: TrialResult) -> None:
    """Positions as the camera measured them."""
    if result.observations:
        places = frame.points(np.array([(seen.x, seen.y) for seen in result.observations]))
        axes.plot(*places.T, ".", color=SEEN, markersize=SEEN_SIZE, markeredgewidth=0, zorder=3.4)


def draw_intentions(axes: Axes, frame: Frame, vehicle: Vehicle, result: TrialResult) -> None:
    """What each cycle committed for its own duration, and a mark where that was a contingency."""
    ends = [*(cycle.time for cycle in result.cycles[1:]), result.time]
    for cycle, end in zip(result.cycles, ends, strict=True):
        reference = cycle.reference
        motion = Motion.of(reference.times, reference.states, vehicle)
        begin = max(cycle.time, reference.start)
        planned = cycle.kind == Kind.PLAN
        colour = CYCLE if planned else WARNING
        if min(end, reference.end) > begin:
            path = frame.points(motion.between(begin, min(end, reference.end))[:, :2])
            axes.plot(*path.T, color=colour, linewidth=0.9, linestyle="solid" if planned else DASHED, zorder=5.4)
            axes.plot(*path[0], marker="|", color=colour, markersize=3, zorder=5.4)
        if not planned:
            ring: Look = {"markerfacecolor": "white", "markeredgecolor": WARNING, "markeredgewidth": 1.2}
            axes.plot(
                *frame.points(motion.at(np.array([begin]))[0, :2]), marker="o", markersize=4.5, zorder=6.6, **ring
            )


def driven_line(frame: Frame, drive: Drive, top_speed: float) -> LineCollection:
    """The true path in colours of the speed."""
    places = frame.points(drive.motion.poses[:, :2])
    pieces = np.stack([places[:-1], places[1:]], axis=1)
    lines = LineCollection(
        list(pieces), cmap=_speed_colours(), norm=Normalize(0.0, top_speed), linewidths=2.6, zorder=6
    )
    lines.set_array(np.abs(drive.speeds[:-1] + drive.speeds[1:]) / 2)
    lines.set_capstyle("round")
    return lines


def draw_footprints(axes: Axes, frame: Frame, vehicle: Vehicle, drive: Drive, interval: float) -> None:
    """The car at regular times, s, and where it was when the trial ended: red if it had hit something."""
    times = np.arange(interval, drive.motion.end - interval / 3, interval)
    crashed = drive.result.outcome is Outcome.COLLISION
    ends = np.array([drive.motion.end])
    for when, colour, width in ((times, INK, 0.6), (ends, CRASH if crashed else INK, 1.4)):
        poses = drive.motion.at(when)
        shapes = list(frame.points(outlines(vehicle.footprint, poses)))
        look: Look = {"edgecolors": colour, "linewidths": width, "zorder": 5.0}
        axes.add_collection(PolyCollection(shapes, facecolors=(1.0, 1.0, 1.0, 0.25), **look))
        heads = list(frame.points(arrowheads(vehicle.footprint, poses)))
        axes.add_collection(LineCollection(heads, colors=colour, linewidths=width, zorder=5.0))


def footprint_times(drive: Drive) -> float:
    """Seconds between footprints: one, or more where so many would hide each other."""
    return float(max(1, math.ceil(drive.motion.end / 30)))


def _speed_colours() -> ListedColormap:
    """Viridis without its brightest part, which white paper swallows."""
    return ListedColormap(matplotlib.colormaps["viridis"](np.linspace(0.0, 0.9, 256)), name="speed")
