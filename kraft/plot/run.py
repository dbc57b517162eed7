"""Page about a run: the map with the driven and planned paths; speed, clearance and commands over time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from kraft.driving.messages import ReferenceKind, as_driven
from kraft.plot.frame import Frame
from kraft.plot.labels import Label, draw_labels
from kraft.plot.page import LegendEntry, draw_legend, lay_out
from kraft.plot.scene import draw_goal, draw_obstacle, draw_start, draw_workspace
from kraft.plot.style import CYCLE, GOAL, INK, WARNING, picture_format, plot_style, write_picture
from kraft.plot.traces import (
    COLLISION,
    ESTIMATED,
    HIDDEN,
    OBSERVATION,
    OBSERVATION_SIZE,
    DrivenTrajectory,
    draw_footprints,
    draw_hidden_features,
    draw_observations,
    draw_references,
    draw_run_panel,
    driven_line,
    panels_of_run,
    run_footprint_interval,
)
from kraft.scenario import Task
from kraft.simulation.appearance import HiddenFeature
from kraft.trial.result import Outcome, TrialResult, outcome_text
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
) -> None:
    """Draw a drive as PNG, SVG or PDF by the suffix of `path`.

    `unknown` lists what the planner did not know, and `hidden` are the features of it that can be drawn.  The same
    arguments give the same bytes.  The file is written in one step or not at all.

    Raises:
        InputError: if the suffix is none of these or the file cannot be written.
    """
    picture_format(path)  # before the work, not after it
    drive = DrivenTrajectory.of(replace(result, cycles=as_driven(result.cycles)))
    notes = key_numbers(result, unknown)
    with plot_style():
        write_picture(path, _compose(drive, task, vehicle, title or f"{task.name} · {result.method}", notes, hidden))


def key_numbers(result: TrialResult, unknown: Sequence[str] = ()) -> Mapping[str, str]:
    """Key figures above the map, by name."""
    planning = [cycle.planning_ms for cycle in result.cycles]  # measured: left out, so that the picture repeats
    clear = f"{result.min_clearance:.3f} m" if math.isfinite(result.min_clearance) else "–"
    return MappingProxyType({
        "time": f"{result.time:.2f} s",
        "smallest clearance": clear,
        "cycles": str(len(planning)),
        "contingencies": str(result.contingencies),
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
    page.heading(figure, title, _failure(drive.result))
    _draw_map(page.axes(figure, page.map), drive, frame, task, vehicle, line, hidden, page.map.width / frame.size[0])
    draw_legend(figure, page, entries)
    for panel, part in zip(panels, page.panels, strict=True):
        draw_run_panel(page.axes(figure, part), panel, drive, last=panel is panels[-1])
    return figure


def _failure(result: TrialResult) -> str | None:
    """Text for a trial that did not reach the goal, else None."""
    return None if result.outcome is Outcome.SUCCESS else outcome_text(result.outcome, result.obstacle)


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
    for obstacle in task.obstacles:
        draw_obstacle(axes, frame, obstacle, scale)
    draw_goal(axes, frame, task.goal)
    draw_observations(axes, frame, drive.result)
    draw_footprints(axes, frame, vehicle, drive, run_footprint_interval(drive))
    draw_references(axes, frame, vehicle, drive.result)
    axes.add_collection(line, autolim=False)
    start = np.array([task.start.x, task.start.y, task.start.heading])
    draw_start(axes, frame, vehicle, start)
    draw_labels(axes, frame, _labels(drive, task, vehicle), _avoided_points(drive), scale)


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


def _avoided_points(drive: DrivenTrajectory) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    return np.column_stack([drive.motion.poses[:, :2], np.ones(len(drive.motion.poses))])


def _legend_entries(
    drive: DrivenTrajectory, line: LineCollection, hidden: Sequence[HiddenFeature]
) -> list[LegendEntry]:
    entries = [LegendEntry("planned in each cycle; planned speed", "line", CYCLE, 1.2)]
    if any(cycle.kind == ReferenceKind.CONTINGENCY for cycle in drive.result.cycles):
        entries.append(LegendEntry("contingency", "dashes", WARNING, 1.6))
    entries += [
        LegendEntry("estimated speed", "line", ESTIMATED, 1.2),
        LegendEntry("true values", "line", INK, 1.6),
        LegendEntry("camera", "dots", OBSERVATION, 2 * OBSERVATION_SIZE),
        LegendEntry(f"vehicle every {run_footprint_interval(drive):g} s", "outline", INK),
        *([LegendEntry("unknown to the planner", "outline", HIDDEN[hidden[0].kind][1])] if hidden else []),
        LegendEntry("driven, m/s", "scale", scale=line),
    ]
    return entries
