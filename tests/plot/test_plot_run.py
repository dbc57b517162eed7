"""Pictures of drives: the same bytes for the same drive, whatever became of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from kraft.driving.messages import ReferenceKind
from kraft.driving.method import load_method
from kraft.errors import InputError
from kraft.plot.page import Frame
from kraft.plot.run import (
    OBSERVATION,
    DrivenTrajectory,
    _compose,
    _legend_entries,
    driven_line,
    key_numbers,
    panels_of_run,
    plot_run,
    run_footprint_interval,
)
from kraft.plot.style import plot_style
from kraft.scenario import Box, load_scenario
from kraft.simulation.appearance import hidden_features
from kraft.trial.result import Outcome, TrialResult, TrialSpec
from kraft.trial.trial import run_trial
from kraft.vehicles.load import load_vehicle
from kraft.video.legend import scene_rows
from kraft_cli.main import main

MUSHR = load_vehicle("mushr")
MOVABLE = load_scenario("movable")


@pytest.fixture(scope="module")
def driven() -> TrialResult:
    short = dataclasses.replace(MOVABLE, trial=MOVABLE.trial.model_copy(update={"timeout": 4.5}))
    return run_trial(TrialSpec(short, load_method("conservative-kraft"), MUSHR, 1))


def width(path: Path) -> int:
    with Image.open(path) as picture:
        return picture.width


def texts(figure: Figure) -> set[str]:
    return {text.get_text() for part in (figure, *figure.axes) for text in part.texts}


def test_the_same_drive_gives_the_same_bytes(driven: TrialResult, tmp_path: Path) -> None:
    """In one format: test_plot.py compares them all, and one function writes them."""
    paths = [tmp_path / f"{name}.svg" for name in "ab"]
    slower = dataclasses.replace(
        driven, cycles=tuple(dataclasses.replace(cycle, planning_ms=99.0) for cycle in driven.cycles)
    )
    for path, result in zip(paths, (driven, slower), strict=True):
        plot_run(path, MOVABLE.task(), MUSHR, result, hidden=hidden_features(MOVABLE))
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_a_contingency_that_the_trial_ended_before_is_not_drawn(driven: TrialResult, tmp_path: Path) -> None:
    last, pictures = driven.cycles[-1], []
    for kind in ReferenceKind:
        later = dataclasses.replace(
            last, time=driven.time + 0.1, reference=dataclasses.replace(last.reference, kind=kind)
        )
        path = tmp_path / f"{kind}.svg"
        plot_run(path, MOVABLE.task(), MUSHR, dataclasses.replace(driven, cycles=(*driven.cycles, later)))
        pictures.append(path.read_bytes())
    assert pictures[0] == pictures[1]


@pytest.mark.parametrize("outcome", list(Outcome))
def test_every_outcome_is_on_the_page(outcome: Outcome, driven: TrialResult) -> None:
    collided = outcome is Outcome.COLLISION
    result = dataclasses.replace(driven, outcome=outcome, obstacle="left wall" if collided else None)
    with plot_style():
        found = texts(
            _compose(
                DrivenTrajectory.of(result, MOVABLE.start),
                MOVABLE.task(),
                MUSHR,
                "title",
                key_numbers(result, MUSHR),
                (),
            )
        )
    assert ("collision with left wall" in found) == collided
    assert ("collision with\nleft wall" in found) == collided
    assert ("timeout" in found) == (outcome is Outcome.TIMEOUT)


def test_a_trial_that_ends_at_its_start_is_drawn_without_panels(driven: TrialResult, tmp_path: Path) -> None:
    result = dataclasses.replace(driven, outcome=Outcome.SUCCESS, time=0.0, steps=(), cycles=(), observations=())
    plot_run(tmp_path / "run.png", MOVABLE.task(), MUSHR, result)
    assert width(tmp_path / "run.png") > 0
    assert panels_of_run(DrivenTrajectory.of(result, MOVABLE.start), MOVABLE.task(), MUSHR) == []


def test_the_page_names_the_vehicle_and_the_seed(driven: TrialResult) -> None:
    with plot_style():
        drive, notes = DrivenTrajectory.of(driven, MOVABLE.start), key_numbers(driven, MUSHR)
        found = texts(_compose(drive, MOVABLE.task(), MUSHR, "title", notes, ()))
    assert {"vehicle", MUSHR.name, "seed", str(driven.seed)} <= set(found)


def test_what_the_planner_did_not_know_is_said() -> None:
    slope = load_scenario("slope")
    result = run_trial(TrialSpec(slope, load_method("oneshot-openloop"), MUSHR, 0))
    unknown = slope.truth.in_words()
    found = texts(
        _compose(
            DrivenTrajectory.of(result, MOVABLE.start),
            slope.task(),
            MUSHR,
            "title",
            key_numbers(result, MUSHR, unknown),
            (),
        )
    )
    assert {"not known to the planner", "a floor that leans 7.16 degrees"} <= set(found)
    assert "not known to the planner" not in key_numbers(result, MUSHR)


def test_the_curves_are_those_of_the_drive(driven: TrialResult) -> None:
    speed, clearance, throttle, steering = panels_of_run(
        DrivenTrajectory.of(driven, MOVABLE.start), MOVABLE.task(), MUSHR
    )
    estimated, planned, true = speed.curves
    assert true.values == pytest.approx([step.speed for step in driven.steps])
    assert estimated.values == pytest.approx([step.estimate[3] for step in driven.steps])
    assert np.isfinite(planned.values).any()
    assert clearance.curves[0].values.min() == pytest.approx(driven.min_clearance, abs=1e-9)
    assert throttle.curves[0].values == pytest.approx([step.command[0] for step in driven.steps])
    assert steering.curves[0].values == pytest.approx([step.command[1] for step in driven.steps])


def test_a_planned_speed_that_is_also_the_estimated_one_stays_visible(driven: TrialResult) -> None:
    speed, *_ = panels_of_run(DrivenTrajectory.of(driven, MOVABLE.start), MOVABLE.task(), MUSHR)
    estimated, planned, true = (curve.style for curve in speed.curves)  # in the order in which they are drawn
    assert estimated["linewidth"] > planned["linewidth"]
    assert estimated["zorder"] <= planned["zorder"] <= true["zorder"]


def test_the_axes_of_commands_end_at_the_bounds_of_the_vehicle(driven: TrialResult) -> None:
    for name, expected in (("mushr", (0.0, 1.0)), ("mushr-drive", (-0.5, 1.0))):
        *_, throttle, steering = panels_of_run(
            DrivenTrajectory.of(driven, MOVABLE.start), MOVABLE.task(), load_vehicle(name)
        )
        assert throttle.limits == expected
        assert steering.limits == (-0.38, 0.38)


def test_the_key_shows_the_camera_as_the_map_does(driven: TrialResult) -> None:
    drive = DrivenTrajectory.of(driven, MOVABLE.start)
    line = driven_line(Frame.around(MOVABLE.bounds), drive, MUSHR.top_speed)
    (camera,) = (entry for entry in _legend_entries(drive, line, ()) if entry.text == "camera")
    assert (camera.kind, camera.colour) == ("dots", OBSERVATION)
    with plot_style():
        figure = _compose(drive, MOVABLE.task(), MUSHR, "title", {}, ())
    dots = [artist for artist in figure.artists + figure.lines if getattr(artist, "get_marker", str)() == "."]
    assert [artist.get_linestyle() for artist in dots] == ["None"]


def test_the_path_has_the_colours_of_its_speed(driven: TrialResult) -> None:
    drive = DrivenTrajectory.of(driven, MOVABLE.start)
    line = driven_line(Frame.around(MOVABLE.bounds), drive, MUSHR.top_speed)
    assert len(line.get_segments()) == len(driven.steps) - 1
    shades = np.asarray(line.get_array())
    assert np.allclose(shades, np.abs(drive.speeds[1:] + drive.speeds[:-1]) / 2)


def test_long_drives_have_fewer_footprints(driven: TrialResult) -> None:
    drive = DrivenTrajectory.of(driven, MOVABLE.start)
    assert run_footprint_interval(drive) == 1
    longer = dataclasses.replace(drive.motion, times=drive.motion.times * 20)
    assert run_footprint_interval(dataclasses.replace(drive, motion=longer)) > 1


def test_the_begin_of_cycles_is_shown_where_the_lines_do_not_merge(driven: TrialResult) -> None:
    shown = []
    for result in (driven, dataclasses.replace(driven, cycles=driven.cycles * 40)):
        drive = DrivenTrajectory.of(driven, MOVABLE.start)
        line = driven_line(Frame.around(MOVABLE.bounds), drive, MUSHR.top_speed)
        entries = _legend_entries(dataclasses.replace(drive, result=result), line, ())
        shown.append("a cycle begins" in {entry.text for entry in entries})
    assert shown == [True, False]


def test_an_unknown_format_is_refused(driven: TrialResult, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.png"):
        plot_run(tmp_path / "a.bmp", MOVABLE.task(), MUSHR, driven)


SHORT = """name: short
bounds: {x: [0, 4], y: [0, 4]}
start: {x: 0.6, y: 1, heading_deg: 0}
goal: {center: [2.0, 1], radius: 0.4}
"""


def test_run_draws_what_it_drove_and_refuses_before_it_drives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("short.yaml").write_text(SHORT)
    assert main(["run", "short.yaml", "--plot", "run.png", "-q"]) == 0
    assert width(Path("run.png")) == 1600
    capsys.readouterr()
    monkeypatch.setenv("MUJOCO_GL", "off")
    assert main(["run", "short.yaml", "--plot", "run.bmp"]) == 2
    assert main(["run", "short.yaml", "--video", "run.avi"]) == 2
    assert main(["run", "short.yaml", "--video", "run.mp4"]) == 3
    err = capsys.readouterr().err
    assert "MUJOCO_GL=off draws nothing" in err
    assert "to goal" not in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.png", "short.yaml"]


@pytest.mark.parametrize("size", [(0.5, 0.5), (1.0, 0.5), (0.5, 1.4)])
def test_the_label_of_a_collision_leaves_the_label_of_the_obstacle_free(
    size: tuple[float, float], driven: TrialResult
) -> None:
    x, y, _ = driven.steps[-1].pose
    offsets = [(0.0, 0.5), (0.0, -0.5), (0.5, 0.0), (-0.5, 0.0)]
    for across, along in offsets:
        center = (x + across * (size[0] + 0.3), y + along * (size[1] + 0.3))
        task = dataclasses.replace(MOVABLE.task(), obstacles=(Box(center, size),))
        result = dataclasses.replace(driven, outcome=Outcome.COLLISION, obstacle="obstacles[0]")
        with plot_style():
            page = _compose(DrivenTrajectory.of(result, MOVABLE.start), task, MUSHR, "title", {}, ())
        FigureCanvasAgg(page).draw()  # type: ignore[no-untyped-call]
        drawn = {text.get_text(): text for text in page.axes[0].texts}
        label = drawn["collision with\nobstacles[0]"].get_bbox_patch()
        assert label is not None
        assert not label.get_window_extent().overlaps(drawn["0"].get_window_extent())


def test_contingencies_are_explained_and_lie_above_the_driven_path(driven: TrialResult) -> None:
    first = driven.cycles[0]
    kind = ReferenceKind.CONTINGENCY
    stopping = dataclasses.replace(first, reference=dataclasses.replace(first.reference, kind=kind))
    result = dataclasses.replace(driven, cycles=(stopping, *driven.cycles[1:]))
    with plot_style():
        drive, notes = DrivenTrajectory.of(result, MOVABLE.start), key_numbers(result, MUSHR)
        figure = _compose(drive, MOVABLE.task(), MUSHR, "title", notes, ())
    assert {"contingency", "a cycle with a contingency begins", "time of contingencies"} <= texts(figure)
    path = next(each for each in figure.axes[0].collections if each.get_array() is not None)
    assert max(line.get_zorder() for line in figure.axes[0].lines if line.is_dashed()) > path.get_zorder()


def test_references_that_nothing_tracks_are_not_drawn_as_plans(driven: TrialResult) -> None:
    pages = []
    for has_plans in (True, False):
        drive = DrivenTrajectory.of(driven, MOVABLE.start, has_plans=has_plans)
        curves = len(panels_of_run(drive, MOVABLE.task(), MUSHR)[0].curves)
        with plot_style():
            figure = _compose(drive, MOVABLE.task(), MUSHR, "title", key_numbers(driven, MUSHR), ())
        pages.append((curves, "planned in each cycle; planned speed" in texts(figure)))
    assert pages == [(3, True), (2, False)]


def test_the_name_of_a_wall_is_turned_where_it_fits_only_so(driven: TrialResult) -> None:
    turns = load_scenario("turns")
    with plot_style():
        drive = DrivenTrajectory.of(driven, turns.start)
        figure = _compose(drive, turns.task(), MUSHR, "title", key_numbers(driven, MUSHR), ())
    turned = {text.get_text() for text in figure.axes[0].texts if text.get_rotation() == 90}
    assert turned == {"near wall", "far wall"}


def test_what_is_not_known_has_the_words_of_a_films_legend(driven: TrialResult) -> None:
    with plot_style():
        drive, notes = DrivenTrajectory.of(driven, MOVABLE.start), key_numbers(driven, MUSHR)
        figure = _compose(drive, MOVABLE.task(), MUSHR, "title", notes, hidden_features(MOVABLE))
    assert {name for name, _ in scene_rows(MOVABLE) if "known" in name} == {"box, not known"} & texts(figure)
