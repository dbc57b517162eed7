"""Recorders of a trial: a film, drawn when the trial is over, single pictures, or a window in real time.

The window is MuJoCo's passive viewer with the drawings of a video.
"""

from __future__ import annotations

import importlib
import io
import itertools
import math
import threading
import time as clock
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import mujoco
import numpy as np
from PIL import Image as Pillow

from kraft.driving.messages import Cycle
from kraft.files import write_whole
from kraft.gl import check_video, check_view, offscreen_context
from kraft.scenario import Bounds
from kraft.simulation.floor_frame import Surface
from kraft.simulation.true_world import TrueWorld, world_of
from kraft.text import MessageSink, no_messages
from kraft.trial.measures import Step
from kraft.trial.result import TrialResult, TrialSpec
from kraft.trial.trial import run_trial
from kraft.video.drawing import Pen, Snapshot, SnapshotRecorder, draw_cycle, draw_snapshot
from kraft.video.overlay import BAND, Overlay, outcome_caption
from kraft.video.renderer import AHEAD, DISTANCE, MIN_ELEVATION, FilmWriter, Image, SceneRenderer

SIZE: Final = (1280, 720)
HOLD: Final = 1.5
"""Duration for which the last picture is shown, s."""
REPORTED: Final = 5.0
"""Time between two messages while a film is drawn, s."""


class VideoRecorder:
    """Records a trial: pass `on_cycle` and `on_step` to `run_trial`, and its result to `finish`.

        with VideoRecorder(Path("drive.mp4"), spec) as film:
            film.finish(run_trial(spec, film.on_cycle, film.on_step, keep_trees=True))

    A second of the film is a second of the trial; `FORMATS` has its formats by the suffix of the path.
    All is drawn by `finish`, so that a vehicle that drives by the clock is not delayed; without it, as when the trial
    is interrupted or fails, no file is left.
    """

    def __init__(self, path: Path, spec: TrialSpec, driver: str | None = None) -> None:
        """Check that a video can be made.

        `driver` names another program that drives, of which neither plans nor estimates are drawn.

        Raises:
            InputError: if the suffix is neither .mp4 nor .webp, or nothing can be written there.
            MissingDependency: if nothing can be drawn without a window here.
        """
        check_video(path)
        self._spec, self._map_width = spec, map_width(spec.scenario.bounds)
        self._gl: Any = offscreen_context(*SIZE)
        self._snapshots = SnapshotRecorder(spec, external=driver is not None)
        self._overlay = Overlay(spec, SIZE, self._map_width, driver)
        self._world: TrueWorld | None = None
        self._frames: list[Snapshot] = []
        self._file = FilmWriter(path, SIZE)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        try:
            self._file.discard()
        finally:
            self._gl.free()

    def on_cycle(self, cycle: Cycle) -> None:
        """For `run_trial`."""
        self._snapshots.on_cycle(cycle)

    def on_step(self, world: TrueWorld, step: Step) -> None:
        """For `run_trial`; keeps what the frames that are due show."""
        self._world = world
        snapshot = self._snapshots.on_step(world, step)
        due = round(world.time * self._file.fps) + 1 - len(self._frames)
        self._frames += [snapshot] * due

    def finish(self, result: TrialResult, report: MessageSink = no_messages) -> None:
        """Draw the film with the outcome at its end, and move the file to its place; `report` receives the progress.

        Raises:
            InputError: if the file cannot be written.
        """
        spec = self._spec
        # a trial that starts in the goal has no tick
        world = self._world or world_of(spec.scenario, spec.vehicle, spec.seed)
        last = self._snapshots.now(world)
        self._gl.make_current()  # a camera that renders has its own context
        renderer = SceneRenderer(world, spec, SIZE, self._map_width, BAND)
        try:
            self._draw(renderer, report)
            picture = self._overlay.over(renderer.picture(last), [*self._frames, last], result)
        finally:
            renderer.close()
        for _ in range(round(HOLD * self._file.fps)):
            self._file.add(picture)
        self._file.finish()

    def _draw(self, renderer: SceneRenderer, report: MessageSink) -> None:
        """Draw the frames of the drive."""
        seconds = len(self._frames) / self._file.fps
        report(f"drawing the film of {seconds:.1f} s ...")
        reported = clock.monotonic()
        began, before = 0.0, 0  # when the first picture, which also sets the drawing up, was drawn, and its frames
        past: list[Snapshot] = []
        for _, equal in itertools.groupby(self._frames, key=id):
            frames = list(equal)
            past.append(frames[0])
            picture = self._overlay.over(renderer.picture(frames[0]), past)
            for _ in frames:
                self._file.add(picture)
            if len(past) == 1:
                began, before = clock.monotonic(), self._file.frames
            if clock.monotonic() > reported + REPORTED:
                reported = clock.monotonic()
                drawn = self._file.frames
                remaining = _remaining(reported - began, drawn - before, len(self._frames) - drawn)
                report(f"  {drawn / self._file.fps:.1f} of {seconds:.1f} s are drawn{remaining}")


