"""Folder of a recorded run: commands, measured poses, true poses and a manifest.

LOGS/run_01/commands.csv    t, throttle, steering, or other controls: t is the time at which the command was sent
LOGS/run_01/poses.csv       t, x, y, yaw: t is the time at which the frame was taken, by the camera's clock
LOGS/run_01/truth.csv       t, x, y, yaw, speed: for comparison; identification never opens it
LOGS/run_01/manifest.json   manoeuvre, start, scenario, seed, versions
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Final

from kraft.errors import Code, InputError
from kraft.files import check_writable, new_folder, write_csv, write_json
from kraft.provenance import SIMULATION, plain, plain_hash, versions
from kraft.recording.recorder import Recording
from kraft.scenario import Scenario

SCHEMA: Final = "kraft.record/1"
POSES: Final = ("t", "x", "y", "yaw")
TRUTH: Final = ("t", "x", "y", "yaw", "speed")
UNITS: Final = {
    "t": "s", "throttle": "1", "steering": "rad", "x": "m", "y": "m", "yaw": "rad", "speed": "m/s",
}  # fmt: skip
"""Units of the columns; controls of other vehicles than cars have those of their model."""


def check_log_folder(folder: Path) -> None:
    """Check that a new folder of logs can be created.

    Raises:
        InputError: if the folder exists or cannot be written.
    """
    if os.path.lexists(folder):
        raise InputError.of(str(folder), "is there already", "expected a new folder for the logs", Code.EXISTS)
    check_writable(folder)


def write_recording(folder: Path, scenario: Scenario, arguments: Mapping[str, Any], recording: Recording) -> Path:
    """Write a run into its own new folder in `folder`, in one step, and return that folder.

    Raises:
        InputError: if the run cannot be written.
    """
    final = folder / f"run_{recording.number:02d}"
    with new_folder(final) as temporary:
        write_csv(temporary / "commands.csv", ("t", *recording.controls), recording.commands.tolist())
        write_csv(temporary / "poses.csv", POSES, recording.poses.tolist())
        write_csv(temporary / "truth.csv", TRUTH, recording.truth.tolist())
        write_json(temporary / "manifest.json", _manifest(scenario, arguments, recording))
    return final


def _manifest(scenario: Scenario, arguments: Mapping[str, Any], recording: Recording) -> dict[str, Any]:
    """Content of the manifest: everything that repeating the run needs, and no time of day."""
    start = recording.place.start
    described = {f.name: plain(getattr(scenario, f.name)) for f in fields(scenario) if f.compare}
    return {
        "schema": SCHEMA,
        "arguments": dict(arguments),
        "run": recording.number,
        "manoeuvre": recording.manoeuvre.name,
        "start": {"x": start.x, "y": start.y, "heading": start.heading},
        "end": recording.end,
        "note": recording.note,
        "commands": len(recording.commands),
        "poses": len(recording.poses),
        "units": UNITS,
        "clock": "both files count from the beginning of the run; a pose carries the time its frame was taken",
        "scenario": {"sha256": plain_hash(described), "content": described},
        "versions": versions(SIMULATION),
    }
