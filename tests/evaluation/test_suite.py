"""Suites and sweeps: the entries of an evaluation."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from support import fake_trials
from support.diagnostics import located, raised

from kraft.config import bundled
from kraft.errors import Code
from kraft.evaluation import evaluate
from kraft.evaluation.suite import entries_of, load_suite
from kraft.scenario import load_scenario
from kraft.trial.result import TrialResult, TrialSpec

SCENES = {"turns", "boxes", "slope", "slip", "bump", "movable"}


def suite_file(folder: Path, entries: str) -> Path:
    path = folder / "suite.yaml"
    path.write_text(f"name: mine\nentries:\n{entries}")
    return path


def test_the_papers_suite_is_the_six_scenes() -> None:
    found = load_suite("paper")
    assert {entry.name for entry in found} == {entry.scenario.name for entry in found} == SCENES
    assert all(entry.scenario == load_scenario(entry.name) for entry in found)


def test_the_hard_suite_changes_every_scene() -> None:
    found = load_suite("hard")
    assert len(found) == len({entry.name for entry in found}) == 30
    assert {entry.scenario.name for entry in found} == SCENES
    for entry in found:
        assert entry.settings
        assert entry.scenario != load_scenario(entry.reference)


def test_an_entry_names_a_scenario_beside_its_suite(tmp_path: Path) -> None:
    scene = "name: small\nbounds: {x: [0, 4], y: [0, 4]}\nstart: {x: 1, y: 1, heading_deg: 0}\ngoal: {center: [3, 3], radius: 0.5}\n"
    (tmp_path / "scene.yaml").write_text(scene)
    path = suite_file(tmp_path, "  - {name: a, scenario: scene.yaml, set: {sensing.rate_hz: 5}}\n")
    (entry,) = load_suite(path)
    assert (entry.name, entry.scenario.name, entry.scenario.sensing.rate_hz) == ("a", "small", 5.0)
    assert load_scenario(entry.reference, entry.settings) == entry.scenario


def test_paths_that_a_suite_sets_are_recorded_as_paths_from_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page and its commands load the scenarios again, from there and not from the folder of the suite."""
    (tmp_path / "car.yaml").write_text(bundled.find("vehicle", "mushr").read_text())
    (folder := tmp_path / "suites").mkdir()
    truths = "truth: {model: ../car.yaml}", "truth.model: ../car.yaml", "vehicle: mushr"
    entries = [f"  - {{name: e{k}, scenario: turns, set: {{{each}}}}}\n" for k, each in enumerate(truths)]
    suite_file(folder, "".join(entries) + "  - {name: v, scenario: turns, set: {vehicle: ../car.yaml}}\n")
    monkeypatch.chdir(tmp_path)
    found = load_suite("suites/suite.yaml")
    assert [each.settings for each in found] == [
        {"truth": {"model": "car.yaml"}}, {"truth.model": "car.yaml"}, {"vehicle": "mushr"},
        {"vehicle": "car.yaml"},
    ]  # fmt: skip
    for each in found:
        assert load_scenario(each.reference, each.settings) == each.scenario


def test_every_problem_of_a_suite_has_its_place(tmp_path: Path) -> None:
    path = suite_file(
        tmp_path,
        "  - {name: a, scenario: boxs}\n"
        "  - {name: b, scenario: boxes, set: {sensing.noise_scal: 3, sensing.dropout: 1.5}}\n"
        "  - {name: b, scenario: boxes, set: {sensing.rate_hz: x, a..b: 1}}\n"
        "  - {scenario: turns}\n",
    )
    problems = raised(lambda: load_suite(path))
    assert located(problems) == [
        "3:25 entries[0].scenario not-found",
        "4:58 sensing.noise_scal unknown",
        "4:78 sensing.dropout value",
        "5:12 entries[2].name duplicate",
        "5:55 sensing.rate_hz type",
        "5:58 a..b syntax",
        "6:5 entries[3].name missing",
    ]
    assert {d.file for d in problems} == {str(path)}


@pytest.mark.parametrize("text", ["name: x\n", "name: x\nentries: []\n", "name: x\nentries: [{name: a}]\n"])
def test_a_suite_without_worlds_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "suite.yaml").write_text(text)
    assert raised(lambda: load_suite(tmp_path / "suite.yaml"))


