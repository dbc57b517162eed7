"""Controllers of the user's own: what their class is given, what of it is checked, and who tracks contingencies."""

from __future__ import annotations

import copy
import time
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.diagnostics import located, raised
from support.fake_trials import Inline
from support.replanner import mushr, start, turns

from kraft.driving.car_model import CarModel
from kraft.driving.control import UserController, check_available, make_controller, needs_map, set_map
from kraft.driving.control_settings import Kinodynamic, UserCode
from kraft.driving.messages import Estimate, Reference, ReferenceKind
from kraft.driving.method import Method, load_method
from kraft.driving.planner_settings import PlannerSettings
from kraft.driving.solvers import Solvers
from kraft.errors import Code, UserCodeError
from kraft.evaluation import evaluator
from kraft_cli.main import main
from kraft_cli.work.own_code import reported_own_code
from ompl_ext.arrays import Floats

CONTROLLERS = """
import numpy as np

class Counts:
    '''Sends the number of its commands as throttle, and what it was given.'''

    def __init__(self, model, first=0.0):
        self.model, self.count, self.maps, self.seed = model, first, [], None

    def set_seed(self, seed):
        self.seed = seed

    def command(self, estimate, reference):
        self.count += 0.1
        estimate.state[:] = np.nan  # its own copies
        reference.controls[:] = np.nan
        return self.count, 7.0

class Mapped(Counts):
    def set_map(self, solver):
        self.maps.append(solver)

class Plain:
    def __init__(self, model): ...
    def command(self, estimate, reference):
        return reference.control_at(estimate.time)

class Fails(Plain):
    def command(self, estimate, reference):
        return 1 / 0

class FailsLate(Plain):
    def command(self, estimate, reference):
        return super().command(estimate, reference) if estimate.time < 0.5 else estimate.speed

class FailsAtOnce(Plain):
    def __init__(self, model):
        raise RuntimeError("not today")

class One(Plain):
    def command(self, estimate, reference):
        return [0.1]

class Text(Plain):
    def command(self, estimate, reference):
        return "fast"

class Infinite(Plain):
    def command(self, estimate, reference):
        return [np.inf, 0.0]

class Exits(Plain):
    def command(self, estimate, reference):
        raise SystemExit(5)

class Locked(Plain):
    def __init__(self, model):
        import threading
        self.lock = threading.Lock()

class Nothing: ...

NUMBER = 3
"""


class Plain:
    """Sends what is planned."""

    def __init__(self, model: CarModel) -> None: ...

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        return reference.control_at(estimate.time)


@cache
def model() -> CarModel:
    return CarModel(mushr())


@cache
def solvers() -> Solvers:
    return Solvers.of(turns(), mushr(), PlannerSettings(mode="replanning"))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "controllers.py"
    path.write_text(CONTROLLERS)
    return path


def settings(file: Path, name: str, **given: object) -> UserCode:
    return UserCode(kind="code", code=f"{file}:{name}", settings=given)  # type: ignore[arg-type]


def made(file: Path, name: str, **given: object) -> UserController:
    controller = make_controller(settings(file, name, **given), model(), solvers().checking, seed=7)
    assert isinstance(controller, UserController)
    return controller


def reference(kind: ReferenceKind) -> Reference:
    states = np.array([start(), start()])
    return Reference(kind, np.array([0.0, 1.0]), states, np.array([[0.4, 0.1]]), model().rest)


PLAN, CONTINGENCY = reference(ReferenceKind.PLAN), reference(ReferenceKind.CONTINGENCY)


def estimate(time: float = 0.5) -> Estimate:
    return Estimate(time, start(), 0.0)


def own(controller: UserController) -> Any:
    """The object of the user's class."""
    return vars(controller)["_own"]


def test_it_is_given_the_model_the_settings_and_a_seed_and_its_commands_are_clamped(file: Path) -> None:
    controller, now = made(file, "Counts", first=0.2), estimate()
    assert controller.command(now, PLAN).tolist() == [pytest.approx(0.3), model().high[1]]
    assert np.isfinite(now.state).all(), "it changes only its own copy of the state"
    assert np.isfinite(PLAN.controls).all(), "and of the plan"
    assert own(controller).model is model()
    assert own(controller).seed == 7


