"""The paper's claims are tested on the trials that both methods have, and say what their intervals exclude."""

from __future__ import annotations

from pathlib import Path

import pytest
from support import fake_trials

from benchmarks import results
from benchmarks.claims import (
    FEEDBACK,
    PAPER,
    REPLANNING,
    SAFETY,
    Claim,
    Trial,
    Trials,
    compare,
    comparisons,
    table,
    trials_of,
)
from kraft.config import bundled
from kraft.driving.method import load_method
from kraft.evaluation import evaluate
from kraft.evaluation.report.results import read_results
from kraft.trial.result import Outcome, TrialResult, TrialSpec

CLAIM = Claim(FEEDBACK, "kraft", "replanner-openloop")
COLLIDED = Trial(success=False, collision=True)


def trials(*each: Trial, entries: int = 6) -> Trials:
    return {("paper", f"entry {k % entries}", k // entries): trial for k, trial in enumerate(each)}


def succeeded(time: float) -> Trial:
    return Trial(success=True, collision=False, time=time)


def test_a_method_that_succeeds_where_the_other_collides_is_found_to_help() -> None:
    mine = trials(*[succeeded(9.0 + k % 7) for k in range(60)])
    theirs = trials(*[COLLIDED if k // 6 % 3 == 0 or k == 1 else succeeded(1.1 * (9.0 + k % 7)) for k in range(60)])
    theirs = {**theirs, ("paper", "entry 1", 0): succeeded(1.1 * 10.0)}
    found = compare(CLAIM, mine, theirs)
    assert found is not None
    assert (found.success.gained, found.success.lost) == (23, 0)
    assert found.success.p == pytest.approx(2 / 2**6)
    assert found.collision.difference == pytest.approx(-23 / 60)
    assert found.success.interval[0] > 0.0 > found.collision.interval[1]
    assert found.ratio == pytest.approx(1 / 1.1)
    assert found.verdict.startswith("more successes, fewer collisions")
    mirrored = compare(CLAIM, theirs, mine)
    assert mirrored is not None
    assert mirrored.verdict.startswith("fewer successes, more collisions")


def test_successes_in_one_entry_alone_show_nothing_of_others() -> None:
    """The seeds of an entry are alike: ten successes more in one of six entries may be chance."""
    mine = trials(*[succeeded(9.0)] * 60)
    theirs = trials(*[COLLIDED if k % 6 == 0 else succeeded(9.0) for k in range(60)])
    found = compare(CLAIM, mine, theirs)
    assert found is not None
    assert (found.success.gained, found.success.p) == (10, 1.0)
    assert found.success.interval[0] <= 0.0
    assert found.verdict == "no difference shown"


def test_times_are_compared_where_both_succeeded_and_judged_by_entry() -> None:
    ratios = (0.8, 0.85, 0.9, 0.95, 0.9, 0.85)
    mine = trials(*[succeeded(10.0 * ratios[k % 6]) for k in range(24)])
    theirs = {**trials(*[succeeded(10.0) for k in range(24)]), ("paper", "entry 0", 0): COLLIDED}
    found = compare(CLAIM, mine, theirs)
    assert found is not None
    assert found.entries == 6
    assert found.ratio == pytest.approx(0.8736, abs=1e-3)
    assert found.ratio_interval is not None
    assert 0.8 < found.ratio_interval[0] < found.ratio < found.ratio_interval[1] < 0.95
    assert found.verdict == "faster"  # one success more of 24 excludes nothing


def test_trials_that_one_method_lacks_are_no_pairs() -> None:
    mine, theirs = trials(*[succeeded(9.0)] * 12), trials(*[COLLIDED] * 7)
    found = compare(CLAIM, mine, theirs)
    assert found is not None
    assert found.success.pairs == 7
    assert compare(CLAIM, mine, {}) is None
    assert compare(CLAIM, mine, {("hard", *key[1:]): trial for key, trial in theirs.items()}) is None


def test_equal_methods_show_no_difference_and_keep_an_interval() -> None:
    mine = trials(*[succeeded(9.0)] * 12)
    found = compare(CLAIM, mine, mine)
    assert found is not None
    assert (found.ratio, found.ratio_interval, found.verdict) == (1.0, None, "no difference shown")
    low, high = found.success.interval
    assert low < -0.1 < 0.1 < high


def test_both_suites_are_compared_together_with_methods_from_several_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def drive(spec: TrialSpec) -> TrialResult:
        found = fake_trials.quick(spec)
        outcome = Outcome.SUCCESS if spec.method.name == "conservative-kraft" else Outcome.COLLISION
        return TrialResult(**{**found.__dict__, "outcome": outcome})

    fake_trials.use(monkeypatch, drive, inline=True)
    folders = []
    for scenario, suite in (("turns", "paper"), ("boxes", "hard")):
        for method in ("kraft", "conservative-kraft"):
            folders.append(tmp_path / f"{suite}-{method}")
            evaluate([scenario], [method], 4, 3, 1, folders[-1], arguments={"scenarios": [scenario], "suite": suite})
    found = [read_results(folder) for folder in folders]
    assert sorted({(key[0].split()[0], key[1]) for key in trials_of(found, "kraft")}) == [
        ("hard", "boxes"),
        ("paper", "turns"),
    ]
    (compared,) = comparisons(found)
    assert (compared.claim.part, compared.success.pairs, compared.success.gained) == (SAFETY, 8, 8)
    assert compared.verdict == "no difference shown", "two entries alone"
    shown = table([compared], {"kraft": "KRAFT"})[1]
    assert shown[:4] == ["safety", "conservative-kraft", "KRAFT", "8"]
    assert (shown[5], shown[8], shown[-1]) == ("8 / 0", "8 / 0", compared.verdict)
    out = tmp_path / "results.md"
    assert results.main([*map(str, folders), "--out", str(out)]) == 0
    assert "## What the paper claims" in out.read_text()
    assert "| safety | Conservative KRAFT | KRAFT | 8 |" in out.read_text()


def test_a_trial_that_is_in_two_folders_is_refused_unless_something_was_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)

    def driven(name: str, *methods: str, **settings: float) -> Path:
        evaluate(["turns"], list(methods), 4, 3, 1, tmp_path / name, settings=settings, arguments={})
        return tmp_path / name

    first, other = driven("first", "kraft"), driven("other", "conservative-kraft")
    louder = driven("louder", "kraft", "conservative-kraft", **{"sensing.noise_scale": 2.0})
    found = [read_results(folder) for folder in (first, other, louder)]
    assert len(trials_of(found, "kraft")) == 8
    (compared,) = comparisons(found)
    assert (compared.success.pairs, len({key[:2] for key in trials_of(found, "kraft")})) == (8, 2)
    again = driven("again", "kraft")
    assert results.main([str(first), str(other), str(again), "--out", str(tmp_path / "results.md")]) == 2
    assert "of kraft in turns is in two of them" in capsys.readouterr().err


def test_trials_of_two_scenarios_with_one_name_are_no_pairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    text = (bundled.folder("scenario") / "turns.yaml").read_text(encoding="utf-8")
    for folder, method, content in (
        ("one", "kraft", text),
        ("other", "conservative-kraft", text),
        ("changed", "conservative-kraft", text.replace("radius: 0.25", "radius: 0.3")),
    ):
        (tmp_path / "lab.yaml").write_text(content, encoding="utf-8")
        evaluate([str(tmp_path / "lab.yaml")], [method], 4, 3, 1, tmp_path / folder, arguments={})
    one, other, changed = (read_results(tmp_path / name) for name in ("one", "other", "changed"))
    assert len(comparisons([one, other])) == 1
    assert comparisons([one, changed]) == []


def test_every_method_of_the_claims_exists() -> None:
    assert {claim.part for claim in PAPER} == {REPLANNING, "long horizons", FEEDBACK, SAFETY}
    for claim in PAPER:
        assert load_method(claim.method) != load_method(claim.reference)
