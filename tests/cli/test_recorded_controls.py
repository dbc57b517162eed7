"""`kraft sysid` of logs of other controls than those of a car says which model to name, and counts logs, not files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from kraft_cli.main import main


def recorded(folder: Path, controls: str, vehicle: str | None) -> None:
    """A log of 2 s with two commands; with a manifest as `kraft record` writes it for a named `vehicle`."""
    folder.mkdir(parents=True)
    rows = [f"{0.1 * k:.1f},0.5,0.1" for k in range(20)]
    (folder / "commands.csv").write_text("\n".join([f"t,{controls}", *rows]), encoding="utf-8")
    poses = [f"{0.1 * k:.1f},{0.05 * k:.2f},0,0" for k in range(20)]
    (folder / "poses.csv").write_text("\n".join(["t,x,y,yaw", *poses]), encoding="utf-8")
    if vehicle is not None:
        manifest = {"schema": "kraft.record/1", "arguments": {"vehicle": vehicle}, "vehicle": {"name": "boat"}}
        (folder / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")


def test_recorded_logs_of_other_controls_name_the_model_that_drove(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for k in (1, 2, 3):
        recorded(tmp_path / "logs" / f"run_0{k}", "thrust,rudder", "boat.py:BOAT")
    assert main(["sysid", "logs"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == (
        "logs/run_01: is the first of 3 logs with the controls thrust, rudder; the vehicle to identify has throttle, "
        "steering; expected --model boat.py:BOAT, the vehicle that drove"
    )
    recorded(tmp_path / "logs" / "run_04", "ahead,turn", "sled.py:SLED")
    assert main(["sysid", "logs"]) == 2
    assert capsys.readouterr().err.endswith("expected logs of one vehicle, which --model names\n")


def test_other_logs_of_other_controls_are_counted_and_a_model_is_suggested(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for k in (1, 2, 3):
        recorded(tmp_path / "logs" / f"run_0{k}", "thrust,rudder", None)
    assert main(["sysid", "logs"]) == 1
    error = capsys.readouterr().err
    assert "none of the 3 logs can be used" in error
    assert "for a vehicle with other controls, name its model with --model" in error
    assert main(["sysid", "logs", "--model", "mushr"]) == 1
    assert "name its model" not in capsys.readouterr().err
