"""Page about an identification: data, parameters, correlation, fit, residuals, prediction of held-out logs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.figure import Figure

from kraft.plot.page import (
    HEADING,
    LEFT,
    NOTES,
    RIGHT,
    ColouredText,
    Page,
    Rectangle,
    note_rows_of,
)
from kraft.plot.style import (
    GREY,
    INK,
    SMALL,
    picture_format,
    plot_style,
    text_width,
    write_picture,
)
from kraft.plot.sysid_logs import (
    DATA,
    FITTED,
    HELD_OUT,
    IDENTIFIED,
    INITIAL,
    caption,
    draw_paths,
    draw_stack,
    set_floor_limits,
    with_name,
)
from kraft.plot.sysid_panels import (
    draw_correlation,
    draw_error_over_time,
    draw_histogram,
    draw_models,
    draw_parameters,
    draw_trials,
    draw_windows,
    fit_panels,
    has_hundredths,
    longest_time,
    matrix_height,
    matrix_side,
    table_height,
    trial_names_height,
)
from kraft.sysid.acceptance import PredictionEvaluation
from kraft.sysid.data import LogSplit, used_text
from kraft.sysid.interface import Identification, PartFit
from kraft.sysid.prediction import most_turning_log
from kraft.text import counted
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs.log import Log, Part


WIDTH: Final = 11.5
SIDE: Final = 3.1  # width of the parts at the left and at the right
FLOOR: Final = SIDE - 0.5
TABLE_LEFT: Final = LEFT + FLOOR + 0.3
GAP: Final = 0.75
NAMES_IN_GAP: Final = 0.3
"""Part of the space between two rows that the names below the matrix may take."""
ROWS: Final = (2.9, 3.3, 2.7)
"""Heights of data and parameters (at least), fit, and prediction."""
CHOICE, MODEL = 1.7, 0.28
"""Heights of the choice of terms and of the bar of a model."""
LEGEND_BELOW: Final = 0.15
"""Distance of what the terms are from their names."""
TERMS: Final = (
    "terms: effects, such as friction, that the model can do without; from all on, those named are switched off one "
    "after another, and + is switched on again. docs/sysid.md#terms explains each"
)
NAMES: Final = 0.8
"""Room for the names of models left of their bars."""


def plot_identification(
    path: Path,
    vehicle: Vehicle,
    split: LogSplit,
    result: Identification,
    evaluation: PredictionEvaluation,
    objections: Sequence[str] = (),
) -> None:
    """Draw an identification as PNG, SVG or PDF by the suffix of `path`.

    The same arguments give the same bytes.  The file is written in one step or not at all.

    Raises:
        InputError: if the suffix is none of these or the file cannot be written.
    """
    picture_format(path)
    with plot_style():
        write_picture(path, compose(vehicle, split, result, evaluation, objections))


def compose(
    vehicle: Vehicle,
    split: LogSplit,
    result: Identification,
    evaluation: PredictionEvaluation,
    objections: Sequence[str],
) -> Figure:
    """The page."""
    rows = note_rows_of(_notes(split, result, evaluation), WIDTH - LEFT - RIGHT)
    tops, top = [], HEADING + NOTES * len(rows) + 0.32
    below = table_height(result.parameters, result.warnings, _table_right(result) - TABLE_LEFT)
    heights = (max(ROWS[0], below, matrix_height(result.names) - NAMES_IN_GAP), *ROWS[1:])
    for height in heights:
        tops.append(top)
        top += height + GAP
    if result.trials or result.models:
        tops.append(top)
        terms = CHOICE + trial_names_height(result.trials) + LEGEND_BELOW if result.trials else 0.0
        top += max(terms, MODEL * len(result.models)) + 0.4
    floor = Rectangle(LEFT, tops[0], FLOOR, ROWS[0])
    page = Page(WIDTH, top - 0.25, floor, floor, (), rows)
    figure = Figure(figsize=(page.width, page.height))
    warning = f"not identified: {objections[0]}" if objections else None
    page.heading(figure, f"{vehicle.name}, identified from {counted(len(split.fitted), 'log')}", warning)
    _draw_data(figure, page, floor, split, result, heights[0])
    _draw_fit(figure, page, tops[1], vehicle, split, result)
    _draw_prediction(figure, page, tops[2], evaluation)
    if result.trials or result.models:
        _draw_choice(figure, page, tops[3], result)
    return figure


def _notes(split: LogSplit, result: Identification, evaluation: PredictionEvaluation) -> Mapping[str, str]:
    unseen = evaluation.held_out
    pair, whose = (unseen, "held out") if unseen else (evaluation.fitted, "fitted")
    source, noise = "measured" if result.noise_measured else "stated", result.noise
    return {
        "fitted": used_text(split.fitted),
        **({"held out": used_text(split.held_out)} if split.held_out else {}),
        "95 % intervals": result.interval,
        f"noise of the poses, {source}": f"{1000 * noise.position:.2g} mm, {math.degrees(noise.yaw):.2g}°",
        f"open loop, {whose}": f"{100 * pair.errors.overall_position:.2f} cm",
        "with the initial values": f"{100 * pair.initial_errors.overall_position:.2f} cm",
        f"fit, {counted(len(result.warnings), 'warning')}": (
            f"converged after {counted(result.iterations, 'iteration')}" if result.converged else "NOT converged"
        ),
    }


def _draw_data(
    figure: Figure, page: Page, floor: Rectangle, split: LogSplit, result: Identification, height: float
) -> None:
    axes = page.axes(figure, floor)
    paths = {FITTED: _paths(split.fitted), HELD_OUT: _paths(split.held_out)}
    for colour, found in paths.items():
        draw_paths(axes, found, colour, width=0.8)
    set_floor_limits(axes, [path for found in paths.values() for path in found], floor)
    words: list[ColouredText] = [("Data", INK), ("fitted", FITTED)]
    caption(figure, page, floor, words + ([("held out", HELD_OUT)] if split.held_out else []))
    top = floor.top
    side = matrix_side(len(result.names))
    matrix = Rectangle(WIDTH - RIGHT - side, top, side, side)
    table = Rectangle(TABLE_LEFT, top, _table_right(result) - TABLE_LEFT, height + 0.2)
    draw_parameters(figure, page, table, result.parameters, result.warnings)
    caption(figure, page, table, (("Parameters", INK), ("identified", IDENTIFIED), ("initial", INITIAL)))
    about = f"({result.interval}{', hundredths' if has_hundredths(len(result.names)) else ''})"
    draw_correlation(page.axes(figure, matrix), result.names, result.correlation)
    caption(figure, page, matrix, (("Correlation", INK), (about, INK)))


def _table_right(result: Identification) -> float:
    """Right side of the table of parameters, left of the names at the matrix, in."""
    labels = max((text_width(name, SMALL) for name in result.names), default=0.0) / 72 + 0.1
    return WIDTH - RIGHT - matrix_side(len(result.names)) - labels - 0.25


def _paths(logs: Sequence[Log]) -> list[np.ndarray[tuple[int, int], np.dtype[np.float64]]]:
    return [part.poses[:, :2] for log in logs for part in log.parts]


def _draw_fit(
    figure: Figure, page: Page, top: float, vehicle: Vehicle, split: LogSplit, result: Identification
) -> None:
    fit = max(result.logs, key=lambda found: sum(_change(part) for part in found.parts))
    log = next(each for each in split.fitted if each.name == fit.name)
    longest = max(fit.parts, key=lambda part: len(part.pose_times))
    part = next(p for p in log.parts if _within(longest, p))
    shown = _joined(sorted((f for f in fit.parts if _within(f, part)), key=lambda f: float(f.times[0])))
    left = Rectangle(LEFT, top + 0.1, WIDTH - LEFT - RIGHT - SIDE - 0.6, ROWS[1] - 0.1)
    caption(figure, page, Rectangle(LEFT, top - 0.07, 1, 1), ((f"Fit of {log.name}", INK),))
    draw_stack(figure, page, left, fit_panels(vehicle, result, part, shown))
    residuals = np.concatenate([part.residuals for found in result.logs for part in found.parts])
    right, height = WIDTH - RIGHT - SIDE, (ROWS[1] - 0.85) / 2
    for k, (values, sigma, unit, title) in enumerate((
        (1000 * residuals[:, :2].ravel(), 1000 * result.noise.position, "mm", "x and y"),
        (np.degrees(residuals[:, 2]), math.degrees(result.noise.yaw), "deg", "yaw"),
    )):  # fmt: skip
        part_of_page = Rectangle(right, top + 0.05 + k * (height + 0.75), SIDE, height)
        draw_histogram(page.axes(figure, part_of_page), values, sigma, unit)
        words = ((f"Residuals, {title}", INK), ("all fitted logs", DATA), ("as their noise", INK))
        caption(figure, page, part_of_page, words)


def _change(fit: PartFit) -> float:
    """How much the commands change in the fit of a part, of which windows may leave out much."""
    return float(np.abs(np.diff(fit.controls, axis=0)).sum())


def _within(fit: PartFit, part: Part) -> bool:
    """Whether a fit is of some poses of a part."""
    return bool(part.pose_times[0] <= fit.pose_times[0] and part.pose_times[-1] >= fit.pose_times[-1])


def _joined(fits: Sequence[PartFit]) -> PartFit:
    """Fits of the windows of a part as one."""
    held = [np.vstack([fit.controls, fit.controls[-1:]]) for fit in fits]
    names = ("times", "states", "pose_times", "poses", "fitted", "weights")
    return PartFit(
        controls=np.concatenate(held)[:-1],
        **{name: np.concatenate([getattr(fit, name) for fit in fits]) for name in names},
    )


def _draw_choice(figure: Figure, page: Page, top: float, result: Identification) -> None:
    """Draw the errors of structures and of models on logs that they were not fitted to."""
    width = WIDTH - LEFT - RIGHT - SIDE - 1.1 if result.models else WIDTH - LEFT - RIGHT
    if result.trials:
        part = Rectangle(LEFT, top, width, CHOICE)
        colours = draw_trials(page.axes(figure, part), result.trials)
        models = " and ".join(dict.fromkeys(trial.model for trial in result.trials))
        about = "error on logs, or parts of them, not fitted"
        about += "" if result.models else ", after switching off one term after another"
        words = [(f"Choice of terms of {models}", INK), (about, INK), *colours]
        caption(figure, page, part, words)
        below = part.bottom + trial_names_height(result.trials) + LEGEND_BELOW
        page.text(figure, part.left, below, TERMS, SMALL, GREY)
    if result.models:
        left = WIDTH - RIGHT - SIDE if result.trials else LEFT + NAMES
        part = Rectangle(left, top, SIDE, MODEL * len(result.models))
        draw_models(page.axes(figure, part), result.models)
        after = f"error after {longest_time(result.models):g} s, cm"
        caption(figure, page, part, (("Choice of the model", INK), (after, INK)))


def _draw_prediction(figure: Figure, page: Page, top: float, evaluation: PredictionEvaluation) -> None:
    pair = evaluation.held_out or evaluation.fitted
    whose = "held-out logs" if evaluation.held_out else "fitted logs"
    name = most_turning_log(pair.identified)
    floor = Rectangle(LEFT, top, SIDE + 0.2, ROWS[2])
    draw_windows(page.axes(figure, floor), floor, pair, name)
    title = with_name("Prediction of {} (turns most), 3 s at a time", name, floor.width + 0.2)
    caption(figure, page, floor, ((title, INK), ("poses", DATA)))
    pairs = [(pair, whose)] + ([(evaluation.fitted, "fitted logs")] if evaluation.held_out else [])
    width = (WIDTH - RIGHT - floor.left - floor.width - 1.5) / 2
    dashed = (("dashed: fitted", INK),) if len(pairs) > 1 else ()
    for k, (columns, factor, unit, title, rest) in enumerate((
        ((0, 1), 100.0, "cm", "Position", (("constant motion", DATA),)),
        ((2,), 180.0 / math.pi, "deg", "Yaw", dashed),  # there is no room for both
    )):  # fmt: skip
        part = Rectangle(floor.left + floor.width + 0.75 + k * (width + 0.75), top, width, ROWS[2])
        draw_error_over_time(page.axes(figure, part), pairs, columns, factor, unit)
        caption(
            figure, page, part, ((f"{title}, {whose}", INK), ("identified", IDENTIFIED), ("initial", INITIAL), *rest)
        )
