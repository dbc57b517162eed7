"""Page about logs without an identification: paths on the floor, commands and speed over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from kraft.plot.page import DOTS, HEADING, HELD, LEFT, NOTES, RIGHT, Curve, Page, Panel, Rectangle, note_rows_of
from kraft.plot.style import INK, picture_format, plot_style, write_picture
from kraft.plot.sysid_style import DATA, FITTED, caption, draw_paths, draw_stack, set_floor_limits
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs.log import Log, Part

WIDTH, HEIGHT, MAP = 11.5, 4.6, 4.0
SPEED_INTERVAL = 0.25
"""Time over which a speed is measured, s."""


def plot_logs(path: Path, vehicle: Vehicle, logs: Sequence[Log], problem: str) -> None:
    """Draw logs from which nothing could be identified, as PNG, SVG or PDF; `problem` is the reason.

    Raises:
        InputError: if the suffix is none of these or the file cannot be written.
    """
    picture_format(path)
    with plot_style():
        write_picture(path, compose_logs(vehicle, logs, problem))


def compose_logs(vehicle: Vehicle, logs: Sequence[Log], problem: str) -> Figure:
    """The page."""
    notes = {
        "logs": str(len(logs)),
        "driven": f"{sum(log.duration for log in logs):.0f} s",
        "poses": str(sum(len(part.pose_times) for log in logs for part in log.parts)),
    }
    rows = note_rows_of(notes, WIDTH - LEFT - RIGHT)
    top = HEADING + NOTES * len(rows) + 0.3
    floor = Rectangle(LEFT, top, MAP, HEIGHT - top - 0.45)
    page = Page(WIDTH, HEIGHT, floor, floor, (), rows)
    figure = Figure(figsize=(WIDTH, HEIGHT))
    page.heading(figure, f"{vehicle.name} · the logs", f"not identified: {problem}")
    paths = [part.poses[:, :2] for log in logs for part in log.parts]
    axes = page.axes(figure, floor)
    draw_paths(axes, paths, FITTED)
    set_floor_limits(axes, paths, floor)
    caption(figure, page, floor, (("Poses", INK), ("a dot where a drive begins", INK)))
    log = most_excited_log(logs)
    side = Rectangle(LEFT + MAP + 0.75, top, WIDTH - LEFT - MAP - 0.75 - RIGHT, floor.height)
    caption(figure, page, Rectangle(side.left, side.top - 0.14, side.width, side.height), ((log.name, INK),))
    draw_stack(figure, page, side, log_panels(vehicle, max(log.parts, key=lambda part: part.duration)))
    return figure


def log_panels(vehicle: Vehicle, part: Part) -> list[Panel]:
    """Commands, speed and yaw of a part, as logged."""
    panels = [
        Panel(
            ((f"{name}, commanded", INK),), (Curve(*held_command(part, k), {"color": INK, "linewidth": 1.0, **HELD}),)
        )
        for k, name in enumerate(vehicle.controls)
    ]
    panels.append(Panel((("speed between poses, m/s", DATA),), (Curve(*speeds(part), {"color": DATA, **DOTS}),)))
    panels.append(Panel((("yaw, rad", DATA),), (Curve(part.pose_times, part.poses[:, 2], {"color": DATA, **DOTS}),)))
    return panels


def most_excited_log(logs: Sequence[Log]) -> Log:
    """The log whose commands vary most."""
    return max(logs, key=lambda log: sum(_excitation(part) for part in log.parts))


def _excitation(part: Part) -> float:
    return float(np.sum(np.abs(np.diff(part.commands, axis=0)))) if len(part.commands) > 1 else 0.0


def held_command(part: Part, control: int) -> tuple[Floats, Floats]:
    """Times and values of a command until the last pose."""
    times = np.append(part.command_times, max(part.pose_times[-1], part.command_times[-1]))
    return times, np.append(part.commands[:, control], part.commands[-1, control])


def speeds(part: Part) -> tuple[Floats, Floats]:
    """Times and speeds along the heading between poses about `SPEED_INTERVAL` s apart, m/s."""
    times, poses = part.pose_times, part.poses
    if len(times) < 2:
        return times[:0], times[:0]
    apart = max(1, round(SPEED_INTERVAL / float(np.median(np.diff(times)))))
    apart = min(apart, len(times) - 1)
    step = poses[apart:] - poses[:-apart]
    yaw = 0.5 * (poses[apart:, 2] + poses[:-apart, 2])
    along = step[:, 0] * np.cos(yaw) + step[:, 1] * np.sin(yaw)
    return 0.5 * (times[apart:] + times[:-apart]), along / (times[apart:] - times[:-apart])
