"""Suites, sweeps and measures in `report.html`: what many entries look like, and that the numbers are the summary's."""

from __future__ import annotations

import json
import random
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import pytest
from support import fake_trials
from support.html import Tags, text_of
from support.paths import ROOT

from kraft.driving.messages import ContingencyOrigin
from kraft.evaluation import Evaluation, evaluate
from kraft.evaluation.experiment import experiment_of
from kraft.evaluation.journal import trial_row
from kraft.evaluation.manifest import manifest_of
from kraft.evaluation.report import Results, page, read_results
from kraft.evaluation.report import results as of_report
from kraft.evaluation.report.sweeps import GREY, Statistic, label_of, nice_ticks, sweep_pictures, sweeps
from kraft.evaluation.statistics import wilson
from kraft.evaluation.summary import measures_json, summarise, tabulate
from kraft.text import percent
from kraft.trial.measures import Consistency, Kept, Measures
from kraft.trial.result import Outcome, TrialResult, TrialSpec
from kraft_cli.work.run import run_command

METHODS = ("oneshot-openloop", "kraft")


@pytest.fixture(autouse=True)
def inline(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    monkeypatch.chdir(tmp_path)


def run(out: str = "out", *, trials: int = 3, **options: Any) -> Evaluation:
    arguments = {"scenarios": ("turns", "slip"), "methods": METHODS, **options}
    return evaluate(trials=trials, seed=5, out=out, command_line=run_command, **arguments)


def measured(spec: TrialSpec) -> TrialResult:
    """A trial with all measures, of which only `kraft` has a clearance and a covariance."""
    chance = random.Random(f"{spec.scenario.name} {spec.method.name} {spec.seed} {spec.scenario.sensing.noise_scale}")
    found = fake_trials.quick(spec)
    cycles = tuple(
        replace(cycle, contingency_origin=chance.choice(list(ContingencyOrigin)))
        if cycle.kind == "contingency"
        else cycle
        for cycle in found.cycles
    )
    origins = Counter(cycle.contingency_origin for cycle in cycles)
    kraft = spec.method.name == "kraft"
    measures = Measures(
        plans=Kept(ticks=100, held=chance.randint(0, 100), delta_sum_m=2.5) if kraft else Kept(),
        deviation_mm=tuple(tuple(chance.randint(k, 10 * k + 5) for _ in range(90)) for k in range(10)),
        emergencies=origins[ContingencyOrigin.EMERGENCY],
        in_hand=origins[ContingencyOrigin.IN_HAND],
        compared=8,
        regressions={"unsafe": chance.randint(0, 3)},
        consistency=Consistency(poses=100, sum=250.0, in_band=93) if kraft else None,
    )
    success = chance.random() > 0.2 * float(spec.scenario.sensing.noise_scale)
    outcome = Outcome.SUCCESS if success else Outcome.COLLISION
    return replace(found, cycles=cycles, measures=measures, outcome=outcome, obstacle=None if success else "first box")


def swept(monkeypatch: pytest.MonkeyPatch, vary: dict[str, list[Any]], **options: Any) -> Evaluation:
    fake_trials.use(monkeypatch, measured, inline=True)
    return run(vary=vary, **options)


def pictures(results: Results) -> list[Element]:
    return sweep_pictures(sweeps(results), results.methods)


def test_points_of_a_sweep_are_at_their_values_and_shares(monkeypatch: pytest.MonkeyPatch) -> None:
    found = swept(monkeypatch, {"sensing.noise_scale": [4, 0, 1]}, methods=["kraft"], trials=6)
    (drawing,) = pictures(read_results(Path("out")))
    marks = {str(mark[0].text): mark for mark in drawing.iter("circle") if len(mark)}
    texts = {str(label.text): label for label in reversed(list(drawing.iter("text")))}  # those of the upper row
    assert "noise scale" in texts
    y0, y1 = (float(texts[text].get("y") or 0) - 4.0 for text in ("0%", "100%"))
    places = {"turns": dict[float, float](), "slip": dict[float, float]()}
    for result in found.summary.results:
        value = result.settings["sensing.noise_scale"]
        text = f"{result.entry}, KRAFT: {result.success} of {result.trials} succeeded, 95 % interval "
        (mark,) = (mark for title, mark in marks.items() if title.startswith(text))
        low, high = result.interval
        assert f"{text}{low:.0%} to {high:.0%}" in marks
        height = (float(mark.get("cy") or 0) - y0) / (y1 - y0)
        assert height == pytest.approx(result.success / result.trials, abs=1e-3)
        places[result.scenario][value] = float(mark.get("cx") or 0)
    for xs in places.values():
        assert (xs[1] - xs[0]) / (xs[4] - xs[0]) == pytest.approx(0.25, abs=1e-3)
    assert drawing.get("xmlns") == "http://www.w3.org/2000/svg"
    values = [e.text for e in drawing.iter("text") if (e.get("fill"), e.get("text-anchor")) == (GREY, "middle")]
    assert values == ["0", "1", "4"] * 2  # below each panel


def test_shares_and_times_of_a_sweep_are_those_of_the_summary(monkeypatch: pytest.MonkeyPatch) -> None:
    found = swept(monkeypatch, {"sensing.noise_scale": [0, 2, 4]}, trials=6)
    results = read_results(Path("out"))
    (sweep,) = sweeps(results)
    assert (sweep.axis.key, sweep.axis.places) == ("sensing.noise_scale", (0.0, 2.0, 4.0))
    points = {
        (p.result.entry, p.result.method): p for panel in sweep.panels.values() for line in panel.values() for p in line
    }
    assert list(sweep.panels) == ["turns", "slip"]
    assert len(points) == len(found.summary.results) == 12
    for result in found.summary.results:
        point = points[result.entry, result.method]
        assert point.place == result.settings["sensing.noise_scale"]
        assert point.success == Statistic(result.success / result.trials, result.interval)
        assert point.collision == Statistic(result.collision / result.trials, wilson(result.collision, result.trials))
        assert (None if point.time is None else point.time.value) == result.t_ex


def test_with_two_varied_keys_the_one_with_most_values_is_on_the_axis(monkeypatch: pytest.MonkeyPatch) -> None:
    vary = {"sensing.communication_delay": [0, 0.2], "sensing.preset": ["single-tag", "planar"],
            "sensing.noise_scale": [1, 2, 4]}  # fmt: skip
    swept(monkeypatch, vary, trials=1, scenarios=["turns"])
    results = read_results(Path("out"))
    assert [(sweep.axis.key, dict(sweep.fixed)) for sweep in sweeps(results)] == [
        ("sensing.noise_scale", {"sensing.communication_delay": delay, "sensing.preset": preset})
        for delay in (0, 0.2)
        for preset in ("single-tag", "planar")
    ]
    words = [{str(label.text) for label in drawing.iter("text")} for drawing in pictures(results)]
    assert all("communication delay = 0.2 s, preset = planar" in found for found in words[3:])
    saved = [attributes["href"] for tag, attributes in Tags(page(results)).found if "download" in attributes]
    assert [ElementTree.fromstring(unquote(str(href).split(",", 1)[1])).tag.rpartition("}")[2] for href in saved] == [
        "svg"
    ] * 4


def test_values_that_are_not_numbers_stand_in_their_order(monkeypatch: pytest.MonkeyPatch) -> None:
    swept(monkeypatch, {"sensing.preset": ["single-tag", "planar"]}, trials=1)
    (sweep,) = sweeps(read_results(Path("out")))
    assert (sweep.axis.places, sweep.axis.texts) == ((0.0, 1.0), ("single-tag", "planar"))
    assert sweep.axis.places == tuple(range(len(sweep.axis.places)))


def test_without_varied_keys_there_is_no_sweep() -> None:
    run()
    assert sweeps(read_results(Path("out"))) == []


@pytest.mark.parametrize(
    ("key", "label"),
    [
        ("sensing.communication_delay", "communication delay, s"),
        ("sensing.noise_scale", "noise scale"),
        ("sensing.rate_hz", "rate, Hz"),
        ("truth.tilt.angle_deg", "angle, degrees"),
        ("truth.tilt.angle", "angle, rad"),
        ("planning.safety.delta", "delta, m"),
        ("obstacles[0].box.size", "size, m"),
    ],
)
def test_the_axis_of_a_sweep_has_the_unit_of_its_key(key: str, label: str) -> None:
    assert label_of(key) == label


@pytest.mark.parametrize(("low", "high"), [(9.0, 9.0), (8.9, 23.6), (0.0, 0.0), (0.011, 0.5), (3.0, 4321.0)])
def test_ticks_are_round_and_enclose_all_values(low: float, high: float) -> None:
    ticks = nice_ticks(low, high)
    assert ticks[0] <= low <= high <= ticks[-1]
    assert 3 <= len(ticks) <= 8
    assert all(float(f"{tick:.3g}") == pytest.approx(tick) for tick in ticks)


def test_the_measures_are_those_of_the_summary(monkeypatch: pytest.MonkeyPatch) -> None:
    fake_trials.use(monkeypatch, measured, inline=True)
    found = run(trials=8)
    tags = Tags(Path("out/report.html").read_text())
    text = text_of(tags)
    assert tags.classes("table")["measures"] == 2
    assert tags.classes("svg")["deviation"] == 4
    assert tags.classes("line")["delta"] == 3  # in each entry, and over both
    assert text.count("covariance: NEES") == 2
    assert "messages lost" not in text
    assert "A clearance that is fixed in the settings of a method is no bound of what the car may deviate" in text
    assert text.count("it may come with a clearance of some centimetres") == 2  # at the entries and at the list
    for result in found.summary.results:
        content = measures_json(result.measures)
        safe = result.contingencies - content["emergencies"] - content["contingencies_in_hand"]
        assert f"{safe} / {content['contingencies_in_hand']} / {content['emergencies']} of " in text
        assert f"{content['regressions']} of {content['cycles_compared']}" in text
        if result.method == "kraft":
            assert f"{content['delta_coverage']:.0%} {1000 * content['delta_mean_m']:.0f} mm" in text
            assert f"{content['consistency']['nees_mean']:.3g} {content['consistency']['nees_in_band']:.0%}" in text
        last = content["deviation_m"][-1]
        for name, key in (("median", "p50"), ("99 %", "p99")):
            (first,) = content["deviation_m"][:1]
            assert f"{name}: {1000 * first[key]:.0f} mm at first, {1000 * last[key]:.0f} mm at last" in text


def test_a_share_that_is_not_all_is_not_rounded_to_all() -> None:
    shares = (None, 0.0, 0.094, 0.996, 0.9996, 1.0)
    assert [percent(share) for share in shares] == ["-", "0%", "9%", "99.6%", "99.9%", "100%"]


def suite_of(count: int) -> Path:
    entries = [{"name": f"world-{k}", "scenario": "turns", "set": {"sensing.noise_scale": k / 8}} for k in range(count)]
    path = Path("many.yaml")
    path.write_text(json.dumps({"name": "many", "entries": entries}))
    return path


def test_many_entries_are_rows_with_totals_and_closed_sections(monkeypatch: pytest.MonkeyPatch) -> None:
    fake_trials.use(monkeypatch, measured, inline=True)
    found = run(scenarios=None, suite=suite_of(9))
    tags = Tags(Path("out/report.html").read_text())
    text = text_of(tags)
    assert tags.classes("details")["entry"] == 9
    assert tags.classes("tr")["totals"] == 1
    links = {str(attributes["href"]) for tag, attributes in tags.found if tag == "a"}
    assert {link for link in links if link.startswith("#world")} == {f"#world-{k}" for k in range(9)}
    assert {f"world-{k}" for k in range(9)} <= {attributes.get("id") for _, attributes in tags.found}
    assert "world-3 turns, sensing.noise_scale = 0.375" in text
    for method in METHODS:
        mine = [row for row in found.rows if row.method == method]
        hit = sum(row.outcome == "collision" for row in mine)
        low, high = wilson(hit, len(mine))
        assert f"{len(mine) - hit} of {len(mine)} " in text
        assert f"{hit} {low:.0%} to {high:.0%}" in text


def test_anchors_of_entries_have_no_spaces_and_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    swept(monkeypatch, {"sensing.camera": [[1, 3, 5], [1, 3, 6]], "sensing.noise_scale": [1, 2]}, trials=1)
    tags = Tags(Path("out/report.html").read_text())
    ids = [str(attributes["id"]) for _, attributes in tags.found if "id" in attributes]
    assert len(set(ids)) == len(ids)
    found = list(read_results(Path("out")).slugs.values())
    assert len(set(found)) == len(found) == 8
    assert set(found) <= set(ids)
    assert not any(re.search(r"\s", each) for each in found)
    links = {a["href"] for tag, a in tags.found if tag == "a" and "download" not in a}
    entries = [link for link in links if not str(link).startswith(("#trial=", "#show"))]
    assert {f"#{each}" for each in found} <= set(entries) <= {f"#{each}" for each in ids}


@pytest.mark.parametrize("name", ["trials", "entries", "sweeps", "replay-time", "filter-method", "trials-more"])
def test_an_entry_with_the_name_of_a_part_of_the_page_has_another_anchor(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    fake_trials.use(monkeypatch, measured, inline=True)
    Path("own.yaml").write_text((ROOT / "scenarios/turns.yaml").read_text().replace("name: turns", f"name: {name}"))
    evaluate(["own.yaml"], ["kraft"], trials=1, out="out")
    assert read_results(Path("out")).slugs == {name: f"entry-{name}"}
    ids = [attributes["id"] for _, attributes in Tags(Path("out/report.html").read_text()).found if "id" in attributes]
    assert len(set(ids)) == len(ids)


def test_the_anchor_of_an_entry_with_the_name_of_a_part_of_the_page_is_not_that_of_another_entry() -> None:
    names = ("trials", "entry-trials")
    manifest = of_report.Manifest.model_validate({
        "arguments": {}, "began": "", "trials": 1, "seed": 0, "realtime": False, "vehicles": {},
        "rows": [{"entry": name, "scenario": "turns", "method": "kraft"} for name in names],
        "scenarios": {name: {"sha256": ""} for name in names}, "versions": dict.fromkeys(of_report.VERSIONS, "1"),
    })  # fmt: skip
    results = Results(manifest, {}, tabulate(manifest.names, manifest.seeds, {}, 0.0), {})
    assert results.slugs == {"trials": "entry-entry-trials", "entry-trials": "entry-trials"}


def test_a_page_of_many_entries_is_small_and_resolves_names_once(monkeypatch: pytest.MonkeyPatch) -> None:
    references = of_report._references
    methods = ("kraft", "conservative-kraft", "oneshot-openloop", "oneshot-geometric")
    experiment = experiment_of((), methods, suite=suite_of(30), trials=30)
    by_seed = {seed: measured(TrialSpec.load("turns", seed=seed)) for seed in experiment.seeds}
    rows = {}
    for job in experiment.jobs():
        key = (job.entry, job.method.name, job.seed)
        rows[key] = trial_row(key, by_seed[job.seed], 1.0)
    results = Results.of(experiment, manifest_of(experiment, {}), rows, summarise(experiment, rows, 1.0), run_command)
    assert len(results.rows) == results.expected == 3600
    resolved = []
    monkeypatch.setattr(of_report, "_references", lambda *given: resolved.append(given) or references(*given))
    text = page(results)
    assert len(text.encode()) < 3_000_000
    assert len(resolved) == 2  # scenarios and methods, once for 3,600 trials
