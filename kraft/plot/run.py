"""Page about a run: the map with the driven and planned paths; speed, clearance and commands over time."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Final

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from kraft.driving.messages import Cycle, ReferenceKind, as_driven
from kraft.planning.workspace import workspace_of
from kraft.plot.labels import Label, draw_labels
from kraft.plot.page import (
    HELD,
    Curve,
    Frame,
    LegendEntry,
    Panel,
    draw_legend,
    draw_panel,
    draw_title,
    lay_out,
    quantity,
)
from kraft.plot.scene import (
    PoseTrajectory,
    arrowheads,
    draw_goal,
    draw_obstacle,
    draw_start,
    draw_workspace,
    outlines,
    points_inside,
    widest_place,
)
from kraft.plot.style import (
    CYCLE,
    DASHED,
    GOAL,
    INK,
    RULE,
    WARNING,
    WARNING_PALE,
    Style,
    picture_format,
    plot_style,
    write_picture,
)
from kraft.scenario import OccupancyMap, Start, Task
from kraft.simulation.appearance import HiddenFeature
from kraft.trial.result import Outcome, TrialResult, outcome_text
from kraft.vehicles import control_title
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.exact import ExactClearance
from ompl_ext.times import SAME_TIME
from ompl_ext.vehicle import Vehicle


def plot_run(
    path: Path,
    task: Task,
    vehicle: Vehicle,
    result: TrialResult,
    *,
    title: str | None = None,
    unknown: Sequence[str] = (),
    hidden: Sequence[HiddenFeature] = (),
    has_plans: bool = True,
) -> None:
    """Draw a drive as PNG, SVG or PDF by the suffix of `path`.

    `unknown` lists what the planner did not know, and `hidden` are the features of it that can be drawn.  Without
    `has_plans` the references are paths of least cost to the goal, which nothing tracks: they are not drawn.  The same
    arguments give the same bytes.  The file is written in one step or not at all.

    Raises:
        InputError: if the suffix is none of these or the file cannot be written.
    """
    picture_format(path)  # before the work, not after it
    drive = DrivenTrajectory.of(replace(result, cycles=as_driven(result.begun)), task.start, has_plans=has_plans)
    notes = key_numbers(result, vehicle, unknown)
    with plot_style():
        write_picture(path, _compose(drive, task, vehicle, title or f"{task.name} · {result.method}", notes, hidden))


def key_numbers(result: TrialResult, vehicle: Vehicle, unknown: Sequence[str] = ()) -> Mapping[str, str]:
    """Key figures above the map, by name; the vehicle is the model that was planned with."""
    planning = [cycle.planning_ms for cycle in result.cycles]  # measured: left out, so that the picture repeats
    clear = f"{result.min_clearance:.3f} m" if math.isfinite(result.min_clearance) else "–"
    return MappingProxyType({
        "time": f"{result.time:.2f} s",
        "smallest clearance": clear,
        "cycles": str(len(planning)),
        "contingencies": str(result.contingencies),
        "vehicle": vehicle.name,
        "seed": str(result.seed),
        **({"not known to the planner": ", ".join(unknown)} if unknown else {}),
    })  # fmt: skip


def _compose(
    drive: DrivenTrajectory,
    task: Task,
    vehicle: Vehicle,
    title: str,
    notes: Mapping[str, str],
    hidden: Sequence[HiddenFeature],
) -> Figure:
    frame = Frame.around(task.bounds)
    line = driven_line(frame, drive, max(vehicle.top_speed, 1e-3))
    entries, panels = _legend_entries(drive, line, hidden), panels_of_run(drive, task, vehicle)
    page = lay_out(frame, notes, len(panels), [entry.width for entry in entries])
    figure = Figure(figsize=(page.width, page.height))
    result = drive.result
    colour = GOAL if result.outcome is Outcome.SUCCESS else WARNING
    page.heading(figure, title, outcome_text(result.outcome, result.obstacle), colour)
    _draw_map(page.axes(figure, page.map), drive, frame, task, vehicle, line, hidden, page.map.width / frame.size[0])
    draw_legend(figure, page, entries)
    for panel, part in zip(panels, page.panels, strict=True):
        draw_run_panel(page.axes(figure, part), panel, drive, last=panel is panels[-1])
    return figure


def _draw_map(
    axes: Axes,
    drive: DrivenTrajectory,
    frame: Frame,
    task: Task,
    vehicle: Vehicle,
    line: LineCollection,
    hidden: Sequence[HiddenFeature],
    scale: float,
) -> None:
    draw_workspace(axes, frame, task.bounds, scale)
    draw_hidden_features(axes, frame, hidden)
    for number, obstacle in enumerate(task.obstacles):
        draw_obstacle(axes, frame, obstacle, number, scale)
    draw_goal(axes, frame, task.goal)
    draw_observations(axes, frame, drive.result)
    draw_footprints(axes, frame, vehicle, drive, run_footprint_interval(drive))
    draw_references(axes, frame, vehicle, drive)
    axes.add_collection(line, autolim=False)
    start = np.array([task.start.x, task.start.y, task.start.heading])
    draw_start(axes, frame, vehicle, start)
    draw_labels(axes, frame, _labels(drive, task, vehicle), _avoided_points(drive, task), scale)


def _labels(drive: DrivenTrajectory, task: Task, vehicle: Vehicle) -> list[Label]:
    half = vehicle.footprint.width / 2
    labels = [
        Label("start", (task.start.x, task.start.y), INK, half),
        Label("goal", task.goal.center, GOAL, task.goal.radius),
    ]
    if drive.result.outcome is Outcome.COLLISION:
        x, y, _ = map(float, drive.motion.poses[-1])
        labels.append(Label(f"collision with\n{drive.result.obstacle}", (x, y), COLLISION, half))
    return labels


HIT_GRID: Final = 10
"""Points along each axis of the obstacle that was hit, which labels should not cover."""
LABELLED: Final = 20.0
"""Weight of the place of an obstacle's own label."""


