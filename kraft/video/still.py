"""One picture of a drive, as the film would show it."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image as Pillow

from kraft.files import write_whole
from kraft.simulation.world import World
from kraft.trial.result import Step, TrialSpec
from kraft.trial.trial import run_trial
from kraft.video.gl import offscreen_context
from kraft.video.moment import Chronicle
from kraft.video.mp4 import Image
from kraft.video.overlay import BAND, Overlay
from kraft.video.recorder import SIZE, map_width
from kraft.video.stage import Stage


class _Taken(Exception):  # noqa: N818 - it ends the drive, nothing is wrong
    pass


def write_still(path: Path, spec: TrialSpec, time: float) -> None:
    """Drive until `time` (s) and write what is to be seen then, as PNG; nothing if the trial ends before.

    Raises:
        InputError: if the file cannot be written.
        MissingDependency: if nothing can be drawn without a window here.
    """
    side, chronicle = map_width(spec.scenario.bounds), Chronicle(spec)
    gl = offscreen_context(*SIZE)

    def look(world: World, step: Step) -> None:
        moment = chronicle.on_step(world, step)
        if world.time >= time - 1e-6:
            stage = Stage(world, spec, SIZE, side, BAND)
            write_whole(path, _png(Overlay(spec, SIZE, side).over(stage.picture(moment), moment)))
            stage.close()
            raise _Taken

    try:
        run_trial(spec, chronicle.on_cycle, look, keep_trees=True)
    except _Taken:
        pass
    finally:
        gl.free()


def _png(picture: Image) -> bytes:
    """In colours rounded to steps of 4 of 255: smaller, and the eye sees no difference."""
    rounded = np.minimum((picture.astype(np.int16) + 2) // 4 * 4, 255).astype(np.uint8)
    content = io.BytesIO()
    Pillow.fromarray(rounded).save(content, "PNG", optimize=True)
    return content.getvalue()
