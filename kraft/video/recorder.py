"""Film of one trial, and single pictures of it."""

from __future__ import annotations

import io
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from PIL import Image as Pillow

from kraft.driving.messages import Cycle
from kraft.files import write_whole
from kraft.gl import check_video, offscreen_context
from kraft.scenario import Bounds
from kraft.simulation.true_world import TrueWorld
from kraft.trial.measures import Step
from kraft.trial.result import TrialResult, TrialSpec
from kraft.trial.trial import run_trial
from kraft.video.drawing import SnapshotRecorder
from kraft.video.overlay import BAND, Overlay
from kraft.video.renderer import FilmWriter, Image, SceneRenderer

SIZE: Final = (1280, 720)
HOLD: Final = 1.5
"""Duration for which the last picture is shown, s."""


class VideoRecorder:
    """Records a trial: pass `on_cycle` and `on_step` to `run_trial`, and its result to `finish`.

        with VideoRecorder(Path("drive.mp4"), spec) as film:
            film.finish(run_trial(spec, film.on_cycle, film.on_step, keep_trees=True))

    A second of the film is a second of the trial; `FORMATS` has its formats by the suffix of the path.
    Without `finish`, as when the trial is interrupted or fails, no file is left.
    """

    def __init__(self, path: Path, spec: TrialSpec) -> None:
        """Check that a video can be made.

        Raises:
            InputError: if the suffix is neither .mp4 nor .webp, or nothing can be written there.
            MissingDependency: if nothing can be drawn without a window here.
        """
        check_video(path)
        self._spec, self._map_width = spec, map_width(spec.scenario.bounds)
        self._gl: Any = offscreen_context(*SIZE)
        self._snapshots = SnapshotRecorder(spec)
        self._overlay = Overlay(spec, SIZE, self._map_width)
        self._renderer: SceneRenderer | None = None
        self._world: TrueWorld | None = None
        self._file = FilmWriter(path, SIZE)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._file.discard()
        self._gl.make_current()
        if self._renderer is not None:
            self._renderer.close()
        self._gl.free()

    def on_cycle(self, cycle: Cycle) -> None:
        """For `run_trial`."""
        self._snapshots.on_cycle(cycle)

    def on_step(self, world: TrueWorld, step: Step) -> None:
        """For `run_trial`; adds a picture of the world if a frame is due."""
        self._gl.make_current()  # a camera that renders has its own context
        if self._renderer is None:
            self._renderer, self._world = SceneRenderer(world, self._spec, SIZE, self._map_width, BAND), world
        snapshot = self._snapshots.on_step(world, step)
        due = round(world.time * self._file.fps) + 1 - self._file.frames
        if due > 0:
            picture = self._overlay.over(self._renderer.picture(snapshot), snapshot)
            for _ in range(due):
                self._file.add(picture)

    def finish(self, result: TrialResult) -> None:
        """Add the outcome, and move the file to its place.

        Raises:
            InputError: if the file cannot be written.
        """
        assert self._renderer is not None, "a trial has at least one tick"
        assert self._world is not None, "a trial has at least one tick"
        snapshot = self._snapshots.now(self._world)
        self._gl.make_current()
        picture = self._overlay.over(self._renderer.picture(snapshot), snapshot, result)
        for _ in range(round(HOLD * self._file.fps)):
            self._file.add(picture)
        self._file.finish()


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

    def on_step(world: TrueWorld, step: Step) -> None:
        snapshot = snapshots.on_step(world, step)
        if world.time >= time - 1e-6:
            gl.make_current()
            renderer = SceneRenderer(world, spec, SIZE, side, BAND)
            write_whole(path, _png(Overlay(spec, SIZE, side).over(renderer.picture(snapshot), snapshot)))
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