def _avoided_points(drive: DrivenTrajectory, task: Task) -> Matrix:
    """Points (n, 3) that labels should not cover: x, y in m and a weight."""
    weighted = [(drive.motion.poses[:, :2], 1.0)]
    for obstacle, label in zip(task.obstacles, task.obstacle_labels, strict=True):
        if isinstance(obstacle, OccupancyMap):
            continue
        weighted.append((widest_place(obstacle)[0][None, :], LABELLED))
        if label == drive.result.obstacle:
            weighted.append((points_inside(obstacle, HIT_GRID), 1.0))
    return np.vstack([np.column_stack([points, np.full(len(points), weight)]) for points, weight in weighted])


def _legend_entries(
    drive: DrivenTrajectory, line: LineCollection, hidden: Sequence[HiddenFeature]
) -> list[LegendEntry]:
    entries = [LegendEntry("planned in each cycle; planned speed", "line", CYCLE, 1.2)] if drive.has_plans else []
    if any(cycle.kind is ReferenceKind.CONTINGENCY for cycle in drive.result.cycles):
        entries += [
            LegendEntry("contingency", "dashes", WARNING, 1.6),
            LegendEntry("a cycle with a contingency begins", "ring", WARNING, RING),
            LegendEntry("time of contingencies", "outline", WARNING_PALE, face=WARNING_PALE),
        ]
    entries += [
        LegendEntry("estimated speed", "line", ESTIMATED, ESTIMATED_WIDTH),
        LegendEntry("true values", "line", INK, 1.6),
        LegendEntry("camera", "dots", OBSERVATION, 2 * OBSERVATION_SIZE),
        *([LegendEntry("a cycle begins", "line", RULE, 0.5)] if _shows_cycles(drive.result) else []),
        LegendEntry(f"vehicle every {run_footprint_interval(drive):g} s", "outline", INK),
        *(
            LegendEntry(f"{NAMES[kind]}, not known", "outline", HIDDEN[kind][1], face=HIDDEN[kind][0])
            for kind in dict.fromkeys(thing.kind for thing in hidden)
        ),
        LegendEntry("driven, m/s", "scale", scale=line),
    ]
    return entries


CYCLES_MAX: Final = 80
"""Number of cycles up to which the curves show where each of them begins."""
ESTIMATED: Final = "#a3178f"
ESTIMATED_WIDTH: Final = 2.6  # pt; wider than the planned speed on it, because some methods estimate just that
OBSERVATION: Final = "#7d8896"
OBSERVATION_SIZE: Final = 2.4  # pt
COLLISION: Final = "#c1121f"
HIDDEN: Final = {"patch": ("#d6eef8", "#7cb9d6"), "bump": ("#fbe7b4", "#c79a1e"), "box": ("#ecd5b5", "#a87a44")}
"""Face and edge colours of hidden features."""
RING: Final = 4.5  # pt
NAMES: Final = {"patch": "other friction", "bump": "bump", "box": "box"}


