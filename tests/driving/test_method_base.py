"""A method file with a base: its keys override those of the base, and every problem is reported where it is."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from support import fake_trials
from support.evaluation import StoppingObserver
from support.paths import ROOT

from kraft.config import bundled
from kraft.driving.control_settings import Kinodynamic, Mppi
from kraft.driving.estimator_settings import Latest
from kraft.driving.method import Method, load_method
from kraft.errors import Code, InputError
from kraft.evaluation import evaluate
from kraft.scenario import load_scenario
from kraft.trial.planning_vehicle import vehicle_reference
from kraft_cli.work.validate import check_file

HEAD = "name: mine\ntitle: Mine\n"


def method(folder: Path, text: str, name: str = "mine") -> Method:
    return load_method(written(folder, text, name))


def written(folder: Path, text: str, name: str = "mine") -> Path:
    path = folder / f"{name}.yaml"
    path.write_text(text if text.startswith("name") else HEAD + text, encoding="utf-8")
    return path


def problems_of(path: Path) -> list[tuple[str, int | None, int | None, str]]:
    """Problems that both the library and `kraft validate` report: file, line, column and key."""
    with pytest.raises(InputError) as caught:
        load_method(path)
    found = caught.value.diagnostics
    assert sorted(map(str, check_file(path, print).problems)) == sorted(map(str, found))
    return [(Path(each.file).name, each.line, each.column, each.path) for each in found]


def test_keys_of_the_file_override_those_of_the_base_at_any_depth(tmp_path: Path) -> None:
    found = method(
        tmp_path,
        "base: adaptive-kraft\nplanner: {margin: 0.05, bound: {level: 0.9, shares: [1.0]}}\ncontroller: {k_along: 2}\n",
    )
    base = load_method("adaptive-kraft")
    assert base.planner.bound is not None
    bound = base.planner.bound.model_copy(update={"level": 0.9, "shares": [1.0]})
    assert found.planner == base.planner.model_copy(update={"margin": 0.05, "bound": bound})
    assert isinstance(base.controller, Kinodynamic)
    assert found.controller == base.controller.model_copy(update={"k_along": 2.0})
    assert found.estimator == base.estimator
    assert (found.name, found.title, found.description, found.base) == ("mine", "Mine", "", None)
    assert check_file(tmp_path / "mine.yaml", print).valid


@pytest.mark.parametrize("name", bundled.names("method"))
def test_a_file_that_overrides_nothing_is_its_base(name: str, tmp_path: Path) -> None:
    found, base = method(tmp_path, f"base: {name}\n"), load_method(name)
    texts = {"name", "title", "description"}
    assert found.model_dump(exclude=texts) == base.model_dump(exclude=texts)


def test_a_section_of_another_kind_replaces_that_of_the_base(tmp_path: Path) -> None:
    found = method(tmp_path, "base: kraft-mppi\ncontroller: {kind: kinodynamic, k_path: 7}\n")
    assert isinstance(load_method("kraft-mppi").controller, Mppi)
    assert found.controller == Kinodynamic(kind="kinodynamic", k_path=7.0)
    same = method(tmp_path, "base: kraft-mppi\ncontroller: {kind: mppi, steps: 9}\n")
    assert same.controller == load_method("kraft-mppi").controller.model_copy(update={"steps": 9})


def test_null_takes_away_what_the_base_has(tmp_path: Path) -> None:
    text = "base: adaptive-kraft\nplanner: {bound: null, safety: {delta: 0.01}}\nestimator: {kind: latest}\n"
    found = method(tmp_path, text)
    assert (found.planner.bound, found.estimator) == (None, Latest(kind="latest"))
    assert found.planner.safety is not None


def test_a_base_may_have_a_base_in_another_folder(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    written(tmp_path / "deep", "base: kraft\nplanner: {margin: 0.2, lead: 0.2}\n", "first")
    written(tmp_path, "base: deep/first.yaml\nplanner: {lead: 0.3}\n", "second")
    found = method(tmp_path, "base: second.yaml\nplanner: {cycle: 2.0}\n")
    planner = load_method("kraft").planner
    assert found.planner == planner.model_copy(update={"margin": 0.2, "lead": 0.3, "cycle": 2.0})


def test_a_vehicle_of_the_base_is_relative_to_the_base(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    text = (ROOT / "configs/vehicles/mushr-drive.yaml").read_text(encoding="utf-8")
    (tmp_path / "deep" / "car.yaml").write_text(text, encoding="utf-8")
    written(tmp_path / "deep", "base: kraft\nplanner: {vehicle: car.yaml}\n", "first")
    path = written(tmp_path, "base: deep/first.yaml\n")
    assert vehicle_reference(load_scenario("turns"), load_method(path)) == str(tmp_path / "deep" / "car.yaml")
    assert check_file(path, print).valid
    (tmp_path / "deep" / "car.yaml").unlink()
    (problem,) = check_file(path, print).problems
    assert (Path(problem.file).name, problem.line, problem.path) == ("first.yaml", 4, "planner.vehicle")


def test_problems_of_file_and_base_are_reported_at_their_own_places(tmp_path: Path) -> None:
    written(tmp_path, "base: kraft\nplanner: {margn: 1, lead: x}\n", "first")
    path = written(tmp_path, "base: first.yaml\nplanner: {cycle: -1}\ncontroller: {k_pth: 2}\n")
    assert problems_of(path) == [
        ("first.yaml", 4, 11, "planner.margn"), ("first.yaml", 4, 27, "planner.lead"),
        ("mine.yaml", 4, 18, "planner.cycle"), ("mine.yaml", 5, 14, "controller.k_pth"),
    ]  # fmt: skip


def test_a_key_that_a_file_does_not_take_from_its_base_is_missed_in_both(tmp_path: Path) -> None:
    written(tmp_path, "name: first\nbase: kraft\n", "first")
    path = written(tmp_path, "name: mine\nbase: first.yaml\n")
    assert problems_of(path) == [("first.yaml", 1, 1, "title"), ("mine.yaml", 1, 1, "title")]


def test_what_does_not_fit_to_a_valid_base_is_reported_in_the_file(tmp_path: Path) -> None:
    path = written(tmp_path, "base: adaptive-kraft\nplanner: {safety: {delta: 0.1}, lead: 0.3}\n")
    with pytest.raises(InputError) as caught:
        load_method(path)
    lead, bound = sorted(caught.value.diagnostics, key=lambda each: each.path, reverse=True)
    assert (lead.path, lead.line, lead.column) == ("planner.lead", 4, 39)
    assert (bound.file, bound.line, bound.column, bound.path) == (str(path), 4, 1, "planner.bound")
    assert f"the value of the base at {bundled.folder('method') / 'adaptive-kraft.yaml'}:13:10" in bound.problem


@pytest.mark.parametrize(
    ("base", "code", "name"),
    [
        ("krat", Code.NOT_FOUND, "'kraft'"),
        ("nowhere.yaml", Code.NOT_FOUND, "no such file"),
        ("5", Code.TYPE, "the number 5"),
        ("[kraft]", Code.TYPE, "a list"),
    ],
)
def test_a_base_that_is_none_is_reported_with_what_the_file_has_by_itself(
    base: str, code: Code, name: str, tmp_path: Path
) -> None:
    path = written(
        tmp_path, f"base: {base}\nplanner: {{margin: -1, mode: replanning}}\ncontroller: {{kind: lqr, x: 1}}\n"
    )
    with pytest.raises(InputError) as caught:
        load_method(path)
    found = caught.value.diagnostics
    assert [(each.line, each.path) for each in found] == [(3, "base"), (4, "planner.margin"), (5, "controller.x")]
    assert found[0].code is code
    assert name in str(found[0])


def test_what_a_base_might_have_is_not_missed_while_it_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "broken.yaml").write_text("name: [\n")
    path = written(tmp_path, "name: mine\nbase: broken.yaml\nplanner: {on_board: contingency}\n")
    found = problems_of(path)
    assert {(file, key) for file, _, _, key in found} == {("broken.yaml", ""), ("mine.yaml", "title")}


@pytest.mark.parametrize("files", [["mine"], ["mine", "second"], ["mine", "second", "third"]])
def test_a_file_that_is_based_on_itself_is_refused_where_the_circle_closes(files: list[str], tmp_path: Path) -> None:
    for name, base in zip(files, [*files[1:], files[0]], strict=True):
        written(tmp_path, f"base: {base}.yaml\n", name)
    assert problems_of(tmp_path / "mine.yaml") == [(f"{files[-1]}.yaml", 3, 7, "base")]


def test_a_circle_beyond_the_file_is_refused_too(tmp_path: Path) -> None:
    written(tmp_path, "base: second.yaml\n", "second")
    assert problems_of(written(tmp_path, "base: second.yaml\n")) == [("second.yaml", 3, 7, "base")]


def test_the_example_of_the_documentation_is_what_it_says(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "driving.md").read_text(encoding="utf-8")
    example = text[text.index("### A method that is based on another") :].split("```yaml\n")[1].split("```")[0]
    found, base = method(tmp_path, example), load_method("adaptive-kraft")
    assert base.planner.bound is not None
    bound = base.planner.bound.model_copy(update={"level": 0.95})
    assert found.planner == base.planner.model_copy(update={"margin": 0.02, "bound": bound})
    fixed = "name: fixed\ntitle: Fixed\nbase: adaptive-kraft\nplanner: {bound: null, safety: {delta: 0.01}}\n"
    assert method(tmp_path, fixed).planner.bound is None


def test_null_is_no_base(tmp_path: Path) -> None:
    found = method(tmp_path, "base: null\nplanner: {mode: one-shot}\ncontroller: {kind: open_loop}\n")
    assert found.planner.mode == "one-shot"


def test_the_manifest_has_the_resolved_method_and_a_changed_base_is_another_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    written(tmp_path, "base: kraft\nplanner: {margin: 0.2}\n", "first")
    path = written(tmp_path, "base: first.yaml\nplanner: {lead: 0.3}\n")
    options: dict[str, Any] = {"scenarios": ["turns"], "methods": [path], "trials": 2, "out": tmp_path / "out"}
    evaluate(**options, observer=StoppingObserver(1))
    recorded = json.loads((tmp_path / "out" / "manifest.json").read_text())["methods"]["mine"]["content"]
    planner = load_method("kraft").planner.model_copy(update={"margin": 0.2, "lead": 0.3})
    assert recorded["planner"] == planner.model_dump(mode="json")
    assert "base" not in recorded
    written(tmp_path, "base: kraft\nplanner: {margin: 0.1}\n", "first")
    with pytest.raises(InputError) as caught:
        evaluate(**options, resume=True)
    assert [each.path for each in caught.value.diagnostics] == ["methods.mine.content.planner.margin"]


def test_the_schema_for_editors_requires_nothing_that_a_base_has() -> None:
    schema = json.loads((bundled.folder("method") / "method.schema.json").read_text(encoding="utf-8"))
    assert set(schema["required"]) == {"name", "title"}
    assert schema["if"]["required"] == ["base"]
    assert set(schema["else"]["required"]) == {"name", "title", "planner", "controller"}
    for name, part in schema["$defs"].items():
        if name.endswith("Partial"):
            assert "required" not in part
            whole = schema["$defs"][name.removesuffix("Partial")]
            assert part["properties"].keys() == whole["properties"].keys()
            assert part["additionalProperties"] is False
    text = json.dumps(schema["properties"])
    assert text.count("#/$defs/") == text.count('Partial"') > 10
