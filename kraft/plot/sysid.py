"""Page about an identification: data, parameters, correlation, fit, residuals, prediction of held-out logs."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from kraft.plot.page import (
    DOTS,
    HEADING,
    HELD,
    LEFT,
    NOTES,
    RIGHT,
    ColouredText,
    Curve,
    Page,
    Panel,
    Rectangle,
    note_rows_of,
)
from kraft.plot.style import (
    GREY,
    INK,
    LABEL,
    RULE,
    SMALL,
    WARNING,
    Style,
    picture_format,
    plain_number,
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
    draw_message,
    draw_paths,
    draw_stack,
    held_command,
    most_excited_log,
    plain_axes,
    set_floor_limits,
    speeds,
    with_name,
)
from kraft.sysid.acceptance import PredictionEvaluation
from kraft.sysid.data import LogSplit
from kraft.sysid.interface import Identification, ModelTrial, ParameterEstimate, PartFit
from kraft.sysid.prediction import error_over_time, median_error_log
from kraft.text import counted
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs.log import Log, Part
    from kraft.sysid.acceptance import PredictionPair


WIDTH: Final = 11.5
SIDE: Final = 3.1  # width of the parts at the left and at the right
MATRIX: Final = 2.1
GAP: Final = 0.75
ROWS: Final = (2.9, 3.3, 2.7)
"""Heights of data and parameters (at least), fit, and prediction."""
CHOICE, NAMES, MODEL = 1.7, 0.8, 0.28
"""Heights of the choice of terms, of their names below it, which are turned, and of the bar of a model."""


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
    heights = (max(ROWS[0], _table_height(result.parameters)), *ROWS[1:])
    for height in heights:
        tops.append(top)
        top += height + GAP
    if result.trials or result.models:
        tops.append(top)
        top += CHOICE + NAMES if result.trials else MODEL * len(result.models) + 0.4
    floor = Rectangle(LEFT, tops[0], SIDE - 0.5, ROWS[0])
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
        "driven": f"{sum(log.duration for log in (*split.fitted, *split.held_out)):.0f} s",
        "95 % intervals": result.interval,
        f"noise of the poses, {source}": f"{1000 * noise.position:.2g} mm, {math.degrees(noise.yaw):.2g}°",
        f"open loop, {whose}": f"{100 * pair.errors.overall_position:.2f} cm",
        "with the initial values": f"{100 * pair.initial_errors.overall_position:.2f} cm",
        "fit": f"converged after {counted(result.iterations, 'iteration')}" if result.converged else "NOT converged",
        "warning" if len(result.warnings) == 1 else "warnings": str(len(result.warnings)),
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
    labels = max((text_width(name, SMALL) for name in result.names), default=0.0) / 72 + 0.1
    top = floor.top
    matrix = Rectangle(WIDTH - RIGHT - MATRIX, top, MATRIX, MATRIX)
    left = floor.left + floor.width + 0.3
    table = Rectangle(left, top, matrix.left - labels - 0.25 - left, height + 0.2)
    draw_parameters(figure, page, table, result.parameters, result.warnings)
    caption(figure, page, table, (("Parameters", INK), ("identified", IDENTIFIED), ("initial", INITIAL)))
    draw_correlation(page.axes(figure, matrix), result.names, result.correlation)
    caption(figure, page, matrix, (("Correlation", INK), (f"({result.interval})", INK)))


def _paths(logs: Sequence[Log]) -> list[np.ndarray[tuple[int, int], np.dtype[np.float64]]]:
    return [part.poses[:, :2] for log in logs for part in log.parts]


def _draw_fit(
    figure: Figure, page: Page, top: float, vehicle: Vehicle, split: LogSplit, result: Identification
) -> None:
    log = most_excited_log(split.fitted)
    fit = next(found for found in result.logs if found.name == log.name)
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
        words = [
            (f"Choice of terms of {result.trials[0].model}: error on logs not fitted, without one after another", INK),
            *colours,
        ]
        caption(figure, page, part, words)
    if result.models:
        left = WIDTH - RIGHT - SIDE if result.trials else LEFT + NAMES
        part = Rectangle(left, top, SIDE, MODEL * len(result.models))
        draw_models(page.axes(figure, part), result.models)
        after = f"error after {max(result.models[0].errors):g} s, cm"
        caption(figure, page, part, (("Choice of the model", INK), (after, INK)))


def _draw_prediction(figure: Figure, page: Page, top: float, evaluation: PredictionEvaluation) -> None:
    pair = evaluation.held_out or evaluation.fitted
    whose = "held-out logs" if evaluation.held_out else "fitted logs"
    name = median_error_log(pair.identified)
    floor = Rectangle(LEFT, top, SIDE + 0.2, ROWS[2])
    draw_windows(page.axes(figure, floor), floor, pair, name)
    title = with_name("Prediction of {}, 3 s at a time", name, floor.width + 0.2)
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


ROW: Final = 0.215
LINE, LINES_BELOW = 0.145, 8
"""Height of a small line; those for which there is room below the table."""
BAR: Final = 0.75
"""Least width of the bars in the table: the width of their heading."""
BETWEEN: Final = 0.12
"""Room between columns of the table."""
DOWNWEIGHTED: Final = 0.5
"""Weight below which observations are marked."""


def draw_parameters(
    figure: Figure, page: Page, part: Rectangle, parameters: Mapping[str, ParameterEstimate], warnings: Sequence[str]
) -> None:
    """Draw a table of parameters, with estimate and initial value between the bounds.

    Below it are the parameters that were not estimated, in as few lines as they need, and warnings.
    """
    estimated = {name: each for name, each in parameters.items() if not each.frozen}
    rows = [("", "value", "95 % interval", "initial"), *(_cells(name, each) for name, each in estimated.items())]
    widths = [
        max(text_width(cell, LABEL, bold=column == 0) for cell in cells) / 72
        for column, cells in enumerate(zip(*rows, strict=True))
    ]
    shrunk = min(
        1.0, (part.width - BAR - BETWEEN * len(widths)) / sum(widths)
    )  # long names and remarks leave the bars their room
    left, size = part.left, shrunk * LABEL
    for column, cells in enumerate(zip(*rows, strict=True)):
        for k, cell in enumerate(cells):
            colour, weight = (GREY, "normal") if k == 0 else (INK, "normal" if column else "bold")
            page.text(figure, left, part.top + 0.12 + ROW * k, cell, size, colour, weight=weight)
        left += shrunk * widths[column] + BETWEEN
    page.text(figure, left, part.top + 0.12, "in its bounds", size, GREY)
    for k, estimate in enumerate(estimated.values(), 1):
        bar = Rectangle(left, part.top + ROW * k - 0.01, part.left + part.width - left, 0.16)
        _draw_bar(page.axes(figure, bar), estimate)
    below = part.top + 0.12 + ROW * len(rows)
    for line in _frozen_lines(parameters, part.width):
        page.text(figure, part.left, below, line, SMALL, GREY)
        below += LINE
    _draw_warnings(figure, page, Rectangle(part.left, below, part.width, part.bottom - below), warnings)


def _table_height(parameters: Mapping[str, ParameterEstimate]) -> float:
    """Height of the table of estimated parameters, with room for a few lines below it, in."""
    return ROW * (1 + sum(not each.frozen for each in parameters.values())) + LINES_BELOW * LINE


def _frozen_lines(parameters: Mapping[str, ParameterEstimate], width: float) -> list[str]:
    """Lines that name the parameters that were not estimated, with their values."""
    frozen = [f"{name} {plain_number(each.value)}" for name, each in parameters.items() if each.frozen]
    return textwrap.wrap(f"frozen: {', '.join(frozen)}", _columns(width), break_on_hyphens=False) if frozen else []


def _columns(width: float) -> int:
    """Letters of a small line."""
    return int(width * 72 / (0.5 * SMALL))  # the mean width of a letter is about half its height


def _cells(name: str, estimate: ParameterEstimate) -> tuple[str, str, str, str]:
    """Cells of a row; the standard deviation decides the number of decimals."""
    size = estimate.std if estimate.std > 0 else abs(estimate.value) / 1000
    digits = min(max(1 - math.floor(math.log10(size)), 0), 5) if size > 0 else 3
    values = (estimate.value, *estimate.ci95, estimate.initial)
    value, low, high, initial = (f"{number:.{digits}f}".replace("-", "\N{MINUS SIGN}") for number in values)
    unit = "" if estimate.unit in ("", "1") else f", {estimate.unit}"
    return f"{name}{unit}", value, f"{low} to {high}{estimate.interval_note}", initial


def _draw_warnings(figure: Figure, page: Page, part: Rectangle, warnings: Sequence[str]) -> None:
    """As many lines as there is room for."""
    columns = _columns(part.width)
    lines = [text for warning in warnings for text in textwrap.wrap(f"Warning: {warning}", columns)]
    room = max(int(part.height / LINE), 0)
    if len(lines) > room > 0:
        lines = [*lines[: room - 1], "..."]
    for k, text in enumerate(lines[:room]):
        page.text(figure, part.left, part.top + LINE * (k + 1), text, SMALL, WARNING)


def _draw_bar(axes: Axes, estimate: ParameterEstimate) -> None:
    axes.set_axis_off()
    axes.set(xlim=(estimate.min, estimate.max), ylim=(-1, 1))
    axes.plot((estimate.min, estimate.max), (0, 0), color=RULE, linewidth=2.0, clip_on=False)
    axes.plot((estimate.initial,) * 2, (-0.8, 0.8), color=INITIAL, linewidth=1.2, clip_on=False)
    axes.plot(estimate.ci95, (0, 0), color=IDENTIFIED, linewidth=3.0, solid_capstyle="butt")
    axes.plot((estimate.value,), (0,), "o", color=IDENTIFIED, markersize=3.5, markeredgewidth=0, clip_on=False)


def draw_correlation(axes: Axes, names: Sequence[str], correlation: Floats) -> None:
    """The matrix, with its numbers."""
    count = len(names)
    if count == 0:
        draw_message(axes, "nothing was estimated")
        return
    axes.imshow(correlation, cmap="RdBu_r", vmin=-1.0, vmax=1.0, aspect="auto")
    size = min(LABEL, 46.0 / count)
    for i in range(count):
        for j in range(count):
            value = float(correlation[i, j])
            colour = "white" if abs(value) > 0.6 else INK
            axes.text(j, i, plain_number(round(value, 2)), ha="center", va="center", fontsize=size, color=colour)
    axes.set_xticks(range(count), labels=list(names), rotation=35, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(count), labels=list(names))
    axes.tick_params(length=0, labelcolor=INK)
    axes.spines[:].set_visible(False)


def fit_panels(vehicle: Vehicle, result: Identification, part: Part, fit: PartFit) -> list[Panel]:
    """Commands, speed and residuals of one part over time."""
    panels = []
    for k, name in enumerate(vehicle.controls):
        applied = Curve(fit.times[:-1], fit.controls[:, k], {"color": IDENTIFIED, "linewidth": 0.9, **HELD})
        title = ((name, INK), ("commanded", INK), ("in the fit", IDENTIFIED))
        panels.append(Panel(title, (Curve(*held_command(part, k), {"color": INK, "linewidth": 1.3, **HELD}), applied)))
    measured = Curve(*speeds(part), {"color": DATA, **DOTS})
    if vehicle.rest:
        smoothed = Curve(fit.times, fit.states[:, vehicle.rest_indices[0]], {"color": IDENTIFIED, "linewidth": 1.3})
        title = (("speed, m/s", INK), ("between poses", DATA), ("in the fit", IDENTIFIED))
        panels.append(Panel(title, (measured, smoothed)))
    return panels + _residual_panels(result, fit)


def _residual_panels(result: Identification, fit: PartFit) -> list[Panel]:
    residuals, times = fit.residuals, fit.pose_times
    downweighted = fit.weights < DOWNWEIGHTED
    position = np.hypot(residuals[:, 0], residuals[:, 1])
    curves = [
        Curve(times, 1000 * residuals[:, 0], {"color": INK, **DOTS}),
        Curve(times, 1000 * residuals[:, 1], {"color": DATA, **DOTS}),
    ]
    if downweighted.any():
        curves.append(Curve(times[downweighted], 1000 * position[downweighted], {"color": WARNING, **DOTS}))
    yaw = [Curve(times, np.degrees(residuals[:, 2]), {"color": INK, **DOTS})]
    if downweighted.any():
        yaw.append(Curve(times[downweighted], np.degrees(residuals[downweighted, 2]), {"color": WARNING, **DOTS}))
    about = (("counts less", WARNING),) if downweighted.any() else ()
    position_title = (("residual, mm", INK), ("x", INK), ("y", DATA), *about)
    yaw_title = (("residual, deg", INK), ("yaw", INK), *about)
    return [
        Panel(position_title, tuple(curves), band=2000 * result.noise.position),
        Panel(yaw_title, tuple(yaw), band=math.degrees(2 * result.noise.yaw)),
    ]


def draw_histogram(axes: Axes, residuals: Floats, sigma: float, unit: str) -> None:
    """Draw the distribution of residuals (n,) and the normal distribution of the stated noise."""
    edge = max(4.0 * sigma, float(np.quantile(np.abs(residuals), 0.995)))
    axes.hist(np.clip(residuals, -edge, edge), bins=60, range=(-edge, edge), density=True, color=DATA, alpha=0.75)
    at = np.linspace(-edge, edge, 200)
    axes.plot(at, np.exp(-0.5 * (at / sigma) ** 2) / (sigma * math.sqrt(math.tau)), color=INK, linewidth=1.2)
    plain_axes(axes)
    axes.spines["left"].set_visible(False)
    axes.set_yticks([])
    axes.set_xlim(-edge, edge)
    axes.set_xlabel(unit, labelpad=1)


def draw_trials(axes: Axes, trials: Sequence[ModelTrial]) -> list[ColouredText]:
    """Draw the errors by time of each structure, in the order in which they were tried; return the key of the times."""
    at, found = np.arange(len(trials)), list[ColouredText]()
    for share, after in enumerate(sorted({after for trial in trials for after in trial.errors})):
        colour = (DATA, INK, IDENTIFIED)[min(share, 2)]
        errors = 100.0 * np.array([trial.errors.get(after, math.nan) for trial in trials])
        for model in {trial.model: None for trial in trials}:
            own = [k for k, trial in enumerate(trials) if trial.model == model and not trial.added]
            axes.plot(at[own], errors[own], ".-", color=colour, linewidth=1.2, markersize=4.0)
        again = [k for k, trial in enumerate(trials) if trial.added]  # beside the path
        axes.plot(at[again], errors[again], ".", color=colour, markersize=4.0)
        chosen = [k for k, trial in enumerate(trials) if trial.chosen]
        axes.plot(at[chosen], errors[chosen], "o", color=colour, markersize=8.0, markerfacecolor="none")
        found.append((f"{after:g} s", colour))
    found.append(("ring: chosen", INK))
    plain_axes(axes)
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(10.0, (1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_xticks(
        at,
        [_tried(trials, k) for k in range(len(trials))],
        rotation=35,
        ha="right",
        rotation_mode="anchor",
        fontsize=SMALL,
    )
    axes.set_xlim(-0.5, len(trials) - 0.5)
    axes.grid(color=RULE, linewidth=0.4)
    axes.set_ylabel("cm", labelpad=1)
    return found


def _tried(trials: Sequence[ModelTrial], k: int) -> str:
    """What tells a structure from the one before."""
    if k == 0:
        return counted(len(trials[k].terms), "term")
    if trials[k].model != trials[0].model:
        return trials[k].model
    if trials[k].added:
        return f"+ {trials[k].added}"
    names = trials[k].without.split(", ")
    return names[0] if len(names) == 1 else f"{len(names)} idle ones"


def draw_models(axes: Axes, models: Sequence[ModelTrial]) -> None:
    """Draw the errors of models at the longest time that all of them predict."""
    after = max(set.intersection(*(set(model.errors) for model in models)))
    errors = [100.0 * model.errors[after] for model in models]
    colours = [IDENTIFIED if model.chosen else DATA for model in models]
    axes.barh(range(len(models)), errors, height=0.6, color=colours)
    for k, error in enumerate(errors):
        axes.text(error, k, f" {plain_number(float(f'{error:.3g}'))}", va="center", fontsize=SMALL)
    axes.set_yticks(range(len(models)), [model.model for model in models], fontsize=SMALL)
    axes.invert_yaxis()
    axes.set(xlim=(0.0, 1.2 * max(errors)), xticks=[])
    axes.spines[["top", "right", "bottom"]].set_visible(False)


def draw_windows(axes: Axes, part: Rectangle, pair: PredictionPair, name: str) -> None:
    """Draw measured and predicted paths of each window of one log."""
    after = [window for window in pair.identified if window.log == name]
    before = [window for window in pair.initial if window.log == name]
    observed = [window.poses for window in after]
    for path in observed:
        axes.plot(path[:, 0], path[:, 1], ".", color=DATA, markersize=2.6, markeredgewidth=0, zorder=2)
    for window in before:
        axes.plot(window.predicted[:, 0], window.predicted[:, 1], color=INITIAL, linewidth=0.9, zorder=3)
    draw_paths(axes, [window.predicted for window in after], IDENTIFIED, width=1.3, zorder=4)
    set_floor_limits(axes, [*observed, *(window.predicted for window in (*after, *before))], part)


def draw_error_over_time(
    axes: Axes, pairs: Sequence[tuple[PredictionPair, str]], columns: Sequence[int], factor: float, unit: str
) -> None:
    """Draw the error over time: identified, initial, constant motion; forecasts after the first are thin and dashed."""
    for k, (pair, _) in enumerate(pairs):
        style: Style = {"linewidth": 1.8 if k == 0 else 1.0, "linestyle": "solid" if k == 0 else (0, (2.4, 1.2))}
        for windows, colour in ((pair.constant, DATA), (pair.initial, INITIAL), (pair.identified, IDENTIFIED)):
            times, errors = error_over_time(windows, columns)
            axes.plot(np.append(0.0, times), factor * np.append(0.0, errors), color=colour, **style)
    plain_axes(axes)
    axes.set(xlim=(0.0, 3.0))
    axes.set_ylim(bottom=0.0)
    axes.grid(color=RULE, linewidth=0.4)
    axes.set_xlabel("time since the prediction began, s", labelpad=1)
    axes.set_ylabel(unit, labelpad=2)
