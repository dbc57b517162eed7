"""The page on driving names every setting with its real default, and the noise as it is in the code."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
from pydantic import BaseModel

from kraft.method import Filter, Geometric, Kinodynamic
from kraft.scenario import Sensing
from kraft.simulation.noise import PRESETS

TEXT = (Path(__file__).resolve().parent.parent / "docs" / "driving.md").read_text(encoding="utf-8")


def documented() -> dict[str, str]:
    """Setting and default of every row of a table of settings."""
    found = {}
    for row in re.findall(r"^\| (`\w+`.*?) \| (.*?) \|", TEXT, re.MULTILINE):
        names = re.findall(r"`(\w+)`", row[0])
        values = [row[1]] if len(names) == 1 else row[1].split(", ")
        found.update(zip(names, values, strict=False))
    return found


@pytest.mark.parametrize("model", [Filter, Geometric, Kinodynamic])
def test_every_setting_is_documented_with_its_default(model: type[BaseModel]) -> None:
    for name, field in model.model_fields.items():
        if name not in ("kind", "rate_hz"):
            default = list(field.default) if isinstance(field.default, tuple) else field.default
            assert documented()[name] in (str(default), f"{default:g}" if isinstance(default, float) else "")


def test_every_setting_of_the_camera_is_mentioned() -> None:
    ours = set(Sensing.model_fields) - {"preset", "communication_delay"}
    assert all(f"`{name}`" in TEXT for name in ours)


def test_the_table_of_noise_is_the_one_in_the_code() -> None:
    noise = PRESETS["single-tag"]
    row = next(line for line in TEXT.splitlines() if line.startswith("| `single-tag`"))
    expected = [1000 * law.at(d) for law in (noise.along, noise.across) for d in (3.0, 5.0)]
    expected += [math.degrees(noise.heading.at(d)) for d in (3.0, 5.0)] + [100 * noise.misses]
    assert [float(number) for number in re.findall(r"([\d.]+) (?:mm|deg|%)", row)] == pytest.approx(expected)