def test_values_are_varied_in_all_combinations() -> None:
    found = entries_of(["turns", "slip"], vary={"sensing.rate_hz": [5, 30], "sensing.noise_scale": [0, 2]})
    assert [entry.name for entry in found[:4]] == [
        "turns sensing.rate_hz=5, sensing.noise_scale=0",
        "turns sensing.rate_hz=5, sensing.noise_scale=2",
        "turns sensing.rate_hz=30, sensing.noise_scale=0",
        "turns sensing.rate_hz=30, sensing.noise_scale=2",
    ]
    assert {entry.base for entry in found} == {"turns", "slip"}
    assert [entry.scenario.sensing.rate_hz for entry in found] == [5.0, 5.0, 30.0, 30.0] * 2


def test_a_varied_key_may_need_one_that_is_set() -> None:
    settings = {"goal.heading_tolerance_deg": 10}
    found = entries_of(["turns"], settings=settings, vary={"goal.heading_deg": [0, 90]})
    assert [entry.scenario.goal.heading for entry in found] == [0.0, pytest.approx(math.pi / 2)]
    assert len(raised(lambda: entries_of(["turns"], settings=settings))) == 1


def test_what_an_entry_sets_is_not_set_again() -> None:
    problems = raised(lambda: entries_of([], suite="hard", settings={"sensing.message_loss": 0.0}))
    assert {d.code for d in problems} == {Code.DUPLICATE}
    assert len(problems) == 3  # the entries with lost messages


def test_wrong_values_of_set_and_varied_keys_are_reported_together() -> None:
    settings, vary = {"sensing.noise_scal": 2}, {"sensing.rate_hz": ["x", 5], "sensing.dropout": [0.1, 2]}
    problems = raised(lambda: entries_of(["turns", "slip"], settings=settings, vary=vary))
    assert sorted(located(problems)) == [
        "sensing.dropout value", "sensing.noise_scal unknown", "sensing.rate_hz type",
    ]  # fmt: skip
    assert {d.file for d in problems} == {"settings", "vary"}


def test_keys_of_a_loaded_scenario_cannot_be_set() -> None:
    problems = raised(lambda: entries_of([load_scenario("turns")], settings={"sensing.rate_hz": 5}))
    assert [d.code for d in problems] == [Code.CONFLICT]


def test_scenarios_and_a_suite_are_not_given_together() -> None:
    problems = raised(lambda: evaluate(["turns"], ["kraft"], 1, suite="hard"))
    assert [(d.file, d.code) for d in problems] == [("suite", Code.CONFLICT)]


def by_noise(spec: TrialSpec) -> TrialResult:
    """A trial whose end depends on the noise."""
    found = fake_trials.quick(spec)
    return TrialResult(**{**found.__dict__, "time": 10.0 + spec.scenario.sensing.noise_scale})


def test_each_entry_is_driven_in_its_own_scenario(monkeypatch: pytest.MonkeyPatch) -> None:
    fake_trials.use(monkeypatch, by_noise, inline=True)
    found = evaluate(["turns"], ["kraft"], 2, vary={"sensing.noise_scale": [0, 3]}, settings={"goal.radius": 0.3})
    assert [(row.entry, row.scenario, row.t_s) for row in found.rows] == [
        ("turns sensing.noise_scale=0", "turns", 10.0),
        ("turns sensing.noise_scale=0", "turns", 10.0),
        ("turns sensing.noise_scale=3", "turns", 13.0),
        ("turns sensing.noise_scale=3", "turns", 13.0),
    ]
    assert [dict(result.settings) for result in found.summary.results] == [
        {"goal.radius": 0.3, "sensing.noise_scale": 0},
        {"goal.radius": 0.3, "sensing.noise_scale": 3},
    ]
    assert all(result.paper is None for result in found.summary.results)


@pytest.mark.parametrize("suite", [None, "hard"])
@pytest.mark.parametrize("values", [[1, 1], [2, 1, 1.0]])
def test_a_value_that_is_varied_twice_is_refused_also_in_python(suite: str | None, values: list[float]) -> None:
    scenarios = [] if suite else ["turns"]
    (problem,) = raised(lambda: entries_of(scenarios, suite=suite, vary={"sensing.noise_scale": values}))
    assert (problem.file, problem.path, problem.code) == ("vary", "sensing.noise_scale", Code.DUPLICATE)