def _remaining(elapsed: float, done: int, left: int) -> str:
    """What to say of the time that `left` frames take, of which `done` took `elapsed` s; empty if none was done."""
    return f", about {max(elapsed * left / done, 1.0):.0f} s remain" if done else ""


def map_width(bounds: Bounds) -> int:
    """Width of the map, px: as needed by the scene at full height, less than half the picture; even."""
    short, long = sorted((bounds.x[1] - bounds.x[0], bounds.y[1] - bounds.y[0]))
    wanted = SIZE[1] * (short + 0.24) / (long + 0.24)
    return 2 * round(min(max(wanted, 220), SIZE[0] / 2.4) / 2)


class _StillWritten(Exception):  # noqa: N818 - it ends the drive, nothing is wrong
    pass


def write_still(path: Path, spec: TrialSpec, time: float) -> None:
    """Drive until `time` (s) and write the picture at that time as PNG; nothing if the trial ends before.

    Raises:
        InputError: if the file cannot be written.
        MissingDependency: if nothing can be drawn without a window here.
    """
    side, snapshots = map_width(spec.scenario.bounds), SnapshotRecorder(spec)
    gl = offscreen_context(*SIZE)

    past: list[Snapshot] = []

    def on_step(world: TrueWorld, step: Step) -> None:
        past.append(snapshots.on_step(world, step))
        if world.time >= time - 1e-6:
            gl.make_current()
            renderer = SceneRenderer(world, spec, SIZE, side, BAND)
            write_whole(path, _png(Overlay(spec, SIZE, side).over(renderer.picture(past[-1]), past)))
            renderer.close()
            raise _StillWritten

    try:
        with suppress(_StillWritten):
            run_trial(spec, snapshots.on_cycle, on_step, keep_trees=True)
    finally:
        gl.free()


