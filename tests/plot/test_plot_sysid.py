"""The page about an identification: the same bytes for the same result, everything on it, also where nothing came out."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from support.sysid import estimated, fake_evaluation, fake_identification, fake_log, fake_windows

from kraft.errors import InputError
from kraft.plot.style import plain_number, plot_style
from kraft.plot.sysid import compose, plot_identification
from kraft.plot.sysid_logs import compose_logs, most_excited_log, plot_logs, speeds
from kraft.plot.sysid_panels import draw_error_over_time
from kraft.sysid.acceptance import PredictionPair
from kraft.sysid.data import LogSplit
from kraft.sysid.interface import Identification, LogFit, ModelTrial, PartFit
from kraft.sysid.prediction import error_over_time, most_turning_log
from kraft.vehicles.load import load_vehicle

MUSHR = load_vehicle("mushr")
LOGS = tuple(fake_log(f"run_{k}", 0.1 * k) for k in range(1, 5))
SPLIT = LogSplit(LOGS[:3], LOGS[3:], "")
RESULT = fake_identification(SPLIT.fitted)


def texts(figure: Figure) -> str:
    found = [text.get_text() for part in (figure, *figure.axes) for text in part.texts]
    return "\n".join(found + [label.get_text() for axes in figure.axes for label in axes.get_yticklabels()])


def page(split: LogSplit, result: Identification, objections: tuple[str, ...] = ()) -> Figure:
    with plot_style():
        return compose(MUSHR, split, result, fake_evaluation(split), objections)


def test_the_same_result_gives_the_same_bytes(tmp_path: Path) -> None:
    """In one format: test_plot.py compares them all, and one function writes them."""
    paths = [tmp_path / f"{name}.svg" for name in "ab"]
    for path in paths:
        plot_identification(path, MUSHR, SPLIT, RESULT, fake_evaluation(SPLIT))
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_parameters_fit_residuals_prediction_and_correlation_are_on_the_page() -> None:
    seen = texts(page(SPLIT, RESULT))
    for said in ("L, m", "phi_diff, rad", "0.330", "0.310 to 0.350", "delay, s", "Fit of run_", "Residuals, yaw",
                 "Prediction of run_4 (turns most), 3 s at a time", "Position, held-out logs", "constant motion", "Correlation",
                 "held out"):  # fmt: skip
        assert said in seen
    assert "not identified" not in seen


@pytest.mark.parametrize("count", [1, 3, 8, 12, 22])
def test_names_and_numbers_of_the_correlations_do_not_overlap(count: int) -> None:
    names = tuple(f"parameter_{k}" for k in range(count))
    estimate = next(iter(RESULT.parameters.values()))
    many = replace(
        RESULT, names=names, parameters=dict.fromkeys(names, estimate), covariance=0.99 * np.eye(count) - 0.004
    )
    figure = page(SPLIT, many)
    figure.draw_without_rendering()
    axes = next(axes for axes in figure.axes if axes.images)
    cell = axes.get_window_extent().width / count
    for number in axes.texts:
        assert number.get_window_extent().width < cell
    labels = axes.get_xticklabels()
    points = cell * 72.0 / figure.dpi
    assert all(points * math.sin(math.radians(label.get_rotation())) > 1.3 * label.get_fontsize() for label in labels)
    lowest = min(label.get_window_extent().y0 for label in labels)
    below = next(text for text in figure.texts if text.get_text() == "Residuals, x and y")
    assert lowest > below.get_window_extent().y1


def test_the_page_has_the_number_and_the_used_time_of_fitted_and_of_held_out_logs() -> None:
    part = LOGS[3].parts[0]
    late = replace(part, pose_times=part.pose_times + 4.0, command_times=part.command_times + 4.0)
    seen = texts(page(replace(SPLIT, held_out=(replace(LOGS[3], parts=(late,)),)), RESULT))
    assert "3 logs, 24 s" in seen
    assert "1 log, 8 of 12 s" in seen


def test_a_long_name_of_a_log_leaves_the_caption_beside_it_its_room() -> None:
    split = replace(SPLIT, held_out=(replace(LOGS[3], name="recorded_in_the_large_hall_" * 3),))
    (line,) = [line for line in texts(page(split, RESULT)).splitlines() if line.startswith("Prediction of")]
    assert line.startswith("Prediction of recorded_in")
    assert line.endswith("... (turns most), 3 s at a time") or line.endswith(
        "\N{HORIZONTAL ELLIPSIS} (turns most), 3 s at a time"
    )


def test_the_choice_of_terms_and_models_is_on_the_page() -> None:
    def tried(model: str, terms: tuple[str, ...], without: str, error: float, *, chosen: bool) -> ModelTrial:
        return ModelTrial(model, terms, without, {1.0: error, 2.0: 2.0 * error, 3.0: 3.0 * error}, chosen)

    names = ("drag", "slip", "lever")
    trials = [tried("car-lag", names, "", 0.02, chosen=False), tried("car-lag", names[1:], "drag", 0.02, chosen=True),
              tried("car-lag", names[2:], "slip", 0.1, chosen=False),
              replace(tried("car-lag", names, "", 0.02, chosen=False), added="drag")]  # fmt: skip
    models = [trials[1], tried("mushr-lag", (), "", 0.05, chosen=False)]
    seen = page(SPLIT, replace(RESULT, trials=tuple(trials), models=tuple(models)))
    assert "Choice of the model" in texts(seen)
    labels = {label.get_text() for axes in seen.axes for label in axes.get_xticklabels()}
    assert {"all 3 terms on", "drag", "slip", "+ drag"} <= labels
    assert "mushr-lag" in texts(seen)
    assert "Choice of" not in texts(page(SPLIT, RESULT))


def test_all_windows_of_a_drive_are_in_the_picture_of_its_fit() -> None:
    def halves(log: LogFit) -> LogFit:
        (whole,) = log.parts
        k, n = len(whole.times) // 2, len(whole.pose_times) // 2
        cut = {name: getattr(whole, name) for name in ("times", "states", "pose_times", "poses", "fitted", "weights")}
        ends = {"times": k + 1, "states": k + 1}
        first = PartFit(**{name: v[: ends.get(name, n)] for name, v in cut.items()}, controls=whole.controls[:k])
        begins = {"times": k, "states": k}
        last = PartFit(**{name: v[begins.get(name, n) :] for name, v in cut.items()}, controls=whole.controls[k:])
        return replace(log, parts=(last, first))

    def residuals(result: Identification) -> list[int]:
        return [len(line.get_xdata()) for axes in page(SPLIT, result).axes for line in axes.lines]  # type: ignore[arg-type]

    cut = replace(RESULT, logs=tuple(map(halves, RESULT.logs)))
    poses = len(RESULT.logs[0].parts[0].pose_times)
    assert residuals(cut).count(poses) == residuals(RESULT).count(poses) > 0


def test_without_held_out_logs_the_fitted_ones_are_predicted() -> None:
    seen = texts(page(LogSplit(LOGS, (), ""), fake_identification(LOGS)))
    assert "Position, fitted logs" in seen
    assert "held out" not in seen


def test_warnings_bounds_and_objections_are_on_the_page() -> None:
    bad = {**RESULT.parameters, "L": estimated(2.0, 0.1, at_bound=True)}
    result = replace(RESULT, parameters=bad, warnings=("something changed between the logs",), converged=False)
    seen = texts(page(SPLIT, result, ("the logs do not show L",)))
    assert "not identified: the logs do not show L" in seen
    assert "Warning: something changed" in seen
    assert "at its bound" in seen
    assert "NOT converged" in seen


@pytest.mark.parametrize(("warnings", "said"), [((), "fit, 0 warnings"), (("one",), "fit, 1 warning")])
def test_the_number_of_warnings_stands_below_the_fit_in_one_line(warnings: tuple[str, ...], said: str) -> None:
    lines = texts(page(SPLIT, replace(RESULT, warnings=warnings, iterations=1))).splitlines()
    assert said in lines
    assert "converged after 1 iteration" in lines


@pytest.mark.parametrize(("terms", "models"), [(3, 0), (3, 2), (3, 12), (0, 12)])
def test_the_names_of_terms_and_models_are_within_the_page(terms: int, models: int) -> None:
    def tried(name: str, without: str = "") -> ModelTrial:
        return ModelTrial(name, ("drag",), without, {1.0: 0.02}, chosen=False)

    trials = tuple(tried("car-lag", "a_term_with_a_rather_long_name" if k else "") for k in range(terms))
    found = replace(RESULT, trials=trials, models=tuple(tried(f"model-{k}") for k in range(models)))
    figure = page(SPLIT, found)
    figure.canvas.draw()
    labels = [label for axes in figure.axes for label in (*axes.get_xticklabels(), *axes.get_yticklabels())]
    named = [label for label in labels if label.get_text().startswith(("a_term", "model-"))]
    assert len(named) == max(terms - 1, 0) + models
    assert min(label.get_window_extent().y0 for label in named) > 0.0
    assert min(axes.get_window_extent().y0 for axes in figure.axes) > 0.0


def test_long_names_and_remarks_leave_the_table_beside_the_matrix() -> None:
    names = ("L", "phi_diff", "v_delta", "lag_steering", "dead_band_throttle", "dead_band_steering", "yaw_offset")
    parameters = {name: estimated(-0.0331, 0.00001, unit="rad", min=-0.0331, at_bound=True) for name in names}
    covariance = np.eye(len(names))
    result = replace(
        RESULT,
        parameters=parameters,
        names=names,
        auxiliary=names[3:],
        covariance=covariance,
        graph_covariance=covariance,
    )
    figure = page(SPLIT, result)
    figure.canvas.draw()
    (matrix,) = (axes for axes in figure.axes if names == tuple(text.get_text() for text in axes.get_yticklabels()))
    labels = min(text.get_window_extent().x0 for text in matrix.get_yticklabels())
    bars = [axes for axes in figure.axes if axes.get_ylim() == (-1.0, 1.0) and not axes.axison]
    heading = next(text for text in figure.texts if text.get_text() == "in its bounds")
    assert len(bars) == len(names)
    assert all(bar.get_window_extent().width > 0 and bar.get_window_extent().x1 < labels for bar in bars)
    assert heading.get_window_extent().x1 < labels


def test_the_fit_is_below_a_long_table_and_what_is_frozen_is_in_its_last_lines() -> None:
    names = tuple(f"term_{k}" for k in range(24))
    parameters = {name: estimated(0.2, 0.01, min=0.0) for name in names}
    parameters |= {f"off_{k}": replace(estimated(0.0, 0.0, min=0.0), frozen=True) for k in range(12)}
    covariance = np.eye(len(names))
    result = replace(
        RESULT,
        parameters=parameters,
        names=names,
        auxiliary=(),
        covariance=covariance,
        graph_covariance=covariance,
        warnings=("one", "two"),
    )
    figure = page(SPLIT, result)
    figure.canvas.draw()
    lowest = {text.get_text(): text.get_window_extent().y0 for text in figure.texts}
    (frozen,) = (y for said, y in lowest.items() if said.startswith("frozen: off_0 0, "))
    (fit,) = (y for said, y in lowest.items() if said.startswith("Fit of "))
    assert lowest["term_23, m"] > frozen > lowest["Warning: one"] > lowest["Warning: two"] > fit


def test_everything_frozen_leaves_a_page() -> None:
    frozen = {name: replace(each, frozen=True, std=0.0) for name, each in RESULT.parameters.items()}
    is_zero = np.zeros((0, 0))
    result = replace(RESULT, parameters=frozen, names=(), covariance=is_zero, graph_covariance=is_zero)
    assert "nothing was estimated" in texts(page(SPLIT, result))


def test_the_logs_alone_are_drawn_with_why_nothing_came_of_them(tmp_path: Path) -> None:
    with plot_style():
        seen = texts(compose_logs(MUSHR, LOGS, "logs show no motion"))
    for said in ("not identified: logs show no motion", "throttle, commanded", "speed between poses, m/s"):
        assert said in seen
    plot_logs(tmp_path / "logs.png", MUSHR, LOGS, "logs show no motion")
    assert (tmp_path / "logs.png").stat().st_size > 10_000


def test_large_coordinates_are_counted_from_an_origin_that_the_axis_names() -> None:
    shift = np.array([432_150.0, -5_321_950.0, 0.0])
    far = [replace(log, parts=tuple(replace(part, poses=part.poses + shift) for part in log.parts)) for log in LOGS]
    with plot_style():
        figure = compose_logs(MUSHR, far, "logs show no motion")
        figure.canvas.draw()
        floor = next(axes for axes in figure.axes if axes.get_xlabel().startswith("x"))
        ticks = [label.get_text() for axis in (floor.xaxis, floor.yaxis) for label in axis.get_ticklabels()]
    assert (floor.get_xlabel(), floor.get_ylabel()) == ("x \N{MINUS SIGN} 432,100, m", "y + 5,322,000, m")
    assert all(0.0 <= float(tick) < 100.0 for tick in ticks), ticks


@pytest.mark.parametrize("poses", [1, 2, 3])
def test_a_log_of_a_few_poses_can_be_drawn(poses: int) -> None:
    (part,) = LOGS[0].parts
    short = replace(part, pose_times=part.pose_times[:poses], poses=part.poses[:poses])
    with plot_style():
        assert "not identified" in texts(compose_logs(MUSHR, (replace(LOGS[0], parts=(short,)),), "is short"))


def test_a_picture_of_another_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.gif"):
        plot_identification(tmp_path / "a.gif", MUSHR, SPLIT, RESULT, fake_evaluation(SPLIT))


def test_the_speed_between_poses_is_that_of_the_drive() -> None:
    times, found = speeds(LOGS[1].parts[0])
    assert np.allclose(found, 0.5, atol=0.001)
    assert len(times) == len(found) == 240 - 8  # a quarter of a second apart


def test_errors_grow_as_the_windows_say() -> None:
    times, errors = error_over_time(fake_windows(LOGS, 0.1), (0, 1))
    assert np.allclose(errors, 0.1 * times, rtol=0.15, atol=0.001)
    assert times[0] == pytest.approx(0.1)


def test_the_log_that_is_shown_is_the_one_that_is_steered_most_or_turns_most() -> None:
    (part,) = LOGS[2].parts
    wild = replace(
        LOGS[2], parts=(replace(part, commands=part.commands * np.where(np.arange(16) % 2, 1, -1)[:, None]),)
    )
    assert most_excited_log((*LOGS[:2], wild)) is wild
    windows = fake_windows(LOGS[:3], 0.1)
    straight = [replace(each, poses=each.poses * [1.0, 1.0, 0.0]) for each in (windows[0], windows[2])]
    assert most_turning_log([straight[0], windows[1], straight[1]]) == "run_2"


@pytest.mark.parametrize(("initial", "scale"), [(0.05, "linear"), (5.0, "log")])
def test_errors_of_the_identified_model_can_be_read_beside_large_ones(initial: float, scale: str) -> None:
    logs = SPLIT.held_out
    pair = PredictionPair(fake_windows(logs, 0.01), fake_windows(logs, initial), fake_windows(logs, 0.02))
    axes = Figure().add_subplot()
    draw_error_over_time(axes, [(pair, "held-out logs")], (0, 1), 100.0, "cm")
    assert axes.get_yscale() == scale
    assert axes.get_ylabel() == ("cm" if scale == "linear" else "cm, logarithmic")
    low, high = axes.get_ylim()
    assert low <= 1.0, "cm after 1 s"
    begins = {float(line.get_xdata()[0]) for line in axes.lines}  # type: ignore[index]
    assert begins == {0.0 if scale == "linear" else 0.1}, "a logarithmic axis has no 0"
    assert high > 3.0, "cm after 3 s"


@pytest.mark.parametrize(
    ("value", "text"), [(1000.0, "1,000"), (-12345.6, "\N{MINUS SIGN}12,346"), (999.4, "999"), (0.00125, "0.00125")]
)
def test_ticks_of_thousands_are_whole_numbers(value: float, text: str) -> None:
    assert plain_number(value) == text
