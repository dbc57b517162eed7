"""Method files: the bundled ones load, and what is wrong with one is said at its place."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kraft.config import bundled
from kraft.driving.control_settings import Kinodynamic
from kraft.driving.estimator_settings import Filter, Latest
from kraft.driving.method import load_method
from kraft.driving.planner_settings import ITERATIONS_MAX, Clearance
from kraft.errors import Code, Diagnostic, InputError
from kraft.trial.result import TrialSpec
from kraft_cli.work.validate import check_file

GOOD = """name: mine
title: Mine
planner: {mode: replanning, safety: {delta: 0.05, delta_per_speed: 0.25}}
estimator: {kind: filter, position_noise: 0.1}
controller: {kind: kinodynamic, k_path: 5, look: 0.1}
"""


def problems_of(folder: Path, text: str) -> tuple[Diagnostic, ...]:
    (folder / "m.yaml").write_text(text, encoding="utf-8")
    return check_file(folder / "m.yaml", print).problems


@pytest.mark.parametrize("name", bundled.names("method"))
def test_a_bundled_method_is_described_and_names_its_schema(name: str) -> None:
    text = (bundled.folder("method") / f"{name}.yaml").read_text(encoding="utf-8")
    assert text.splitlines()[0] == "# yaml-language-server: $schema=method.schema.json"
    method = load_method(name)
    assert method.name == name
    assert method.description
    assert check_file(name, print).kind == "method"


def test_a_good_file_has_no_problems_and_loads(tmp_path: Path) -> None:
    assert problems_of(tmp_path, GOOD) == ()
    method = load_method(tmp_path / "m.yaml")
    assert isinstance(method.estimator, Filter)
    assert isinstance(method.controller, Kinodynamic)
    assert (method.estimator.position_noise, method.controller.k_path, method.controller.look) == (0.1, 5.0, 0.1)
    assert str(method.source.where("controller.look")) == "line 5, column 50"


def test_the_estimator_of_the_paper_is_the_default(tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_text(GOOD.replace("estimator: {kind: filter, position_noise: 0.1}\n", ""))
    assert load_method(tmp_path / "m.yaml").estimator == Latest(kind="latest")


@pytest.mark.parametrize(
    ("old", "new", "place", "path", "name"),
    [
        ("kinodynamic", "kinodynmic", (5, 20), "controller.kind", "did you mean 'kinodynamic'"),
        ("kinodynamic", "3", (5, 20), "controller.kind", "open_loop, geometric, kinodynamic"),
        ("kind: kinodynamic, ", "", (5, 1), "controller.kind", ""),
        ("{kind: kinodynamic, k_path: 5, look: 0.1}", "fast", (5, 13), "controller", "'fast'"),
        ("k_path", "k_pth", (5, 33), "controller.k_pth", "did you mean 'k_path'"),
        ("k_path: 5", "lookahead: 5", (5, 33), "controller.lookahead", "kind, rate_hz, k_path, k_heading, k_along, softening, look"),
        ("k_path: 5", "k_path: x", (5, 41), "controller.k_path", "'x'"),
        ("look: 0.1", "softening: 0", (5, 55), "controller.softening", "greater than 0"),
        ("kind: kinodynamic, k_path: 5, look: 0.1", "kind: geometric, gains: [1, 2]", (5, 38), "controller.gains", "3 items"),
        ("kind: filter", "kind: kalman", (4, 19), "estimator.kind", "one of latest, filter, adaptive, oracle"),
        ("k_path: 5", "k_path: -5", (5, 41), "controller.k_path", "at least 0"),
        ("k_path: 5", "k_heading: -1", (5, 44), "controller.k_heading", "at least 0"),
        ("k_path: 5", "k_along: -1", (5, 42), "controller.k_along", "at least 0"),
        ("kind: kinodynamic, k_path: 5, look: 0.1", "kind: geometric, gains: [-1, 2, 0]", (5, 39), "controller.gains[0]", "at least 0"),
        ("kind: kinodynamic, k_path: 5, look: 0.1", "kind: geometric, gains: [1, -2, 0]", (5, 42), "controller.gains[1]", "at least 0"),
        ("kind: kinodynamic, k_path: 5, look: 0.1", "kind: lqr, heading_deg: 1.0e-9", (5, 38), "controller.heading_deg", "at least 1e-06"),
        ("position_noise: 0.1", "drift: 1.0e-200", (4, 34), "estimator.drift", "at least 1e-06"),
        ("look: 0.1", "rate_hz: 5", (5, 53), "controller.rate_hz", "at least 10"),
        ("replanning,", "replanning, lead: 2,", (3, 35), "planner.lead", "less than 1"),
        ("replanning,", "replanning, vehicle: musrh,", (3, 38), "planner.vehicle", "did you mean 'mushr'"),
        ("title: Mine\n", "", (1, 1), "title", ""),
    ],
)  # fmt: skip
def test_a_wrong_method_file_has_one_problem_at_its_place(
    old: str, new: str, place: tuple[int, int], path: str, name: str, tmp_path: Path
) -> None:
    """`name` is what the message has to name: the value that is wrong, or what is allowed instead."""
    (problem,) = problems_of(tmp_path, GOOD.replace(old, new))
    assert ((problem.line, problem.column), problem.path) == (place, path)
    assert name in str(problem)


@pytest.mark.parametrize(
    ("cycles", "rate", "least"),
    [
        ("cycle: 0.04, lead: 0", 20, 25), ("cycle: 0.25, clock_cycle: 0.05", 19, 20), ("cycle: 0.04, lead: 0", 25, None),
        ("cycle: 0.3", 10, None), ("cycle: 0.049, lead: 0", 20.408163265, None),
    ],
)  # fmt: skip
def test_a_controller_sends_a_command_in_each_cycle(
    tmp_path: Path, cycles: str, rate: float, least: float | None
) -> None:
    text = GOOD.replace("replanning,", f"replanning, {cycles},").replace("look: 0.1", f"rate_hz: {rate}")
    found = [(each.path, each.line, each.column, each.expected) for each in problems_of(tmp_path, text)]
    assert found == ([] if least is None else [("controller.rate_hz", 5, 53, f"expected at least {least}")])


def test_a_method_that_plans_once_has_no_cycles_to_send_commands_in(tmp_path: Path) -> None:
    one_shot = "mode: one-shot, cycle: 0.05, lead: 0"
    assert problems_of(tmp_path, GOOD.replace("mode: replanning", one_shot).replace("look: 0.1", "rate_hz: 10")) == ()


def test_an_unknown_method_is_answered_with_the_nearest_one() -> None:
    with pytest.raises(InputError) as caught:
        load_method("kraf")
    (diagnostic,) = caught.value.diagnostics
    assert diagnostic.file == "kraf"
    assert "'kraft'" in diagnostic.expected


@pytest.mark.parametrize("key", ["on_board: contingency", "contingencies: tracked"])
@pytest.mark.parametrize("without", ["mode: replanning", "mode: one-shot, safety: {delta: 0.05}"])
def test_a_method_without_contingencies_has_none_on_board(tmp_path: Path, key: str, without: str) -> None:
    planner = "planner: {mode: replanning, safety: {delta: 0.05, delta_per_speed: 0.25}}"
    problems = problems_of(tmp_path, GOOD.replace(planner, f"planner: {{{without}, {key}}}"))
    assert [problem.path for problem in problems] == [f"planner.{key.split(':', maxsplit=1)[0]}"]


ADAPTIVE = """name: mine
title: Mine
planner: {mode: replanning, vehicle: mushr-force, bound: {shares: [1.0, 0.5], limits: [0.7, 2.5]}}
estimator: {kind: adaptive}
controller: {kind: kinodynamic}
"""


def test_a_good_file_with_a_bound_has_no_problems(tmp_path: Path) -> None:
    assert problems_of(tmp_path, ADAPTIVE) == ()


@pytest.mark.parametrize(
    ("old", "new", "place", "path", "name"),
    [
        ("[1.0, 0.5]", "[0.5, 1.0]", (3, 73), "planner.bound.shares[1]", "less than 0.5"),
        ("[1.0, 0.5]", "[1.0, 0.5, 0.5]", (3, 78), "planner.bound.shares[2]", "less than 0.5"),
        ("[1.0, 0.5]", "[1.0, 0]", (3, 73), "planner.bound.shares[1]", "greater than 0"),
        ("[1.0, 0.5]", "[1.5, 0.5]", (3, 68), "planner.bound.shares[0]", "at most 1"),
        ("[1.0, 0.5]", "[]", (3, 67), "planner.bound.shares", "1 item or more"),
        ("[0.7, 2.5]", "[2.5, 0.7]", (3, 87), "planner.bound.limits", "least < largest"),
        ("[0.7, 2.5]", "[0.7, 0.7]", (3, 87), "planner.bound.limits", "least < largest"),
        ("shares", "share", (3, 59), "planner.bound.share", "did you mean 'shares'"),
        ("bound:", "safety: {delta: 0.01}, bound:", (3, 81), "planner.bound", "`safety`"),
        ("mode: replanning", "mode: one-shot", (3, 56), "planner.bound", "`mode: replanning`"),
        ("kind: adaptive", "kind: filter", (3, 58), "planner.bound", "`estimator: {kind: adaptive}`"),
        ("estimator: {kind: adaptive}\n", "", (3, 58), "planner.bound", "latest"),
        ("kind: adaptive", "kind: adaptive, window: 0.5", (4, 37), "estimator.window", "at least 1"),
        ("mushr-force", "benchmark", (3, 38), "planner.vehicle", "benchmark states no min, max and std of gain"),
    ],
)  # fmt: skip
def test_a_wrong_bound_or_vehicle_has_one_problem_at_its_place(
    old: str, new: str, place: tuple[int, int], path: str, name: str, tmp_path: Path
) -> None:
    (problem,) = problems_of(tmp_path, ADAPTIVE.replace(old, new))
    assert ((problem.line, problem.column), problem.path) == (place, path)
    assert name in str(problem)


@pytest.mark.parametrize("key", ["on_board: contingency", "contingencies: tracked"])
def test_a_bound_has_contingencies(tmp_path: Path, key: str) -> None:
    assert problems_of(tmp_path, ADAPTIVE.replace("bound:", f"{key}, bound:")) == ()


def test_a_vehicle_without_parameters_is_refused_at_its_line(tmp_path: Path) -> None:
    (tmp_path / "bare.py").write_text(BARE)
    (problem,) = problems_of(tmp_path, ADAPTIVE.replace("mushr-force", "bare.py:BARE"))
    assert (problem.path, problem.code) == ("planner.vehicle", Code.MISSING)
    assert "bare has no parameters" in problem.problem


def test_a_trial_with_a_vehicle_without_ranges_is_refused_when_it_is_specified(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        TrialSpec.load("turns", "adaptive-kraft", vehicle="benchmark")
    (problem,) = caught.value.diagnostics
    assert (Path(problem.file).name, problem.path, problem.code) == ("benchmark.yaml", "parameters", Code.MISSING)
    assert "`fixed: true`" in problem.expected
    (tmp_path / "m.yaml").write_text(ADAPTIVE.replace("mushr-force", "benchmark"))
    with pytest.raises(InputError) as caught:
        TrialSpec.load("turns", tmp_path / "m.yaml")
    (problem,) = caught.value.diagnostics
    assert (problem.file, problem.line, problem.code) == (str(tmp_path / "m.yaml"), 3, Code.MISSING)


def test_a_vehicle_in_code_without_ranges_is_told_how_code_states_them() -> None:
    with pytest.raises(InputError) as caught:
        TrialSpec.load("turns", "adaptive-kraft", vehicle="kraft.vehicles.mushr:MUSHR")
    (problem,) = caught.value.diagnostics
    assert (problem.file, problem.code) == ("mushr", Code.MISSING)
    assert "ranges={name: ParameterRange(low, high, std)} with ParameterRange of ompl_ext.vehicle" in problem.expected
    assert "because the method adaptive-kraft estimates parameters" in problem.expected


BARE = """from ompl_ext import Footprint, Vehicle, cos, derivative, sin