def test_a_contingency_is_tracked_by_the_law_of_the_other_methods(file: Path) -> None:
    law = make_controller(Kinodynamic(kind="kinodynamic", k_along=3.0), model())
    controller = made(file, "Fails")
    assert controller.command(estimate(), CONTINGENCY).tolist() == law.command(estimate(), CONTINGENCY).tolist()


def test_a_copy_has_a_state_of_its_own_and_shares_the_model_and_the_map(file: Path) -> None:
    controller = made(file, "Mapped")
    copied = copy.deepcopy(controller)
    copied.command(estimate(), PLAN)
    assert (own(controller).count, own(copied).count) == (0.0, pytest.approx(0.1))
    assert own(copied).model is model()
    assert own(copied).maps == [solvers().checking]


def test_it_is_given_every_map_if_it_wants_them(file: Path) -> None:
    controller, other = made(file, "Mapped"), Solvers.of(turns(), mushr(), PlannerSettings(mode="replanning")).checking
    set_map(controller, other)
    set_map(made(file, "Counts"), other)  # which wants none
    assert own(controller).maps == [solvers().checking, other]
    assert [d.code for d in raised(lambda: make_controller(settings(file, "Mapped"), model()))] == [Code.CONFLICT]


@pytest.mark.parametrize("name", ["One", "Text", "Infinite"])
def test_a_command_that_is_no_control_is_refused_with_its_time(file: Path, name: str) -> None:
    controller = made(file, name)
    with pytest.raises(UserCodeError) as error:
        controller.command(estimate(), PLAN)
    (problem,) = error.value.diagnostics
    assert (problem.file, problem.code) == (f"{file}:{name}", Code.CODE)
    assert "0.50 s" in problem.problem


@pytest.mark.parametrize(
    ("name", "text"), [("Fails", "        return 1 / 0"), ("Exits", "        raise SystemExit(5)")]
)
def test_an_error_in_a_command_is_said_at_its_line(file: Path, name: str, text: str) -> None:
    controller = made(file, name)
    with pytest.raises(UserCodeError) as error:
        controller.command(estimate(), PLAN)
    (problem,) = error.value.diagnostics
    assert (problem.file, problem.line) == (str(file), CONTROLLERS.splitlines().index(text) + 1)
    assert "0.50 s" in problem.problem


def test_an_error_of_its_construction_is_said(file: Path) -> None:
    with pytest.raises(UserCodeError, match="RuntimeError: not today"):
        made(file, "FailsAtOnce")


def test_what_cannot_be_copied_for_a_prediction_is_said(file: Path) -> None:
    controller = made(file, "Locked")
    with pytest.raises(UserCodeError, match=r"cannot pickle .*, in copying Locked for a prediction; .*__deepcopy__"):
        copy.deepcopy(controller)


def method(folder: Path, controller: str) -> Path:
    path = folder / "own.yaml"
    path.write_text(f"base: adaptive-kraft\nname: own\ntitle: Own\ncontroller: {{kind: code, {controller}}}\n")
    return path


@pytest.mark.parametrize(
    ("controller", "found"),
    [
        ("code: controllers.py:Count", ["4:32 controller.code not-found"]),
        ("code: controllers.py:Nothing", ["4:32 controller.code type"]),
        ("code: controllers.py:NUMBER", ["4:32 controller.code type"]),
        ("code: controllers.py", ["4:32 controller.code missing"]),
        ("code: controller.py:Counts", ["4:32 controller.code not-found"]),
        ("code: no_such_module:Counts", ["4:32 controller.code code"]),
        ("code: Counts", ["4:32 controller.code value"]),
        ("code: controllers.py:Counts, settings: {frist: 1}", ["4:32 controller.code code"]),
        ("settings: {}", ["4:1 controller.code missing"]),
        ("code: controllers.py:Counts, objective: goal", ["4:66 controller.objective conflict"]),
        (
            "code: controllers.py:Counts, settings: {first: [[1]], x: null}",
            ["4:73 controller.settings.first type", "4:83 controller.settings.x type"],
        ),
    ],
)
def test_problems_are_found_before_the_drive_at_their_line(file: Path, controller: str, found: list[str]) -> None:
    path = method(file.parent, controller)
    assert located(raised(lambda: check_available(load_method(path)))) == found
    assert main(["validate", str(path)]) == 2