@dataclass(frozen=True)
class DrivenTrajectory:
    """True poses and speeds (n,) of a result at the ticks of the controller; at least those at the start.

    `has_plans` is whether the controller tracks the references of cycles without a contingency.
    """

    result: TrialResult
    motion: PoseTrajectory
    speeds: Floats
    has_plans: bool = True

    @classmethod
    def of(cls, result: TrialResult, start: Start, *, has_plans: bool = True) -> DrivenTrajectory:
        """Take the ticks of a result, and the start of a trial that ended there and has none."""
        if not result.steps:
            pose = np.array([[start.x, start.y, start.heading]])
            return cls(result, PoseTrajectory(np.zeros(1), pose), np.array([start.speed]), has_plans)
        times = np.array([step.time for step in result.steps])
        poses = np.array([step.pose for step in result.steps])
        poses[:, 2] = np.unwrap(poses[:, 2])
        return cls(result, PoseTrajectory(times, poses), np.array([step.speed for step in result.steps]), has_plans)


def panels_of_run(drive: DrivenTrajectory, task: Task, vehicle: Vehicle) -> list[Panel]:
    """Panels of speed (true, estimated, planned), true clearance, and the commands; none without a command."""
    steps, times = drive.result.steps, drive.motion.times
    if not steps:
        return []
    true: Style = {"color": INK, "linewidth": 1.3, "zorder": 3}
    speeds = [Curve(times, drive.speeds, true)]
    if vehicle.rest:
        index = vehicle.rest_indices[0]
        planned = np.array([_planned(drive.result, step.time, index) for step in steps])
        estimated = np.array([step.estimate[index] for step in steps])
        thin = {**true, "linewidth": 0.9}
        below = [Curve(times, estimated, {**thin, "color": ESTIMATED, "linewidth": ESTIMATED_WIDTH})]
        if drive.has_plans:
            below.append(Curve(times, planned, {**thin, "color": CYCLE}))
        speeds = [*below, *speeds]
    everything = np.concatenate([curve.values for curve in speeds])
    top = max(vehicle.top_speed, float(np.nanmax(everything)))
    exact = ExactClearance(workspace_of(task, vehicle), vehicle.footprint)
    clearance = np.maximum(exact.distances(drive.motion.poses), 0.0)
    panels = [
        Panel(quantity("speed, m/s"), tuple(speeds), (min(0.0, float(np.nanmin(everything))), top)),
        Panel(quantity("clearance, m"), (Curve(times, clearance, true),), (0.0, max(0.1, float(clearance.max())))),
    ]
    commands = np.array([step.command for step in steps])
    for name, values, (low, high) in zip(vehicle.controls, commands.T, vehicle.control_bounds, strict=True):
        title = control_title(vehicle, name)
        limits = min(0.0, float(low), float(values.min())), max(0.0, float(high), float(values.max()))
        panels.append(Panel(quantity(title), (Curve(times, values, {**true, **HELD}),), limits))
    return panels


def _planned(result: TrialResult, time: float, index: int) -> float:
    """State component of the active reference at a time; NaN after its end."""
    cycle = _active_cycle(result.cycles, time)
    if cycle is None or time > cycle.reference.end:
        return float("nan")
    return float(cycle.reference.state_at(time)[index])


def _active_cycle(cycles: tuple[Cycle, ...], time: float) -> Cycle | None:
    begun = [cycle for cycle in cycles if cycle.time <= time + SAME_TIME]
    return begun[-1] if begun else None


def draw_run_panel(axes: Axes, panel: Panel, drive: DrivenTrajectory, *, last: bool) -> None:
    """Draw one panel over the time of the trial; contingencies are shaded, lines mark the start of each cycle."""
    axes.yaxis.set_major_locator(MaxNLocator(3, steps=[1, 2, 4, 5, 10]))
    _draw_cycles(axes, drive.result)
    draw_panel(axes, panel, (0.0, max(drive.result.time, 1e-3)), last=last)
    draw_title(axes, panel.title)
    if last:
        axes.set_xlabel("time, s", labelpad=2)


def _with_ends(result: TrialResult) -> Iterator[tuple[Cycle, float]]:
    """Each cycle, with the time (s) at which the next one begins or the trial ends."""
    ends = (*(cycle.time for cycle in result.cycles[1:]), result.time)
    return zip(result.cycles, ends, strict=False)  # a trial that ends at its start has no cycle


def _shows_cycles(result: TrialResult) -> bool:
    """Whether so few cycles begin that their lines do not merge."""
    return len(result.cycles) <= CYCLES_MAX


