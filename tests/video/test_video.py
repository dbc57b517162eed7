"""Films of trials: complete or not there, in the trial's time, and without any influence on it."""

from __future__ import annotations

import dataclasses
import importlib
import os
import re
import subprocess
import sys
from ctypes.util import find_library
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image as Pillow
from PIL import ImageSequence
from support.messages import without_loading
from support.paths import ROOT

from kraft.driving.method import load_method
from kraft.errors import InputError, MissingDependency
from kraft.gl import check_video, check_view, offscreen_context
from kraft.scenario import Scenario, load_scenario
from kraft.simulation.world import World
from kraft.trial.measures import Step
from kraft.trial.result import Outcome, TrialResult, TrialSpec
from kraft.trial.trial import run_trial
from kraft.vehicles.load import load_vehicle
from kraft.video.drawing import ESTIMATE, FAILURE, PLAN, Snapshot, SnapshotRecorder
from kraft.video.legend import scene_rows
from kraft.video.overlay import BAND, Overlay
from kraft.video.recorder import HOLD, SIZE, VideoRecorder, map_width, write_still
from kraft.video.renderer import FORMATS, FilmWriter, Image, SceneRenderer, smoothed
from kraft.video.type import font, wrapped

FPS = FORMATS[".mp4"].fps
SECONDS = 0.4


@pytest.fixture(scope="module")
def drawing() -> None:
    """Skips where neither EGL nor OSMesa can draw."""
    try:
        offscreen_context(16, 16).free()
    except MissingDependency as error:
        pytest.skip(f"nothing can be drawn on this machine: {error}")


def short_trial() -> TrialSpec:
    """A drive on the leaning floor that is over at once."""
    scenario = load_scenario("slope")
    short = scenario.trial.model_copy(update={"timeout": SECONDS})
    return TrialSpec(
        dataclasses.replace(scenario, trial=short), load_method("conservative-kraft"), load_vehicle("mushr"), 3
    )


@pytest.fixture(scope="module")
def video(drawing: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TrialResult]:
    path = tmp_path_factory.mktemp("films") / "short.mp4"
    with VideoRecorder(path, spec := short_trial()) as recorder:
        result = run_trial(spec, recorder.on_cycle, recorder.on_step, keep_trees=True)
        recorder.finish(result)
    return path, result


def pictures(path: Path) -> list[Image]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def share_of(colour: str, picture: Image) -> float:
    wanted = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)])
    return float((np.abs(picture.astype(int) - wanted).max(axis=-1) < 25).mean())


def test_a_second_of_the_video_is_a_second_of_the_trial(video: tuple[Path, TrialResult]) -> None:
    with av.open(str(video[0])) as container:
        stream = container.streams.video[0]
        assert stream.average_rate == FPS
        coding = stream.codec_context
        assert (coding.name, coding.pix_fmt, coding.width, coding.height) == ("h264", "yuv420p", *SIZE)
        assert int(coding.colorspace) == 1  # BT.709, as players expect
        assert float(stream.duration * stream.time_base) == pytest.approx(SECONDS + HOLD, abs=0.04)
    assert len(pictures(video[0])) == round((SECONDS + HOLD) * FPS)