def _png(picture: Image) -> bytes:
    """PNG with colours rounded to steps of 4 of 255, which makes it smaller without a visible difference."""
    rounded = np.minimum((picture.astype(np.int16) + 2) // 4 * 4, 255).astype(np.uint8)
    content = io.BytesIO()
    Pillow.fromarray(rounded).save(content, "PNG", optimize=True)
    return content.getvalue()


WINDOW_HOLD: Final = 2.0
"""Duration for which the outcome is shown, s."""
MAX_DELAY: Final = 0.05
"""Delay above which a picture is skipped, s, but not ten pictures in a row."""


class LiveView:
    """Shows a trial: pass `on_cycle` and `on_step` to `run_trial`, and its result to `finish`.

    The trial waits for the clock, so that a second of it takes a second.  Input in the window
    does not affect the trial; if the window is closed, the trial continues at full speed.
    """

    def __init__(self, spec: TrialSpec, *, external: bool = False) -> None:
        """Check that there is a screen.

        With `external` another program drives, of which neither plans nor estimates are drawn.

        Raises:
            MissingDependency: if a window cannot be opened.
        """
        check_view()
        self._spec, self._snapshots = spec, SnapshotRecorder(spec, external=external)
        self._window: Any = None
        self._data: Any = None
        self._pen: Pen | None = None
        self._threads: list[threading.Thread] = []
        self._static_geoms, self._cycle = 0, -1
        self._began = self._shown = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._window is not None:
            self._window.close()
            for thread in self._threads:
                thread.join()  # otherwise it would still draw while the process terminates GLFW

    def on_cycle(self, cycle: Cycle) -> None:
        """For `run_trial`."""
        self._snapshots.on_cycle(cycle)

    def on_step(self, world: TrueWorld, step: Step) -> None:
        """For `run_trial`; waits until the world's time and shows it."""
        snapshot = self._snapshots.on_step(world, step)
        if self._window is None:
            self._open(world)
        if self._window.is_running():
            early = self._began + world.time - clock.monotonic()
            clock.sleep(max(0.0, early))
            overdue = clock.monotonic() > self._shown + 10 * MAX_DELAY
            if early > -MAX_DELAY or overdue:  # a slow screen must not slow the trial
                self._show(world, snapshot)
                self._shown = clock.monotonic()

    def finish(self, result: TrialResult, report: MessageSink = no_messages) -> None:
        """Show the outcome for `WINDOW_HOLD` s; nothing is reported."""
        if self._window is not None and self._window.is_running():
            self._window.set_texts(_text(outcome_caption(result)[0], ""))
            self._window.sync()
            clock.sleep(WINDOW_HOLD)

    def _open(self, world: TrueWorld) -> None:
        """Open the window on a copy of the world's state: the viewer writes into what it shows."""
        self._data = mujoco.MjData(world.model)
        mujoco.mj_copyData(self._data, world.model, world.data)
        viewer: Any = importlib.import_module("mujoco.viewer")
        before = set(threading.enumerate())
        self._window = viewer.launch_passive(world.model, self._data, show_left_ui=False, show_right_ui=False)
        self._threads = [thread for thread in threading.enumerate() if thread not in before]
        self._pen = Pen(self._window.user_scn, Surface.of(self._spec.scenario, world.frame))
        with self._window.lock():
            self._window.opt.geomgroup[3] = 0  # what only touches
            camera = self._window.cam
            camera.distance, camera.elevation = DISTANCE, -math.degrees(MIN_ELEVATION)
            camera.azimuth = math.degrees(float(world.pose[2]))
        self._began = clock.monotonic() - world.time

    def _show(self, world: TrueWorld, snapshot: Snapshot) -> None:
        """Draw; the camera moves with the car, and the user chooses its direction."""
        assert self._pen is not None, "it is made with the window"
        x, y, theta = snapshot.pose
        ahead = np.array([x + AHEAD * math.cos(theta), y + AHEAD * math.sin(theta), 0.08])
        with self._window.lock():
            mujoco.mj_copyData(self._data, world.model, world.data)
            scene = self._window.user_scn
            scene.ngeom = self._static_geoms
            if snapshot.cycle is not None and snapshot.cycle.number != self._cycle:
                scene.ngeom, self._cycle = 0, snapshot.cycle.number
                draw_cycle(self._pen, snapshot.cycle, self._spec.vehicle)
                self._static_geoms = scene.ngeom
            draw_snapshot(self._pen, snapshot, self._spec.vehicle)
            self._window.cam.lookat[:] = world.frame.to_world(ahead)
        self._window.set_texts(_state(snapshot))
        self._window.sync()


def _state(snapshot: Snapshot) -> Any:
    rows = [
        ("time", f"{snapshot.time:.1f} s"),
        ("speed", f"{snapshot.speed:.2f} m/s"),
        ("clearance", f"{100 * max(snapshot.clearance, 0.0):.0f} cm"),
    ]
    if snapshot.cycle is not None:
        rows.append((str(snapshot.cycle.kind), snapshot.cycle.reason or " "))
    return _text("\n".join(name for name, _ in rows), "\n".join(value for _, value in rows))


def _text(left: str, right: str) -> Any:
    return mujoco.mjtFontScale.mjFONTSCALE_150, mujoco.mjtGridPos.mjGRID_TOPLEFT, left, right