@derivative
def motion(x, u, p):
    return x[3] * cos(x[2]), x[3] * sin(x[2]), u[1], u[0] - x[3]


BARE = Vehicle(
    name="bare", derivative=motion, state=("x", "y", "theta", "v"), top_speed=1.0,
    controls={"throttle": (0.0, 1.0), "steering": (-1.0, 1.0)}, footprint=Footprint(0.4, 0.2),
)
"""


def test_all_problems_of_a_method_are_reported_together_those_between_keys_too(tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(
        """name: bad
title: Bad
planner:
  mode: replanning
  lead: 2.0
  max_iterations: 10
  first_max_iterations: 5
  bound: {level: 1.5, limits: [3, 2], shares: [0.2, 0.5]}
  safety: {delta: 0.1}
estimator: {kind: filter}
controller: {kind: mppi}
"""
    )
    with pytest.raises(InputError) as caught:
        load_method(path)
    assert [(each.line, each.path) for each in caught.value.diagnostics] == [
        (5, "planner.lead"), (6, "planner.max_iterations"), (7, "planner.first_max_iterations"),
        (8, "planner.bound"), (8, "planner.bound"), (8, "planner.bound.level"), (8, "planner.bound.limits"),
        (8, "planner.bound.shares[1]"), (11, "controller.objective"),
    ]  # fmt: skip


def test_values_of_any_type_are_refused_at_their_place(tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(
        """name: bad
