"""The pages on driving name every setting with its real default, the bundled methods, and the noise in the code."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from support.paths import ROOT

from kraft.config import bundled
from kraft.driving.bound import LATER_DELAY, LATER_DELTA, LATER_GROWTH
from kraft.driving.control_settings import (
    Dwa,
    Geometric,
    Kinodynamic,
    Lqr,
    Mppi,
    Nmpc,
    Predictive,
    RolloutCost,
    UserCode,
)
from kraft.driving.estimation.adaptive import PASSING_FORCE, PASSING_TIME, SLOW
from kraft.driving.estimation.correlated_filter import MOVED_AFTER
from kraft.driving.estimation.drive_history import DRIVE_MAX, SEEN, SEEN_DEVIATIONS, SEEN_WAY
from kraft.driving.estimation.pose_noise import LAG, PRIOR_CORRELATION, PRIOR_SAMPLES
from kraft.driving.estimation.sliding_window import NOTICED, SIGNIFICANT
from kraft.driving.estimator_settings import Adaptive, Filter
from kraft.driving.level_search import DETOUR, LEAST_GAIN, LEVEL_GAIN, PROBES_HIGHER, RISE, STALLED
from kraft.driving.levels import (
    HYSTERESIS,
    INSISTENCE,
    NARROW,
    NEAR,
    PAUSE,
    PROGRESS,
    PROGRESS_TIME,
    SOON,
    STEADY,
)
from kraft.driving.method import Method, load_method
from kraft.driving.plan_search import CORRECTION_ATTEMPTS
from kraft.driving.planner_settings import CalibratedBound, Clearance, PlannerSettings
from kraft.driving.remainder import ATTEMPT_TOLERANCE, RETAINED_TOLERANCE
from kraft.driving.room import NEARBY, NEARER, ROOM
from kraft.driving.search_budget import PATIENCE
from kraft.driving.solvers import COVER_EXCESS, method_safety
from kraft.scenario import Sensing
from kraft.simulation.camera import BLURRED_SPEED, PRESETS
from kraft.vehicles import DELAY_MAX

PAGES = ("driving", "clearance", "estimation", "control")
TEXT = "\n".join((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8") for page in PAGES)


TABLES = {
    PlannerSettings: "keys of `planner`:",
    Clearance: "The keys of its `safety`:",
    CalibratedBound: "The keys of its `bound`:",
    Filter: "### filter\n",
    Adaptive: "### adaptive\n",
    Geometric: "\n## geometric\n",
    Kinodynamic: "\n## kinodynamic\n",
    Lqr: "\n## lqr\n",
    RolloutCost: "The cost of a rollout:",
    Mppi: "`mppi`, model predictive",
    Dwa: "`dwa`, the dynamic window",
    Nmpc: "\n## nmpc\n",
    UserCode: "The settings of such a controller:",
}
"""Text before the table of each model's settings."""


BASES: dict[type[BaseModel], type[BaseModel]] = {Mppi: RolloutCost, Dwa: RolloutCost}
"""Settings that are in the table of another model; `objective` is explained in the text."""


def documented(model: type[BaseModel]) -> dict[str, str]:
    """Setting and default of every row of the table of a model."""
    table = re.search(r"^(\|.*\n)+", TEXT[TEXT.index(TABLES[model]) :], re.MULTILINE)
    assert table is not None
    found = {}
    for row in re.findall(r"^\| (`\w+`.*?) \| (.*?) \|", table.group(), re.MULTILINE):
        names = re.findall(r"`(\w+)`", row[0])
        values = [row[1]] if len(names) == 1 else row[1].split(", ")
        found.update(zip(names, values, strict=False))
    return found


def shown(field: FieldInfo) -> set[str]:
    """How a default may be written."""
    if field.is_required():
        return {"required"}
    default = list(field.default) if isinstance(field.default, tuple) else field.default
    words = {"None": "none", "False": "false", "True": "true"}
    return {words.get(str(default), str(default)), f"{default:g}" if isinstance(default, float) else "?"}


@pytest.mark.parametrize("model", TABLES)
def test_every_setting_is_documented_with_its_default(model: type[BaseModel]) -> None:
    rows, base = documented(model), BASES.get(model, Predictive).model_fields
    fields = {
        name: field
        for name, field in model.model_fields.items()
        if not issubclass(model, Predictive) or name not in base
    }
    assert sorted(rows) == sorted(name for name in fields if name not in ("kind", "rate_hz"))
    assert {name: default for name, default in rows.items() if default not in shown(fields[name])} == {}


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
        planner, safety, bound = method.planner, method.planner.safety, method.planner.bound
        clearance = f"{safety.delta:g} + {safety.delta_per_speed:g} v" if safety else "measured" if bound else "none"
        expected = [
            planner.mode, planner.vehicle or "the scenario's", f"{planner.margin:g}", clearance, method.controller.kind,
            method.estimator.kind,
        ]  # fmt: skip
        assert row.split(" | ") == expected
        once = planner.mode == "one-shot"
        short = planner.cycle == 0.25 and planner.type != "geodesic"  # which has no iterations
        many = 500 if short else 1000
        assert (planner.iterations, planner.goal_margin) == ((20_000, 0.0) if once else (many, 0.1))
        assert planner.recover == method_safety(planner).enabled
        assert safety is None or safety.foresight == 3.0
        assert bound is None or bound.foresight == 60.0


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