def _draw_cycles(axes: Axes, result: TrialResult) -> None:
    shown = _shows_cycles(result)
    for cycle, end in _with_ends(result):
        if cycle.kind is ReferenceKind.CONTINGENCY:
            axes.axvspan(cycle.time, end, color=WARNING_PALE, linewidth=0, zorder=0)
        if shown:
            axes.axvline(cycle.time, color=RULE, linewidth=0.5, zorder=0.5)


def draw_hidden_features(axes: Axes, frame: Frame, things: Sequence[HiddenFeature]) -> None:
    """Draw patches and bumps on the floor, and boxes above them."""
    for thing in things:
        face, edge = HIDDEN[thing.kind]
        order = {"patch": 1.2, "bump": 1.4, "box": 3.2}[thing.kind]
        style: Style = {"facecolors": face, "edgecolors": edge, "linewidths": 0.8, "zorder": order}
        axes.add_collection(PolyCollection([frame.points(thing.corners)], **style))


def draw_observations(axes: Axes, frame: Frame, result: TrialResult) -> None:
    """Draw the positions measured by the camera."""
    if result.observations:
        places = frame.points(np.array([(seen.x, seen.y) for seen in result.observations]))
        axes.plot(*places.T, ".", color=OBSERVATION, markersize=OBSERVATION_SIZE, markeredgewidth=0, zorder=3.4)


def draw_references(axes: Axes, frame: Frame, vehicle: Vehicle, drive: DrivenTrajectory) -> None:
    """Draw the part of each committed reference within its cycle, with a ring at each contingency.

    Contingencies lie on the driven path, which would hide what the vehicle drives as it was planned.
    """
    for cycle, end in _with_ends(drive.result):
        reference = cycle.reference
        motion = PoseTrajectory.of(reference.times, reference.states, vehicle)
        begin = max(cycle.time, reference.start)
        planned = cycle.kind is ReferenceKind.PLAN
        if planned and not drive.has_plans:
            continue
        colour, order = (CYCLE, 5.4) if planned else (WARNING, 6.4)
        if min(end, reference.end) > begin:
            path = frame.points(motion.between(begin, min(end, reference.end))[:, :2])
            axes.plot(*path.T, color=colour, linewidth=0.9, linestyle="solid" if planned else DASHED, zorder=order)
            axes.plot(*path[0], marker="|", color=colour, markersize=3, zorder=order)
        if not planned:
            ring: Style = {"markerfacecolor": "white", "markeredgecolor": WARNING, "markeredgewidth": 1.2}
            axes.plot(
                *frame.points(motion.at(np.array([begin]))[0, :2]), marker="o", markersize=RING, zorder=6.6, **ring
            )


def driven_line(frame: Frame, drive: DrivenTrajectory, top_speed: float) -> LineCollection:
    """True path, coloured by speed."""
    places = frame.points(drive.motion.poses[:, :2])
    pieces = np.stack([places[:-1], places[1:]], axis=1)
    lines = LineCollection(
        list(pieces), cmap=_speed_colours(), norm=Normalize(0.0, top_speed), linewidths=2.6, zorder=6
    )
    lines.set_array(np.abs(drive.speeds[:-1] + drive.speeds[1:]) / 2)
    lines.set_capstyle("round")
    return lines


def draw_footprints(axes: Axes, frame: Frame, vehicle: Vehicle, drive: DrivenTrajectory, interval: float) -> None:
    """Draw the car at regular times (s) and at the end of the trial, red after a collision."""
    times = np.arange(interval, drive.motion.end - interval / 3, interval)
    crashed = drive.result.outcome is Outcome.COLLISION
    ends = np.array([drive.motion.end])
    for when, colour, width in ((times, INK, 0.6), (ends, COLLISION if crashed else INK, 1.4)):
        poses = drive.motion.at(when)
        shapes = list(frame.points(outlines(vehicle.footprint, poses)))
        style: Style = {"edgecolors": colour, "linewidths": width, "zorder": 5.0}
        axes.add_collection(PolyCollection(shapes, facecolors=(1.0, 1.0, 1.0, 0.25), **style))
        heads = list(frame.points(arrowheads(vehicle.footprint, poses)))
        axes.add_collection(LineCollection(heads, colors=colour, linewidths=width, zorder=5.0))


def run_footprint_interval(drive: DrivenTrajectory) -> float:
    """Seconds between footprints: one, or more in a long trial."""
    return float(max(1, math.ceil(drive.motion.end / 30)))


def _speed_colours() -> ListedColormap:
    """Viridis without its brightest part, which is hard to see on white."""
    return ListedColormap(matplotlib.colormaps["viridis"](np.linspace(0.0, 0.9, 256)), name="speed")
