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


@pytest.mark.parametrize(
    ("call", "names"),
    [
        (lambda: kraft.load_scenario(["turns"]), "scenario: .* not list"),  # type: ignore[arg-type]
        (lambda: kraft.load_method(kraft.load_method("kraft")), "method: .* not Method"),  # type: ignore[arg-type]
        (lambda: kraft.load_vehicle(3), "vehicle: .* not int"),  # type: ignore[arg-type]
        (lambda: kraft.load_scenario("turns", "a=1"), "settings: .* not str"),  # type: ignore[arg-type]
        (lambda: kraft.load_scenario("turns", [1]), "settings: .* not list"),  # type: ignore[list-item]
        (lambda: kraft.load_vehicle("mushr", parameters=[("L", 0.3)]), "parameters: .* not list"),  # type: ignore[arg-type]
        (lambda: spec(vehicle=kraft.load_vehicle("mushr")), "vehicle: .* not Vehicle"),
        (lambda: kraft.TrialSpec("turns", "kraft", "mushr", 0), "scenario: .* not str"),  # type: ignore[arg-type]
        (lambda: kraft.run_trial("turns"), "spec: .* not str"),  # type: ignore[arg-type]
        (lambda: kraft.plan("turns", previous=0), "previous: .* not int"),  # type: ignore[arg-type]
        (lambda: kraft.plan("turns", []), "vehicle: .* not list"),  # type: ignore[arg-type]
        (lambda: experiment(vary=[1]), "vary: .* not list"),
        (lambda: experiment(methods=None), "methods: .* not NoneType"),
        (lambda: experiment(scenarios=(name for name in ["turns"])), "scenarios: .* not generator"),
    ],
)
def test_a_value_of_another_type_is_refused_by_the_name_of_its_argument(call: Any, names: str) -> None:
    with pytest.raises(TypeError, match=names):
        call()


def test_a_path_is_never_a_bundled_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for call in (
        lambda: kraft.load_scenario(Path("turns")),
        lambda: kraft.load_method(Path("kraft")),
        lambda: kraft.load_vehicle(Path("mushr")),
        lambda: spec(vehicle=Path("mushr")),
    ):
        assert refused(call)[0] is Code.NOT_FOUND


def test_an_empty_name_of_a_vehicle_does_not_stand_for_the_scenario_s() -> None:
    assert refused(lambda: spec(vehicle=""))[0] is Code.NOT_FOUND
    assert refused(lambda: kraft.plan("turns", ""))[0] is Code.NOT_FOUND


def test_a_folder_of_vehicles_may_be_text(tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_bytes(Path(bundled.find("vehicle", "mushr")).read_bytes())
    assert kraft.load_vehicle("own.yaml", str(tmp_path)).name == "mushr"


@pytest.mark.parametrize("vehicle", ["mushr", "kraft.vehicles.mushr:MUSHR"])
def test_parameters_of_a_vehicle_are_checked_wherever_it_is_from(vehicle: str) -> None:
    assert type(kraft.load_vehicle(vehicle, parameters={"L": np.array(0.3)}).parameters["L"]) is float  # type: ignore[dict-item]
    for value in (float("nan"), "0.3", None, True, 10**400, [0.3]):
        assert "L" in refused(lambda value=value: kraft.load_vehicle(vehicle, parameters={"L": value}))[1]  # type: ignore[misc]
    assert refused(lambda: kraft.load_vehicle(vehicle, parameters={1: 0.3}))[0] is Code.UNKNOWN  # type: ignore[dict-item]


def test_one_number_of_numpy_is_no_list_of_values() -> None:
    assert refused(lambda: experiment(vary={"sensing.noise_scale": np.array(1.0)}))[0] is Code.MISSING
    made = experiment(scenarios=np.array(["turns", "slip"]), methods=np.array(["kraft"]))
    assert [cell.entry.name for cell in made.cells] == ["turns", "slip"]
