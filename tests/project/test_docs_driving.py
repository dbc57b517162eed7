"""The page on driving names every setting with its real default, the bundled methods, and the noise in the code."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from support.paths import ROOT

from kraft.config import bundled
from kraft.driving.method import Clearance, Filter, Geometric, Kinodynamic, Method, PlannerSettings, load_method
from kraft.scenario import Sensing
from kraft.simulation.noise import PRESETS

TEXT = (ROOT / "docs" / "driving.md").read_text(encoding="utf-8")


def documented() -> dict[str, str]:
    """Setting and default of every row of a table of settings."""
    found = {}
    for row in re.findall(r"^\| (`\w+`.*?) \| (.*?) \|", TEXT, re.MULTILINE):
        names = re.findall(r"`(\w+)`", row[0])
        values = [row[1]] if len(names) == 1 else row[1].split(", ")
        found.update(zip(names, values, strict=False))
    return found


def shown(field: FieldInfo) -> set[str]:
    """How a default may be written."""
    if field.is_required():
        return {"required"}
    default = list(field.default) if isinstance(field.default, tuple) else field.default
    words = {"None": "none", "False": "false"}
    return {words.get(str(default), str(default)), f"{default:g}" if isinstance(default, float) else "?"}


@pytest.mark.parametrize("model", [PlannerSettings, Clearance, Filter, Geometric, Kinodynamic])
def test_every_setting_is_documented_with_its_default(model: type[BaseModel]) -> None:
    for name, field in model.model_fields.items():
        if name not in ("kind", "rate_hz"):
            assert documented()[name] in shown(field), name


def test_every_key_of_a_method_file_is_mentioned() -> None:
    assert [name for name in Method.model_fields if f"`{name}`" not in TEXT] == []


def test_the_method_shown_is_the_bundled_one(tmp_path: Path) -> None:
    (tmp_path / "shown.yaml").write_text(TEXT.split("```yaml\n")[1].split("```")[0])
    assert load_method(tmp_path / "shown.yaml").model_dump() == load_method("conservative-kraft").model_dump()


def test_the_table_of_methods_is_the_bundled_ones() -> None:
    rows = re.findall(r"^\| `([\w-]+)` \| ((?:one-shot|replanning) .*) \|$", TEXT, re.MULTILINE)
    assert sorted(name for name, _ in rows) == sorted(bundled.names("method"))
    for name, row in rows:
        method = load_method(name)
        planner, safety = method.planner, method.planner.safety
        clearance = f"{safety.delta:g} + {safety.delta_per_speed:g} v" if safety else "none"
        expected = [
            planner.mode, planner.vehicle or "the scenario's", f"{planner.margin:g}", clearance, method.controller.kind,
            method.estimator.kind,
        ]  # fmt: skip
        assert row.split(" | ") == expected
        once = planner.mode == "one-shot"
        assert (planner.iterations, planner.goal_margin) == ((20_000, 0.0) if once else (1000, 0.1))
        assert planner.recover == (safety is not None and safety.foresight == 3.0)


def test_every_setting_of_the_camera_is_mentioned() -> None:
    ours = set(Sensing.model_fields) - {"preset"}
    assert all(f"`{name}`" in TEXT for name in ours)


def test_the_table_of_noise_is_the_one_in_the_code() -> None:
    noise = PRESETS["single-tag"]
    row = next(line for line in TEXT.splitlines() if line.startswith("| `single-tag`"))
    places = (4.8, 0.0), (5.6, math.radians(30.0))
    expected = [1000 * model.size.at(*place) for model in (noise.along, noise.across) for place in places]
    expected += [math.degrees(noise.heading.size.at(*place)) for place in places] + [100 * noise.dropout]
    assert [float(number) for number in re.findall(r"([\d.]+) (?:mm|deg|%)", row)] == pytest.approx(expected, abs=0.051)
