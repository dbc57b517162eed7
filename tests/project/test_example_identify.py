"""The script that makes the bundled numbers does what `kraft record` and `kraft sysid` do, and writes only if asked to."""

from __future__ import annotations

import re
import runpy
import shutil
import sys
from pathlib import Path

import pytest
from support.paths import ROOT
from support.recorded import SEED, recorded_logs

from kraft.config import bundled
from kraft.plot import sysid as pages
from kraft.vehicles.config import load_vehicle_config
from kraft_cli.main import main
from kraft_cli.work import record as record_module
from kraft_cli.work.record import RecordRequest

SCRIPT = ROOT / "examples" / "07_bundled_vehicles.py"
MODELS = ("mushr", "mushr-lag", "mushr-drive")
RUNS = 4
"""Fewer than the tests have recorded; a run depends on its number and the seed alone."""


def run(folder: Path, monkeypatch: pytest.MonkeyPatch, *options: str) -> int:
    monkeypatch.setattr(
        sys, "argv", [str(SCRIPT), "--out", str(folder), "--runs", str(RUNS), "--seed", str(SEED), *options]
    )
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(SCRIPT), run_name="__main__")
    return int(ended.value.code or 0)


def test_it_identifies_three_models_as_the_commands_do(
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = {name: (bundled.folder("vehicle") / f"{name}.yaml").read_bytes() for name in MODELS}
    assert run(tmp_path / "all", monkeypatch) == 0
    told = capsys.readouterr().out
    assert "mushr-drive:" in told
    # columns are as wide as what stands in them
    heading = r"^    PARAMETER  VALUE {2,5}95 % INTERVAL \(graph\) {2,6}INITIAL {2,3}UNIT  MEANING$"
    assert len(re.findall(heading, told, re.M)) == 3
    assert len(re.findall(r"^    OPEN LOOP, held-out logs {2,4}1 s {5,8}2 s", told, re.M)) == 3
    assert all((tmp_path / "all" / f"{name}.png").stat().st_size > 50_000 for name in MODELS)
    assert {name: (bundled.folder("vehicle") / f"{name}.yaml").read_bytes() for name in MODELS} == before
    monkeypatch.chdir(tmp_path)
    recorded = sorted((tmp_path / "all" / "logs").glob("run_*/*.csv"))
    assert len({path.parent for path in recorded}) == RUNS
    for path in recorded:
        assert path.read_bytes() == (recorded_logs(tmp_path_factory) / path.parent.name / path.name).read_bytes()
    shutil.copytree(tmp_path / "all" / "logs", tmp_path / "logs")
    assert main(["sysid", "logs", "--model", "mushr-lag", "--extras", "none", "--out", "mushr-lag.yaml", "-q"]) == 0
    assert (tmp_path / "mushr-lag.yaml").read_bytes() == (tmp_path / "all" / "mushr-lag.yaml").read_bytes()


def test_what_it_bundles_keeps_head_name_bounds_and_priors(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With logs that are there already, and without pages: the other test records and draws."""
    logs = recorded_logs(tmp_path_factory)

    def record_logs(asked: RecordRequest, *_: object) -> None:
        for number in range(1, asked.runs + 1):
            shutil.copytree(logs / f"run_{number:02d}", asked.out / f"run_{number:02d}")

    monkeypatch.setattr(record_module, "record_logs", record_logs)
    monkeypatch.setattr(pages, "plot_identification", lambda *_: None)
    for name in MODELS:
        (tmp_path / f"{name}.yaml").write_bytes((bundled.folder("vehicle") / f"{name}.yaml").read_bytes())
    before = {name: load_vehicle_config(tmp_path / f"{name}.yaml") for name in MODELS}
    real = bundled.folder
    monkeypatch.setattr(bundled, "folder", lambda kind: tmp_path if kind == "vehicle" else real(kind))
    assert run(tmp_path / "all", monkeypatch, "--write") == 0
    for name in MODELS:
        lines = (tmp_path / f"{name}.yaml").read_text().splitlines()
        assert lines[0] == "# yaml-language-server: $schema=vehicle.schema.json"
        after = load_vehicle_config(tmp_path / f"{name}.yaml")
        assert (after.name, after.description, after.footprint, after.model) == (
            before[name].name, before[name].description, before[name].footprint, before[name].model,
        )  # fmt: skip
        assert after.identification is not None
        assert after.values != before[name].values
        for symbol, parameter in after.parameters.items():
            old = before[name].parameters[symbol]
            assert (parameter.min, parameter.max, parameter.std) == (old.min, old.max, old.std)