title: Bad
planner: {mode: [], type: {a: 1}, lead: x, cycle: [1], iterations: true, bound: 5, safety: [], blocked: {}}
estimator: [adaptive]
controller: {kind: [mppi], objective: {}}
"""
    )
    with pytest.raises(InputError) as caught:
        load_method(path)
    assert {each.path for each in caught.value.diagnostics} >= {"planner.mode", "planner.lead", "planner.bound"}


@pytest.mark.parametrize(
    ("changed", "path"),
    [
        ({"iteration": 5}, "iteration"),
        ({"iterations": -5}, "iterations"),
        ({"margin": float("nan")}, "margin"),
        ({"mode": "oneshot"}, "mode"),
        ({"lead": 2.0}, "lead"),
        ({"safety": {"delta": -1.0}}, "safety.delta"),
    ],
)
def test_a_copy_of_settings_in_code_is_checked_as_a_file_is(changed: dict[str, Any], path: str) -> None:
    with pytest.raises(InputError) as caught:
        load_method("kraft").planner.model_copy(update=changed)
    (problem,) = caught.value.diagnostics
    assert (problem.file, problem.path) == ("PlannerSettings", path)


def test_a_copy_of_settings_takes_what_a_file_could_state_and_numbers_of_numpy() -> None:
    method = load_method("kraft")
    changed = {"iterations": np.int64(7), "margin": np.float32(0.25), "safety": {"delta": 0.1}}
    planner = method.planner.model_copy(update=changed)
    assert (type(planner.iterations), planner.iterations, planner.margin) == (int, 7, 0.25)
    assert planner.safety == Clearance(delta=0.1)
    assert planner.lead == method.planner.lead
    copied = method.model_copy(update={"name": "own", "planner": planner})
    assert (copied.planner, copied.source) == (planner, method.source)
    without = load_method("adaptive-kraft").planner.model_copy(update={"contingency": False})
    assert (without.bound, without.contingency) == (None, False)


def test_the_largest_first_budget_is_one_that_settings_may_have() -> None:
    planner = load_method("kraft").planner.model_copy(update={"first_iterations": ITERATIONS_MAX})
    assert planner.for_first_plan.largest_budget == ITERATIONS_MAX
