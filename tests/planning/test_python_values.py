"""What a notebook passes: numbers of numpy, paths, one name where a list is expected, and values of a wrong type."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kraft
from kraft.config import bundled
from kraft.errors import Code
from kraft.evaluation.experiment import experiment_of


def refused(call: Callable[[], object]) -> tuple[Code | None, str]:
    with pytest.raises(kraft.InputError) as caught:
        call()
    (problem,) = caught.value.diagnostics
    return problem.code, str(problem)


def spec(**named: Any) -> kraft.TrialSpec:
    return kraft.TrialSpec.load("turns", **named)


def experiment(**named: Any) -> Any:
    return experiment_of(**{"scenarios": ["turns"], "methods": ["kraft"], "trials": 1, **named})


def test_numbers_of_numpy_are_numbers() -> None:
    kinds: dict[str, Any] = {"iterations": np.int64(200), "seed": np.uint8(3), "threads": np.int32(1)}
    found, same = kraft.plan("turns", "mushr", **kinds), kraft.plan("turns", "mushr", iterations=200, seed=3)
    assert found.plan is not None
    assert same.plan is not None
    assert np.array_equal(found.plan.states, same.plan.states)
    assert type(spec(seed=np.int64(4)).seed) is int
    made = experiment(trials=np.int64(2), seed=np.int64(1), vary={"sensing.noise_scale": np.linspace(0.0, 2.0, 3)})
    assert (type(made.trials), type(made.seed), len(made.cells)) == (int, int, 3)


@pytest.mark.parametrize("value", [1.5, "1", None, np.float64(1.0)])
def test_a_count_that_is_no_whole_number_is_refused(value: Any) -> None:
    for name, call in (
        ("seed", lambda: kraft.plan("turns", "mushr", iterations=1, seed=value)),
        ("threads", lambda: kraft.plan("turns", "mushr", iterations=1, threads=value)),
        ("seed", lambda: spec(seed=value)),
        ("trials", lambda: experiment(trials=value)),
        ("seed", lambda: experiment(seed=value)),
    ):
        code, text = refused(call)
        assert code is Code.TYPE
        assert text.startswith(f"{name}: is {value!r}; expected a whole number")


def test_a_vehicle_may_be_a_path() -> None:
    path = Path(bundled.find("vehicle", "mushr"))
    assert kraft.load_vehicle(path).name == "mushr"
    assert spec(vehicle=path).vehicle.name == "mushr"
    assert experiment(vehicle=path).cells[0].vehicle.name == "mushr"


def test_one_name_is_no_list_of_names() -> None:
    assert refused(lambda: experiment(scenarios="turns")) == (
        Code.TYPE,
        "scenarios: is the text 'turns'; expected a list of scenarios, as in ['turns']",
    )
    assert refused(lambda: experiment(methods=Path("kraft")))[0] is Code.TYPE
    assert refused(lambda: experiment(vary={"sensing.noise_scale": 2}))[0] is Code.MISSING


def test_what_is_no_scenario_is_refused_by_its_type() -> None:
    with pytest.raises(TypeError, match="not NoneType"):
        kraft.plan(None, "mushr")  # type: ignore[arg-type]
