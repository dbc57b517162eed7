"""Two evaluations are compared trial by trial, and what is not the same in both is said."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support import fake_trials
from support.evaluation import StoppingObserver, refused

from kraft.errors import Code, InputError
from kraft.evaluation import compare, evaluate
from kraft.evaluation.comparison import Comparison, PairedRow
from kraft.evaluation.comparison_table import comparison_tables, folders, remarks
from kraft.provenance import MISSING
from kraft.trial.measures import Step
from kraft.trial.result import Outcome, TrialResult, TrialSpec

FIRST = {"turns": (0, 1, 2, 3, 4, 5), "slip": (0, 1)}
"""Seeds that the first version succeeds in; the others collide."""
SECOND = {"turns": (2, 3, 4, 5, 6, 7, 8, 9), "slip": (0, 1)}
LATER = {2: 0.5, 3: -0.1, 4: 0.2}
"""How much later the second version arrives, s, by seed."""


def driven(spec: TrialSpec, successes: dict[str, tuple[int, ...]], later: dict[int, float]) -> TrialResult:
    succeeds = spec.seed in successes[spec.scenario.name]
    time = 5.0 + spec.seed + later.get(spec.seed, 0.0) * (spec.scenario.name == "turns")
    found = fake_trials.quick(spec)
    step = Step(0.0, (time, float(succeeds), 0.0), 0.0, found.steps[0].estimate, found.steps[0].command, 0)
    outcome = Outcome.SUCCESS if succeeds else Outcome.COLLISION
    return replace(found, outcome=outcome, time=time, steps=(step,))


def first(spec: TrialSpec) -> TrialResult:
    return driven(spec, FIRST, {})


def second(spec: TrialSpec) -> TrialResult:
    return driven(spec, SECOND, LATER)


def run(patch: pytest.MonkeyPatch, out: Path, trial: fake_trials.Trial, trials: int = 10, **options: Any) -> Path:
    fake_trials.use(patch, trial, inline=True)
    evaluate(**({"scenarios": ["turns", "slip"], "methods": ["kraft"], "trials": trials, "out": out} | options))
    return out


@pytest.fixture
def versions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Comparison:
    return compare(run(monkeypatch, tmp_path / "a", first), run(monkeypatch, tmp_path / "b", second))


def test_of_many_rows_those_are_counted_whose_drives_are_all_the_same(
    versions: Comparison, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("kraft.evaluation.comparison_table.ROWS_MAX", 1)
    assert [row[0] for row in comparison_tables(versions)[0].rows] == ["turns"]
    assert list(remarks(versions))[1] == "1 row whose drives are all the same has no line above; --json has all"
    same = compare(tmp_path / "a", tmp_path / "a")
    assert [table.title for table in comparison_tables(same)] == ["all entries"]
    assert next(remarks(same)).startswith("2 rows whose drives are all the same have")


@pytest.mark.parametrize(
    ("other", "why"),
    [
        ({"scenarios": ["boxes"]}, "no entry is in both"),
        ({"methods": ["mppi"]}, "no method is in both"),
        ({"seed": 50}, "no seed is in both"),
    ],
)
def test_evaluations_without_a_common_trial_say_what_they_do_not_share(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, other: dict[str, Any], why: str
) -> None:
    a = run(monkeypatch, tmp_path / "a", fake_trials.quick, 2)
    b = run(monkeypatch, tmp_path / "b", fake_trials.quick, 2, **other)
    with pytest.raises(InputError) as caught:
        compare(a, b)
    assert [each.problem for each in caught.value.diagnostics] == [f"has no trial in common with {a}: {why}"]


def of_entry(comparison: Comparison, entry: str) -> PairedRow:
    (found,) = [row for row in comparison.rows if row.entry == entry]
    return found


def test_trials_are_paired_by_entry_method_and_seed(versions: Comparison) -> None:
    turns = of_entry(versions, "turns")
    assert turns.pairs == 10
    assert [(side["success"], side["collision"]) for side in turns.counts] == [(6, 4), (8, 2)]
    assert (turns.gained, turns.lost, turns.p) == (4, 2, pytest.approx(44 / 64))  # 2 (1 + 6 + 15) / 2^6
    assert turns.both == 4
    assert turns.time_difference == pytest.approx((0.5 - 0.1 + 0.2 + 0.0) / 4)
    assert turns.time_interval is not None
    low, high = turns.time_interval
    assert (low + high) / 2 == pytest.approx(0.15)
    assert (high - low) / 2 == pytest.approx(3.1824 * math.sqrt(0.07) / 2, rel=1e-4)  # t of three degrees of freedom
    assert (turns.digests, turns.identical) == (10, 1)  # seed 5 alone has the same outcome and time in both


def test_what_is_the_same_in_both_has_no_difference(versions: Comparison) -> None:
    slip = of_entry(versions, "slip")
    assert (slip.gained, slip.lost, slip.p, slip.time_difference, slip.time_interval) == (0, 0, 1.0, 0.0, None)
    assert (slip.digests, slip.identical) == (10, 10)
    assert versions.differences == ()
    assert list(remarks(versions))[-1] == "scenarios, methods, vehicles and versions are the same in A and B"


def test_all_entries_together_are_tested_over_entries(versions: Comparison) -> None:
    (total,) = versions.totals
    assert (total.entry, total.pairs, total.gained, total.lost) == ("", 20, 4, 2)
    assert total.p == 1.0  # one of two entries differs: any sign of it is as likely
    assert total.time_difference == pytest.approx(0.6 / 6)
    assert total.time_interval is None  # of two entries
    assert [table.title for table in comparison_tables(versions)] == ["", "all entries"]


def test_so_few_pairs_or_entries_that_no_outcome_differs_are_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    a = run(monkeypatch, tmp_path / "a", lambda spec: driven(spec, {"turns": ()}, {}), 6, scenarios=["turns"])
    everything = {"turns": tuple(range(6))}
    b = run(monkeypatch, tmp_path / "b", lambda spec: driven(spec, everything, {}), 6, scenarios=["turns"])
    c = run(monkeypatch, tmp_path / "c", lambda spec: driven(spec, everything, {}), 5, scenarios=["turns"])
    assert [row.p < 0.05 for other in (b, c) for row in compare(a, other).rows] == [True, False]
    said = [[line for line in remarks(compare(a, other)) if "too few" in line] for other in (b, c)]
    few = "1 row has fewer than 6 pairs, too few for successes that differ (p is 0.05 or more whatever the outcomes)"
    assert said == [[], [few]]


def test_drives_that_are_all_the_same_are_not_said_to_be_too_few(versions: Comparison, tmp_path: Path) -> None:
    a = tmp_path / "a"
    (few,) = [line for line in remarks(versions) if "too few" in line]
    assert few.startswith("there are fewer than 6 entries, too few for successes that differ over all entries (p is ")
    assert not [line for line in remarks(compare(a, a)) if "too few" in line]
    assert list(folders(compare(a, a / ".." / "a")))[2:] == ["A and B are the same folder"]
    assert len(list(folders(versions))) == 2


def test_an_entry_alone_has_no_total(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = run(monkeypatch, tmp_path / "a", first, scenarios=["turns"])
    found = compare(out, out)
    assert (found.totals, of_entry(found, "turns").identical) == ((), 10)


def test_only_seeds_rows_and_entries_of_both_are_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    a = run(monkeypatch, tmp_path / "a", first, methods=["kraft", "oneshot-openloop"], seed=0)
    b = run(monkeypatch, tmp_path / "b", first, trials=4, seed=8, scenarios=["turns"], methods=["kraft", "oracle"])
    found = compare(a, b)
    (row,) = found.rows
    assert (row.entry, row.method, row.pairs) == ("turns", "kraft", 2)
    assert found.alone == (
        (("slip", "kraft"), ("slip", "oneshot-openloop"), ("turns", "oneshot-openloop")),
        (("turns", "oracle"),),
    )
    assert {".".join(each.path): (each.one, each.other) for each in found.differences} == {
        "trials": (10, 4), "seed": (0, 8),
    }  # fmt: skip


def test_what_only_one_has_is_not_said_to_be_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = (
        run(monkeypatch, tmp_path / name, first, scenarios=[*names]) for name, names in (("a", FIRST), ("b", ["slip"]))
    )
    said = list(remarks(compare(a, b)))
    assert said[-2:] == [
        "only in A: turns, kraft",
        "scenarios, methods, vehicles and versions that both have are the same in A and B",
    ]


def test_a_scenario_with_another_content_is_marked_and_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    a = run(monkeypatch, tmp_path / "a", first)
    b = run(monkeypatch, tmp_path / "b", first, settings={"sensing.noise_scale": 2}, scenarios=["slip"])
    found = compare(a, b)
    assert not of_entry(found, "slip").same_scenario
    assert {".".join(each.path): (each.one, each.other) for each in found.differences} == {
        "scenarios.slip.content.sensing.noise_scale": (1.0, 2.0)
    }
    assert comparison_tables(found)[0].rows[0][0] == "slip *"
    said = list(remarks(found))
    assert said[-2] == ("*: A and B have different versions of these scenarios, see the next lines: slip")
    assert said[-1] == "scenarios.slip.content.sensing.noise_scale: 1.0 in A, 2.0 in B"


def test_a_total_over_a_changed_scenario_is_not_of_the_same_scenarios(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    a = run(monkeypatch, tmp_path / "a", first)
    b = run(monkeypatch, tmp_path / "b", first, settings={"sensing.noise_scale": 2})
    assert [row.same_scenario for row in compare(a, b).totals] == [False]


def test_versions_of_a_method_and_of_a_vehicle_are_told_by_their_keys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = tmp_path / "mine.yaml"
    text = "name: mine\ntitle: Mine\nplanner: {mode: replanning}\ncontroller: {kind: open_loop}\n"
    folders = []
    for name, change in (("a", ""), ("b", ", margin: 0.1")):
        mine.write_text(text.replace("replanning", f"replanning{change}"))
        vehicle = "mushr" if name == "a" else "mushr-lag"
        folders.append(run(monkeypatch, tmp_path / name, first, methods=[mine], vehicle=vehicle))
    found = {".".join(each.path): (each.one, each.other) for each in compare(*folders).differences}
    assert found == {
        "methods.mine.content.planner.margin": (0.0, 0.1),
        "rows.turns, mine": ("mushr", "mushr-lag"),
        "rows.slip, mine": ("mushr", "mushr-lag"),
    }


def test_an_unfinished_evaluation_is_compared_as_far_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    a = run(monkeypatch, tmp_path / "a", first)
    b = run(monkeypatch, tmp_path / "b", first, observer=StoppingObserver(7))
    found = compare(a, b)
    assert (found.rows[0].pairs, found.missing) == (7, (0, 13))
    assert list(folders(found))[1] == f"B: {b}, 13 trials not run yet"


def test_failed_trials_count_as_not_successful_and_have_no_digest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(spec: TrialSpec) -> TrialResult:
        if spec.seed == 1:
            raise ZeroDivisionError
        return first(spec)

    a, b = run(monkeypatch, tmp_path / "a", first), run(monkeypatch, tmp_path / "b", fails)
    found = compare(a, b)
    turns = of_entry(found, "turns")
    assert (turns.lost, turns.gained, turns.digests, turns.identical, turns.counts[1]["failed"]) == (1, 0, 9, 9, 1)
    assert "failed A/B" in comparison_tables(found)[0].heading


def test_evaluations_without_a_trial_in_common_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    a = run(monkeypatch, tmp_path / "a", first, scenarios=["turns"])
    b = run(monkeypatch, tmp_path / "b", first, scenarios=["slip"])
    with refused((b, Code.MISMATCH)):
        compare(a, b)


def test_what_is_wrong_with_both_folders_is_reported_at_once(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    with refused((tmp_path / "a", Code.NOT_FOUND), (tmp_path / "b", Code.NOT_FOUND)):
        compare(tmp_path / "a", tmp_path / "b")


def test_a_value_that_one_manifest_lacks_is_absent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    a = run(monkeypatch, tmp_path / "a", first)
    b = run(monkeypatch, tmp_path / "b", first)
    manifest = a / "manifest.json"
    manifest.write_text(
        manifest.read_text().replace('"mujoco"', '"other"', 1).replace('"versions": {', '"versions": {\n"mujoco": "3",')
    )
    found = compare(a, b)
    (difference,) = [each for each in found.differences if each.path == ("versions", "other")]
    assert difference.other is MISSING
    assert any(line.startswith("versions.other: ") and line.endswith(" in A, absent in B") for line in remarks(found))