def test_the_video_of_the_documentation_can_be_made(
    drawing: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (ROOT / "docs" / "run.md").read_text(encoding="utf-8")
    block = text.split("```python\n")[1].split("```")[0]
    monkeypatch.chdir(tmp_path)
    spec = short_trial()
    monkeypatch.setattr("kraft.scenario.load_scenario", lambda _: spec.scenario)
    exec(block, {})  # the block's own names and no others
    assert len(pictures(tmp_path / "bump.mp4")) == round((SECONDS + HOLD) * FPS)


def test_the_last_picture_says_how_it_ended(video: tuple[Path, TrialResult]) -> None:
    first, *_, last = pictures(video[0])
    assert video[1].outcome is Outcome.TIMEOUT
    assert share_of(FAILURE, first) < 0.001
    assert share_of(FAILURE, last) > 0.02


def test_nothing_is_drawn_while_the_vehicle_drives(
    drawing: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[float] = []
    picture = SceneRenderer.picture

    def noted(self: SceneRenderer, snapshot: Snapshot) -> Image:
        drawn.append(snapshot.time)
        return picture(self, snapshot)

    monkeypatch.setattr(SceneRenderer, "picture", noted)
    with VideoRecorder(tmp_path / "short.mp4", spec := short_trial()) as recorder:
        result = run_trial(spec, recorder.on_cycle, recorder.on_step, keep_trees=True)
        assert drawn == []
        messages: list[str] = []
        recorder.finish(result, messages.append)
    assert drawn[0] == 0.0
    assert drawn[-1] == pytest.approx(SECONDS)
    assert (np.diff(drawn) >= 0.0).all()
    assert messages[0] == f"drawing the film of {SECONDS:.1f} s ..."


def test_a_film_of_another_programs_drive_shows_neither_plans_nor_estimates(drawing: None, tmp_path: Path) -> None:
    with VideoRecorder(tmp_path / "short.mp4", spec := short_trial(), driver="simulated robot") as recorder:
        result = run_trial(spec, lambda _: None, recorder.on_step)
        recorder.finish(result)
    with VideoRecorder(tmp_path / "known.mp4", spec) as recorder:
        recorder.finish(run_trial(spec, recorder.on_cycle, recorder.on_step))
    unknown, known = pictures(tmp_path / "short.mp4")[6], pictures(tmp_path / "known.mp4")[6]
    assert share_of(ESTIMATE, unknown) < 0.2 * share_of(ESTIMATE, known)
    assert share_of(PLAN, unknown) < 0.2 * share_of(PLAN, known)


def test_a_contact_is_drawn_from_its_time_on() -> None:
    scenario = load_scenario("turns")
    world = World(scenario)
    snapshots = SnapshotRecorder(TrialSpec(scenario, load_method("kraft"), load_vehicle("mushr"), 0))
    before = snapshots.now(world)
    world.apply([float(name == "throttle") for name in world.controls])
    while world.collision is None:
        world.step(25)
    after = snapshots.now(world)
    assert before.contact is None
    assert after.contact == world.collision.point
    assert np.array_equal(after.configuration, world.data.qpos)
    assert not np.array_equal(before.configuration, after.configuration)


def test_a_trial_that_ends_at_its_start_is_a_film_of_its_outcome(drawing: None, tmp_path: Path) -> None:
    spec = short_trial()
    start = spec.scenario.start
    goal = dataclasses.replace(spec.scenario.goal, center=(start.x, start.y))
    spec = dataclasses.replace(spec, scenario=dataclasses.replace(spec.scenario, goal=goal))
    with VideoRecorder(tmp_path / "short.mp4", spec) as recorder:
        result = run_trial(spec, recorder.on_cycle, recorder.on_step, keep_trees=True)
        recorder.finish(result)
    assert (result.outcome, result.steps) == (Outcome.SUCCESS, ())
    assert len(pictures(tmp_path / "short.mp4")) == round(HOLD * FPS)


def test_both_views_show_scene_car_and_plan(video: tuple[Path, TrialResult]) -> None:
    last = pictures(video[0])[-1]
    edge = SIZE[0] - map_width(load_scenario("slope").bounds)
    for view in (last[:, :edge], last[:, edge:]):
        assert view.std() > 20
        red = (view[..., 0] > 150) & (view[..., 1] < 90) & (view[..., 2] < 70)
        assert red.mean() > 0.001, "no car to be seen"


def test_recording_a_video_changes_nothing(video: tuple[Path, TrialResult]) -> None:
    alone = run_trial(short_trial())
    assert [step.pose for step in alone.steps] == [step.pose for step in video[1].steps]
    assert [cycle.kind for cycle in alone.cycles] == [cycle.kind for cycle in video[1].cycles]


def test_an_interrupted_video_leaves_the_old_file(drawing: None, tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(b"before")

    def drive() -> None:
        with VideoRecorder(path, spec := short_trial()) as recorder:

            def stop(world: World, step: Step) -> None:
                recorder.on_step(world, step)
                if step.time > 0.1:
                    raise KeyboardInterrupt

            run_trial(spec, recorder.on_cycle, stop)

    with pytest.raises(KeyboardInterrupt):
        drive()
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("a.mp4", b"before")]


def test_a_file_is_there_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.mp4"
    writer = FilmWriter(path, (64, 48))
    for shade in (0, 128, 255):
        writer.add(np.full((48, 64, 3), shade, np.uint8))
    assert not path.exists()
    writer.finish()
    writer.discard()
    assert [round(float(picture.mean()), -1) for picture in pictures(path)] == [0, 130, 260]
    assert [file.name for file in path.parent.iterdir()] == ["a.mp4"]
    assert path.stat().st_mode & 0o444 == 0o444


def test_a_film_for_pages_is_small_and_repeats(tmp_path: Path) -> None:
    path = tmp_path / "a.webp"
    writer = FilmWriter(path, (128, 64))
    for shade in (0, 60, 120, 180, 240):
        writer.add(np.full((64, 128, 3), shade, np.uint8))
    writer.finish()
    with Pillow.open(path) as film:
        assert (film.format, film.size, film.n_frames, film.info["loop"]) == ("WEBP", (64, 32), 5, 0)
        shades, durations = [], []
        for frame in ImageSequence.Iterator(film):
            shades.append(float(np.asarray(frame.convert("RGB")).mean()))
            durations.append(film.info["duration"])
    assert shades == pytest.approx([0, 60, 120, 180, 240], abs=4)
    assert durations == [1000 / FORMATS[".webp"].fps] * 5


@pytest.mark.parametrize("name", ["a.avi", "a", "file/a.mp4", "folder.mp4"])
def test_what_cannot_be_a_video_is_refused_before_the_drive(name: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder.mp4").mkdir()
    with pytest.raises(InputError):
        check_video(tmp_path / name)


def test_without_opengl_it_is_said_what_to_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MUJOCO_GL", "disable")
    with pytest.raises(MissingDependency, match="MUJOCO_GL=disable draws nothing; unset it"):
        check_video(tmp_path / "a.mp4")
    monkeypatch.delenv("MUJOCO_GL")

    def missing(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(MissingDependency, match=r"libegl1 libgl1-mesa-dri.*MUJOCO_GL=osmesa"):
        check_video(tmp_path / "a.mp4")


@pytest.mark.parametrize("backend", ["glfw", "osmesa", "foo"])
def test_an_unusable_backend_is_reported_in_one_line_before_the_drive(backend: str, tmp_path: Path) -> None:
    """Each in a process of its own: MuJoCo takes MUJOCO_GL when it is loaded."""
    hidden = {name: text for name, text in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environment = {**hidden, "MUJOCO_GL": backend, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    done = subprocess.run(
        [sys.executable, "-m", "kraft_cli", "run", "turns", "--video", "a.mp4"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if backend == "osmesa" and find_library("OSMesa") is not None:
        pytest.skip("OSMesa is installed")
    assert (done.returncode, done.stdout) == (3, "")
    (line,) = without_loading(done.stderr).splitlines()
    assert line.startswith("error: a video needs OpenGL without a window: ")
    assert "nset" in line
    assert list(tmp_path.iterdir()) == []


def test_a_window_needs_a_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(MissingDependency, match="needs a screen"):
        check_view()


def test_the_map_is_as_wide_as_the_scene_needs() -> None:
    tall: Scenario = load_scenario("turns")
    wide = tall.bounds.model_copy(update={"x": tall.bounds.y, "y": tall.bounds.x})
    square = tall.bounds.model_copy(update={"x": (0.0, 9.0), "y": (0.0, 9.0)})
    assert map_width(tall.bounds) == map_width(wide) == pytest.approx(272, abs=4)
    assert map_width(square) < SIZE[0] / 2
    assert map_width(square) % 2 == 0


def test_only_edges_are_smoothed() -> None:
    rng = np.random.default_rng(0)
    flat = np.full((40, 40, 3), 90, np.uint8) + rng.integers(0, 4, (40, 40, 1), np.uint8)
    assert np.array_equal(smoothed(flat), flat)
    rows, columns = np.mgrid[:40, :40]
    stairs = np.where((columns > rows / 3)[..., None], np.uint8(220), np.uint8(30)).repeat(3, axis=2)
    blurred = smoothed(stairs).astype(int)
    changed = (blurred != stairs).any(axis=-1)
    assert changed.any()
    assert (np.abs(columns - rows / 3)[changed] < 3).all()
    assert blurred.min() >= 30
    assert blurred.max() <= 220


def test_long_reasons_are_cut_to_their_lines() -> None:
    assert wrapped("", 13, 100, 2) == []
    assert wrapped("short", 13, 100, 2) == ["short"]
    lines = wrapped("from the latest estimate no manoeuvre stops safely after the plan " * 3, 13, 300, 2)
    assert len(lines) == 2
    assert lines[1].endswith("…")
    assert all(font(13).getlength(line) <= 300 for line in lines)
    assert wrapped("w" * 200, 13, 100, 1)[0].endswith("…")


def test_a_still_is_a_picture_of_the_video(video: tuple[Path, TrialResult], tmp_path: Path) -> None:
    write_still(tmp_path / "a.png", short_trial(), 0.2)
    with Pillow.open(tmp_path / "a.png") as picture:
        still = np.asarray(picture).astype(int)
    assert np.abs(still - pictures(video[0])[6]).mean() < 6


@pytest.mark.parametrize(("name", "turned"), [("track", True), ("turns", False)])
def test_a_map_that_is_turned_says_so(name: str, turned: bool) -> None:
    spec = TrialSpec.load(name)
    side = map_width(spec.scenario.bounds)
    snapshot = Snapshot(0.0, np.zeros(3), 0.0, None, 1.0, None, np.zeros((2, 3)), np.zeros(1), None)
    picture = Overlay(spec, SIZE, side).over(np.full((SIZE[1], SIZE[0], 3), 128, np.uint8), [snapshot])
    foot_of_map = picture[-40:, SIZE[0] - side + 2 :]
    assert bool((foot_of_map != 128).any()) is turned


@pytest.mark.parametrize(
    ("name", "things"),
    [
        ("movable", {"goal", "wall", "obstacle", "box, not known"}),
        ("bump", {"goal", "wall", "obstacle", "bump, not known"}),
        ("slip", {"goal", "wall", "obstacle", "other friction, not known"}),
    ],
)
def test_the_legend_has_the_kinds_of_things_of_the_scene(name: str, things: set[str]) -> None:
    assert {row for row, _ in scene_rows(load_scenario(name))} == things


def foot_of(snapshots: list[Snapshot]) -> Image:
    """The band at the foot of a picture with these snapshots, right of the state, without the edge of the map."""
    spec = TrialSpec.load("turns")
    side = map_width(spec.scenario.bounds)
    picture = Overlay(spec, SIZE, side).over(np.full((SIZE[1], SIZE[0], 3), 128, np.uint8), snapshots)
    return picture[-BAND:, SIZE[0] // 2 : SIZE[0] - side - 2]


def test_the_foot_of_a_film_shows_the_speeds_so_far() -> None:
    at = [Snapshot(t, np.zeros(3), t / 10.0, None, 1.0, None, np.zeros((2, 3)), np.zeros(1), None) for t in (0.0, 5.0)]
    alone, both = foot_of([at[1]]), foot_of(at)
    changed = np.argwhere((alone != both).any(axis=2))
    assert len(changed) > 100
    rows, columns = changed.T
    assert columns.max() < 0.75 * both.shape[1], "half of the ten seconds have passed"
    lowest, highest = rows[np.argmin(columns)], rows[np.argmax(columns)]
    assert lowest > highest, "the car got faster"


def test_what_remains_to_be_drawn_is_told(drawing: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kraft.video.recorder.REPORTED", 0.0)
    said: list[str] = []
    with VideoRecorder(tmp_path / "a.mp4", spec := short_trial()) as recorder:
        recorder.finish(run_trial(spec, recorder.on_cycle, recorder.on_step), said.append)
    assert said[0].startswith("drawing the film of 0.4 s")
    assert said[2:]
    assert re.fullmatch(r"  0\.\d of 0\.4 s are drawn", said[1]), "the first picture, which takes longer, tells no pace"
    assert all(re.fullmatch(r"  0\.\d of 0\.4 s are drawn, about \d+ s remain", line) for line in said[2:])
