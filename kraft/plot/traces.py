"""What changed over time during a drive: speed, clearance and commands, with the cycles behind them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, MaxNLocator

from kraft.driving.messages import Cycle, Kind
from kraft.planning.workspace import workspace_of
from kraft.plot.drive import Drive
from kraft.plot.style import CYCLE, GREY, INK, RULE, SMALL, WARNING_PALE, Look, plain_number
from kraft.scenario import Task
from kraft.trial.result import TrialResult
from ompl_ext.arrays import Floats
from ompl_ext.exact import ExactClearance
from ompl_ext.vehicle import Vehicle

ESTIMATED: Final = "#a3178f"
COMMANDS: Final = ("throttle", "steering, rad")


@dataclass(frozen=True)
class Curve:
    """Values (n,) at the drive's times, held until the next if `stepped`; curves `behind` are thinner."""

    values: Floats
    colour: str
    behind: bool = False
    stepped: bool = False


@dataclass(frozen=True)
class Trace:
    """One panel: a quantity between limits, in one or more curves."""

    title: str
    curves: tuple[Curve, ...]
    limits: tuple[float, float]


def traces_of(drive: Drive, task: Task, vehicle: Vehicle) -> list[Trace]:
    """Speed (true, estimated, planned), true clearance, and the two commands."""
    steps = drive.result.steps
    speeds = [Curve(drive.speeds, INK)]
    if vehicle.rest:
        index = vehicle.rest_indices[0]
        planned = np.array([_planned(drive.result, step.time, index) for step in steps])
        estimated = np.array([step.estimate[index] for step in steps])
        speeds = [Curve(planned, CYCLE, True), Curve(estimated, ESTIMATED, True), *speeds]
    everything = np.concatenate([curve.values for curve in speeds])
    top = max(vehicle.top_speed, float(np.nanmax(everything)))
    exact = ExactClearance(workspace_of(task, vehicle), vehicle.footprint)
    clearance = np.maximum(exact.distances(drive.motion.poses), 0.0)
    traces = [
        Trace("speed, m/s", tuple(speeds), (min(0.0, float(np.nanmin(everything))), top)),
        Trace("clearance, m", (Curve(clearance, INK),), (0.0, max(0.1, float(clearance.max())))),
    ]
    commands = np.array([step.command for step in steps])
    for title, values, (low, high) in zip(COMMANDS, commands.T, vehicle.control_bounds, strict=True):
        limits = min(0.0, float(low), float(values.min())), max(0.0, float(high), float(values.max()))
        traces.append(Trace(title, (Curve(values, INK, stepped=True),), limits))
    return traces


def _planned(result: TrialResult, time: float, index: int) -> float:
    """What the reference in charge has at a time; nothing after its end."""
    cycle = _in_charge(result.cycles, time)
    if cycle is None or time > cycle.reference.end:
        return float("nan")
    return float(cycle.reference.state_at(time)[index])


def _in_charge(cycles: tuple[Cycle, ...], time: float) -> Cycle | None:
    begun = [cycle for cycle in cycles if cycle.time <= time + 1e-9]
    return begun[-1] if begun else None


def draw_trace(axes: Axes, trace: Trace, drive: Drive, *, last: bool) -> None:
    """One panel over the time of the trial; contingencies are shaded, cycles begin at the ticks above."""
    low, high = trace.limits
    room = 0.12 * (high - low)
    end = max(drive.result.time, 1e-3)
    axes.set(xlim=(0.0, end), ylim=(low - room, high + room))
    axes.yaxis.set_major_locator(MaxNLocator(3, steps=[1, 2, 4, 5, 10]))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
    _draw_cycles(axes, drive.result)
    axes.axhline(0.0, color=RULE, linewidth=0.6, zorder=1)
    for curve in trace.curves:
        look: Look = {"color": curve.colour, "linewidth": 0.9 if curve.behind else 1.3, "zorder": 3}
        axes.plot(drive.motion.times, curve.values, drawstyle="steps-post" if curve.stepped else "default", **look)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelbottom=last, bottom=last)
    title: Look = {"fontsize": SMALL + 0.5, "color": GREY, "va": "bottom", "parse_math": False}
    axes.text(0.0, 1.03, trace.title, transform=axes.transAxes, **title)
    if last:
        axes.set_xlabel("time, s", labelpad=2)


def _draw_cycles(axes: Axes, result: TrialResult) -> None:
    ends = [*(cycle.time for cycle in result.cycles[1:]), result.time]
    for cycle, end in zip(result.cycles, ends, strict=True):
        if cycle.kind == Kind.CONTINGENCY:
            axes.axvspan(cycle.time, end, color=WARNING_PALE, linewidth=0, zorder=0)
        axes.axvline(cycle.time, color=RULE, linewidth=0.5, zorder=0.5)