def test_the_mean_error_of_the_noise_is_the_one_in_the_code() -> None:
    found = re.search(r"a mean error away from the camera \((\d+) mm and (\d+) mm there\)", " ".join(TEXT.split()))
    assert found is not None
    mean = PRESETS["single-tag"].along.mean
    expected = [1000 * mean.at(*place) for place in ((4.8, 0.0), (5.6, math.radians(30.0)))]
    assert [float(number) for number in found.groups()] == pytest.approx(expected, abs=0.5)


def test_the_factors_of_a_tag_that_stands_are_those_in_the_code() -> None:
    noise = PRESETS["single-tag"]
    words = " ".join(TEXT.split())
    found = re.search(r"along the line of sight are then ([\d.]+) times, those of the heading ([\d.]+) times", words)
    assert found is not None
    assert tuple(map(float, found.groups())) == (noise.along.standing, noise.heading.standing)
    assert noise.across.standing == 1.0
    assert f"rises to 1 at {BLURRED_SPEED:g} m/s" in words


def test_quoted_constants_are_those_in_the_code() -> None:
    """Numbers of the sections on the bound and on the adaptive estimator that are constants, not settings."""
    words = " ".join(TEXT.split())
    for text in (
        f"its remainder needs only {HYSTERESIS:g} of the clearance", f"costs over {STALLED:g} s more than what was left",
        f"costs at most {RETAINED_TOLERANCE:g} s more", f"a stop of less than {DRIVE_MAX:g} s",
        f"the settings count as {PRIOR_SAMPLES:g} independent poses, and as {PRIOR_CORRELATION:g} correlation times",
        f"up to forces that come and go, of {PASSING_FORCE:g} m/s², each {PASSING_TIME:g} s another one",
        f"in the halves of the last second are {100 * SEEN_WAY:g} cm", f"that are {LAG:g} s apart", f"than its noise explains for {MOVED_AFTER:g} s", f"A car slower than {SLOW:g} m/s by its model",
        f"by the covariance of the new ones, is over {SIGNIFICANT:g}",
        f"exceeds {NOTICED:g}. The next cycles test the motion since then as well",
        f"If for {PROGRESS_TIME:g} s no plan was cheaper by {PROGRESS * PROGRESS_TIME:g} s than the cheapest one before",
        f"no higher level is tried, for {INSISTENCE:g} s at most", f"and {ATTEMPT_TOLERANCE:g} s more after each attempt", f"less than {100 * ROOM:g} cm of clearance", f"with {100 * ROOM:g} cm within {100 * NEARBY:g} cm",
        f"only if its first {NEAR:g} s come nowhere more than {1000 * NEARER:g} mm nearer",
        f"up to {LATER_DELAY:g} s (`LATER_DELAY`)", f"From {NEAR:g} s on (`NEAR`)", f"{LATER_DELTA:g} m or what the pose's error asks for",
        f"a growth of at most {LATER_GROWTH:g} m/s, and at most {LATER_DELAY:g} s for the speed",
        f"exceed it by at most {100 * COVER_EXCESS:g} % of its width",
        f"from 0 to {DELAY_MAX:g} s", f"| none | {SOON:g} cycles |",
        f"has not reached the goal after {PATIENCE:g} `iterations` gives way",
        f"less than {RISE:g} s more than the plan that is then found at the lower level",
        f"costs over {DETOUR:g} s more than the cost-to-go of its first state", f"and at least {LEAST_GAIN:g} s;",
        f"no level is tried for the cost-to-go in the next {PAUSE:g} cycles",
        f"above {LATER_DELAY:g} s for the speed, or a growth above {LATER_GROWTH:g} m/s",
        f"{LEAST_GAIN:g} s suffice if the plan costs over {STALLED:g} s more than what was left",
    ):  # fmt: skip
        assert text in words
    assert (STEADY, NARROW, CORRECTION_ATTEMPTS, PROBES_HIGHER) == (2, (1.0, 0.5), 12, 4)
    assert LEVEL_GAIN == 0.1  # a tenth
    assert (SEEN, SEEN_DEVIATIONS) == (1.0, 2.0)