def test_a_path_is_relative_to_the_file_that_has_it_also_as_a_base(file: Path, tmp_path: Path) -> None:
    base = method(file.parent, "code: controllers.py:Counts, settings: {first: 0.5}")
    (tmp_path / "elsewhere").mkdir()
    derived = tmp_path / "elsewhere" / "derived.yaml"
    derived.write_text(f"base: {base}\nname: derived\ntitle: Derived\ncontroller: {{rate_hz: 20}}\n")
    controller = load_method(derived).controller
    assert controller == UserCode(kind="code", code=f"{file}:Counts", settings={"first": 0.5}, rate_hz=20.0)


def test_a_class_that_tracks_plans_takes_no_place_of_one_that_heads_for_the_goal(file: Path) -> None:
    path = method(file.parent, "code: controllers.py:Counts")
    path.write_text(path.read_text().replace("adaptive-kraft", "mppi"))
    assert located(raised(lambda: load_method(path))) == ["4:1 controller.objective conflict"]


def test_in_python_the_class_itself_names_its_code(file: Path) -> None:
    base = load_method("adaptive-kraft")
    own = base.model_copy(update={"controller": {"kind": "code", "code": Plain}})
    assert own.controller == UserCode(kind="code", code=f"{__file__}:Plain")
    check_available(own)
    wrong = base.model_copy(update={"controller": {"kind": "code", "code": f"{file}:Count"}})
    (problem,) = raised(lambda: check_available(wrong))
    assert problem.file == f"{file}:Count", "and not the file of the base"
    (problem,) = raised(lambda: base.model_copy(update={"controller": {"kind": "code", "code": int}}))
    assert problem.path == "controller.code"


def test_only_a_class_that_wants_the_map_needs_it(file: Path) -> None:
    def loaded(controller: str) -> Method:
        return load_method(method(file.parent, f"code: controllers.py:{controller}"))

    assert not needs_map(loaded("Counts"))
    assert needs_map(loaded("Mapped"))


def test_a_trial_that_it_fails_in_is_recorded_and_a_change_of_the_code_is_noticed(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(evaluator, "Processes", Inline)
    monkeypatch.chdir(file.parent)
    method(file.parent, "code: controllers.py:FailsLate")
    arguments = ["eval", "turns", "--methods", "own.yaml", "--trials", "1", "--out", "out"]
    assert main(arguments) == 2
    line = next(n for n, text in enumerate(CONTROLLERS.splitlines(), 1) if "estimate.speed" in text)
    said = capsys.readouterr().err
    assert f"{file}:{line}: AttributeError: 'Estimate' object has no attribute 'speed'" in said
    assert "because of an error in the user's own code" in said
    file.write_text(CONTROLLERS + "\n# changed\n")
    assert main([*arguments, "--resume"]) == 2
    assert "methods.own.content.controller.code_sha256" in capsys.readouterr().err


def test_where_a_command_is_that_does_not_return_is_said(file: Path) -> None:
    file.write_text(CONTROLLERS + "\nclass Waits(Plain):\n    def command(self, e, r):\n        self.wait()\n")
    said: list[str] = []
    named = settings(file, "Waits")
    controller = made(file, "Waits")
    own(controller).wait = lambda: time.sleep(0.5)
    with reported_own_code(named, said.append, interval=0.1) as cycle_decided:
        cycle_decided()
        with pytest.raises(UserCodeError):  # it returns nothing
            controller.command(estimate(), PLAN)
    line = len(file.read_text().splitlines())
    assert said
    assert said[0].endswith(f"a command of the controller is at {file}:{line}")
