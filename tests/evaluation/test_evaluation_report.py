"""`report.html`: everything is on it, nothing else is needed to read it, and it is made again from the folder alone."""

from __future__ import annotations

import json
import random
import re
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import pytest
from support import fake_trials
from support.evaluation import StoppingObserver, places, refused, room_for
from support.paths import ROOT

from kraft.driving.messages import ContingencyOrigin
from kraft.errors import Code, InputError
from kraft.evaluation import Evaluation, evaluate
from kraft.evaluation.experiment import experiment_of
from kraft.evaluation.manifest import manifest_of
from kraft.evaluation.report import Results, page, read_results, write_report
from kraft.evaluation.report.elements import document, element
from kraft.evaluation.report.floor import floor_plan
from kraft.evaluation.report.measures import percent
from kraft.evaluation.report.sweep_picture import nice_ticks, sweep_pictures
from kraft.evaluation.report.sweeps import Estimate, label_of, sweeps
from kraft.evaluation.row import trial_row
from kraft.evaluation.statistics import wilson
from kraft.evaluation.summary import measures_json, summarise
from kraft.scenario import OccupancyMap, load_scenario
from kraft.trial.measures import Consistency, Kept, Measures
from kraft.trial.result import Outcome, TrialResult, TrialSpec
from kraft_cli.main import main
from kraft_cli.work.run import run_command

METHODS = ("oneshot-openloop", "kraft")


@pytest.fixture(autouse=True)
def inline(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    monkeypatch.chdir(tmp_path)


def run(out: str = "out", *, trials: int = 3, **options: Any) -> Evaluation:
    arguments = {"scenarios": ("turns", "slip"), "methods": METHODS, **options}
    return evaluate(trials=trials, seed=5, out=out, command_line=run_command, **arguments)


class Tags(HTMLParser):
    """Every tag with its attributes, and whether all that is opened is closed."""

    VOID = ("meta",)

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    def classes(self, tag: str) -> Counter[str | None]:
        return Counter(attributes.get("class") for name, attributes in self.found if name == tag)


def value_text(tags: Tags) -> str:
    return " ".join(" ".join(tags.words).split())


def test_an_evaluation_ends_with_a_page_that_needs_nothing_else() -> None:
    run()
    text = Path("out/report.html").read_text(encoding="utf-8")
    tags = Tags(text)
    assert tags.open == []
    assert not re.search(r"https?:|<script|@import|url\(", text.replace("http://www.w3.org", ""))
    assert all("src" not in attributes for _, attributes in tags.found)
    anchors = {attributes["href"] for tag, attributes in tags.found if tag == "a"}
    assert anchors == {"#turns", "#slip"}
    assert {f"#{attributes['id']}" for _, attributes in tags.found if "id" in attributes} == anchors


def test_every_trial_is_a_cell_that_says_how_it_ended_and_how_to_drive_it_again() -> None:
    found = run()
    tags = Tags(page(read_results(Path("out"), run_command)))
    text = value_text(tags)
    for row in found.rows:
        where = f" with {row.obstacle}" if row.obstacle else ""
        assert f"seed {row.seed}: {row.outcome}{where} after {row.t_s:.1f} s" in text
        assert f"kraft run {row.scenario} --method {row.method} --seed {row.seed}" in text
    counts = Counter(row.outcome for row in found.rows)
    bars = Counter((r.scenario, r.method, row.outcome) for r in found.summary.results for row in found.rows
                   if row.key[:2] == (r.scenario, r.method))  # fmt: skip
    segments = Counter(outcome for _, _, outcome in bars)
    drawn = tags.classes("rect")
    assert {name: drawn[name] - segments[name] for name in counts} == dict(counts)


def test_the_numbers_are_those_of_the_summary() -> None:
    found = run(trials=8)
    text = value_text(Tags(page(read_results(Path("out")))))
    assert "32 trials, 2 scenarios, 2 methods" in text
    assert "5 to 12, the same for all methods" in text
    for result in found.summary.results:
        assert f"{result.success} / {result.collision} / {result.timeout} " in text
        assert f"{result.interval[0]:.0%} to {result.interval[1]:.0%}" in text
        assert result.t_ex is None or f"{result.t_ex:.2f}" in text
    assert "paper 27 / 3 / 0" in text
    assert "paper 20 of 30" in text


def test_the_same_page_comes_from_the_folder_alone() -> None:
    run()
    written = Path("out/report.html").read_bytes()
    Path("out/report.html").unlink()
    _, path = write_report(Path("out"), command_line=run_command)
    assert path == Path("out/report.html")
    assert path.read_bytes() == written


def test_without_a_command_line_a_page_names_scenario_method_and_seed_only() -> None:
    found = run()
    text = value_text(Tags(page(read_results(Path("out")))))
    assert "kraft run" not in text
    assert "--method" not in text
    for row in found.rows:
        assert f"seed {row.seed}: {row.outcome}" in text
        assert f"{row.scenario}, {row.method}" in text


def test_a_page_of_an_evaluation_that_was_stopped_says_what_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    run(observer=StoppingObserver(after=4))
    assert not Path("out/report.html").exists()
    assert main(["report", "out"]) == 0
    out, err = capsys.readouterr()
    assert (out, err) == ("out/report.html\n", "8 of 12 trials not run yet\n")
    text = Path("out/report.html").read_text()
    tags = Tags(text)
    assert "8 of 12 trials not run yet: this page is of those that were." in value_text(tags)
    assert tags.classes("rect")["missing"] == 8


def test_failed_trials_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    fake_trials.use(monkeypatch, fake_trials.raises, inline=True)
    evaluate(["turns"], ["kraft"], trials=2, seed=0, out="out")
    text = value_text(Tags(Path("out/report.html").read_text()))
    assert "1 trial failed, which is a defect in kraft" in text
    assert "seed 1: failed: ZeroDivisionError: no speed at all" in text


def test_what_did_not_succeed_is_listed_with_the_command_that_films_it() -> None:
    found = run(trials=8, vehicle="mushr-lag", arguments={"vehicle": "mushr-lag"})
    text = value_text(Tags(Path("out/report.html").read_text()))
    for row in found.rows:
        film = (
            f"kraft run {row.scenario} --method {row.method} --vehicle mushr-lag --seed {row.seed} "
            f"--video {row.scenario}-{row.method}-{row.seed}.mp4"
        )
        assert (film in text) == (row.outcome != "success")


def test_commands_name_the_files_that_were_given(tmp_path: Path) -> None:
    Path("my scene.yaml").write_text((ROOT / "scenarios/turns.yaml").read_text())
    arguments = {"scenarios": ["my scene.yaml"], "methods": ["kraft"]}
    evaluate(["my scene.yaml"], ["kraft"], trials=1, out="out", arguments=arguments, command_line=run_command)
    assert "kraft run 'my scene.yaml' --method kraft --seed 0" in value_text(Tags(Path("out/report.html").read_text()))


def test_a_scenario_that_changed_has_no_picture_and_the_page_says_so() -> None:
    changed = replace(load_scenario("turns"), obstacles=())
    evaluate([changed], ["kraft"], trials=1, out="out")
    assert "No picture" not in Path("out/report.html").read_text()
    text = write_report(Path("out"))[1].read_text()
    assert "No picture: the scenario is not there any more, or another." in text
    assert 'class="floor"' not in text


def test_what_anybody_wrote_is_text_and_never_markup() -> None:
    nasty = '<script>alert("1")</script> & co'
    text = document(nasty, "p > a { color: red }", element("p", nasty, title=nasty))
    tags = Tags(text)
    assert "script" not in {tag for tag, _ in tags.found}
    assert tags.found[-1] == ("p", {"title": nasty})
    assert nasty in tags.words
    assert "p > a { color: red }" in text


def shapes(drawing: Element, look: str) -> Iterator[Element]:
    return (found for found in drawing.iter() if look in (found.get("class") or "").split())


@pytest.mark.parametrize(
    ("name", "look", "count", "words"),
    [
        ("turns", "obstacle", 6, []),
        ("slope", "uphill", 1, ["a floor that leans 7.16 degrees"]),
        ("slip", "slippery", 1, ["one patch with friction 0.08"]),
        ("bump", "bump", 3, ["3 bumps of up to 5 cm"]),
        ("movable", "movable", 4, ["4 boxes that can be pushed"]),
        ("turns-real", "obstacle", 6, ["a car that differs from its model"]),
    ],
)
def test_a_floor_plan_shows_what_the_planner_does_not_know(name: str, look: str, count: int, words: list[str]) -> None:
    scenario = load_scenario(name)
    drawing = floor_plan(scenario, {})
    assert len(list(shapes(drawing, look))) == count
    assert len(list(shapes(drawing, "goal"))) == len(list(shapes(drawing, "start"))) == 1
    assert list(scenario.truth.in_words()) == words


def test_obstacles_are_the_redder_the_more_often_they_were_hit() -> None:
    drawing = floor_plan(load_scenario("turns"), {"first box": 9, "left wall": 3})
    hit = {str(found[0].text): found.get("style") for found in shapes(drawing, "hit")}
    assert hit == {
        "first box: 9 collisions": "fill-opacity: 1.00",
        "left wall: 3 collisions": "fill-opacity: 0.50",
    }


@pytest.mark.parametrize("size", [40, 1000])
def test_a_map_is_drawn_as_the_cells_that_are_occupied(size: int) -> None:
    occupied = np.zeros((size, size // 2), bool)
    occupied[: size // 4, size // 4 :] = True
    occupied[-size // 10 :] = True
    scenario = replace(load_scenario("turns"), obstacles=(OccupancyMap(occupied, 10.0 / size, (-1.0, -2.0, 0.3)),))
    (path,) = shapes(floor_plan(scenario, {}), "cells")
    runs = re.findall(r"M([\d.]+) ([\d.]+)h([\d.]+)v([\d.]+)h-[\d.]+z", path.get("d") or "")
    area = sum(float(width) * float(height) for _, _, width, height in runs)
    assert area == pytest.approx(occupied.sum() * (10.0 / size) ** 2, rel=0.02)
    assert len(runs) < 0.4 * min(size, 300)
    assert path.get("transform") == "translate(-1 -2) rotate(17.1887)"


def damaged(**changes: Any) -> None:
    file = Path("out/manifest.json")
    content = {**json.loads(file.read_text()), **changes}
    file.write_text(json.dumps({key: value for key, value in content.items() if value is not ...}, default=str))


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (lambda: Path("out/manifest.json").unlink(), ["out", "", "not-found"]),
        (lambda: Path("out/manifest.json").write_text("{"), ["out/manifest.json", "", "syntax"]),
        (lambda: damaged(schema="kraft.run/1"), ["out/manifest.json", "", "mismatch"]),
        (lambda: damaged(trials=0), ["out/manifest.json", "trials", "syntax"]),
        (lambda: damaged(rows=[]), ["out/manifest.json", "rows", "syntax"]),
        (lambda: Path("out/trials.jsonl").write_text("{}\n[]\n"), ["out/trials.jsonl:1:1", "", "syntax"]),
        (lambda: Path("out/summary.json").write_text("{}"), ["out/summary.json", "", "syntax"]),
    ],
)
def test_a_damaged_folder_is_refused(spoil: Any, expected: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    run()
    before = Path("out/report.html").read_bytes()
    spoil()
    with pytest.raises(InputError) as caught:
        read_results(Path("out"))
    first = caught.value.diagnostics[0]
    assert [first.place, first.path, first.code] == expected
    assert main(["report", "out"]) == 2
    assert capsys.readouterr().out == ""
    assert Path("out/report.html").read_bytes() == before


def test_wrong_folders_and_files_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    run()
    Path("file").touch()
    for arguments, place in (
        (["none"], "none"),
        (["file"], "file"),
        (["out", "--out", "out"], "out"),
        (["out", "--out", "file/page.html"], "file/page.html"),
        (["out", "--out", "/proc/x.html"], "/proc/x.html"),
    ):
        assert main(["report", *arguments]) == 2
        assert places(capsys.readouterr().err) == [place]
    assert main(["report", "out", "--out", "pages/mine.html"]) == 0
    assert capsys.readouterr().out == "pages/mine.html\n"
    assert Path("pages/mine.html").read_bytes() == Path("out/report.html").read_bytes()


def test_a_disk_that_is_full_leaves_the_old_page(capsys: pytest.CaptureFixture[str]) -> None:
    run()
    before = Path("out/report.html").read_bytes()
    with room_for(10_000):
        assert main(["report", "out"]) == 2
    assert places(capsys.readouterr().err) == ["out/report.html"]
    assert Path("out/report.html").read_bytes() == before


def test_results_know_what_was_asked_for() -> None:
    run()
    results: Results = read_results(Path("out"))
    assert results.expected == 12
    assert list(results.entries) == ["turns", "slip"]
    assert results.methods == {"oneshot-openloop": "OneShot + OpenLoop", "kraft": "KRAFT"}


def test_a_folder_without_titles_is_shown_with_names() -> None:
    run()
    rows = [{key: row[key] for key in ("scenario", "method", "vehicle")}
            for row in json.loads(Path("out/manifest.json").read_text())["rows"]]  # fmt: skip
    damaged(rows=rows)
    assert read_results(Path("out")).methods == {"oneshot-openloop": "oneshot-openloop", "kraft": "kraft"}


def test_older_manifests_and_trials_without_entries_and_measures_give_a_page() -> None:
    run()
    old = ("scenario", "method", "title", "vehicle")
    rows = [{key: row[key] for key in old} for row in json.loads(Path("out/manifest.json").read_text())["rows"]]
    damaged(rows=rows)
    trials = [json.loads(line) for line in Path("out/trials.jsonl").read_text().splitlines()]
    kept = [{key: value for key, value in row.items() if key not in ("entry", "measures")} for row in trials]
    Path("out/trials.jsonl").write_text("".join(json.dumps(row) + "\n" for row in kept))
    tags = Tags(page(read_results(Path("out"))))
    assert {attributes["href"] for tag, attributes in tags.found if tag == "a"} == {"#turns", "#slip"}
    assert tags.classes("table")["measures"] == 0


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


def test_shares_and_times_of_a_sweep_are_those_of_the_summary(monkeypatch: pytest.MonkeyPatch) -> None:
    found = swept(monkeypatch, {"sensing.noise_scale": [0, 2, 4]}, trials=6)
    results = read_results(Path("out"))
    (sweep,) = sweeps(results)
    assert (sweep.axis.key, sweep.axis.places, sweep.axis.numeric) == ("sensing.noise_scale", (0.0, 2.0, 4.0), True)
    points = {
        (p.result.entry, p.result.method): p for panel in sweep.panels.values() for line in panel.values() for p in line
    }
    assert list(sweep.panels) == ["turns", "slip"]
    assert len(points) == len(found.summary.results) == 12
    for result in found.summary.results:
        point = points[result.entry, result.method]
        assert point.place == result.settings["sensing.noise_scale"]
        assert point.success == Estimate(result.success / result.trials, result.interval)
        assert point.collision == Estimate(result.collision / result.trials, wilson(result.collision, result.trials))
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
    assert not sweep.axis.numeric


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
        ("obstacles[0].box.size", "size"),
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
    text = value_text(tags)
    assert tags.classes("table")["measures"] == 2
    assert tags.classes("svg")["deviation"] == 4
    assert tags.classes("line")["delta"] == 2
    assert text.count("covariance: NEES") == 2
    assert "messages lost" not in text
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
    assert [percent(share) for share in (None, 0.0, 0.094, 0.996, 1.0)] == [None, "0%", "9%", "99.6%", "100%"]


def suite_of(count: int) -> Path:
    entries = [{"name": f"world-{k}", "scenario": "turns", "set": {"sensing.noise_scale": k / 6}} for k in range(count)]
    path = Path("many.yaml")
    path.write_text(json.dumps({"name": "many", "entries": entries}))
    return path


def test_many_entries_are_rows_with_totals_and_closed_sections(monkeypatch: pytest.MonkeyPatch) -> None:
    fake_trials.use(monkeypatch, measured, inline=True)
    found = run(scenarios=None, suite=suite_of(9))
    tags = Tags(Path("out/report.html").read_text())
    text = value_text(tags)
    assert tags.classes("details")["entry"] == 9
    assert tags.classes("tr")["totals"] == 1
    anchors = {attributes["href"] for tag, attributes in tags.found if tag == "a"}
    assert anchors == {f"#{attributes['id']}" for tag, attributes in tags.found if "id" in attributes}
    assert anchors == {f"#world-{k}" for k in range(9)}
    assert "world-3 turns, sensing.noise_scale = 0.5" in text
    for method in METHODS:
        mine = [row for row in found.rows if row.method == method]
        hit = sum(row.outcome == "collision" for row in mine)
        low, high = wilson(hit, len(mine))
        assert f"{len(mine) - hit} of {len(mine)} {hit} collision" in text
        assert f"collided {hit / len(mine):.0%} ({low:.0%} to {high:.0%})" in text


def test_anchors_of_entries_have_no_spaces_and_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    swept(monkeypatch, {"sensing.camera": [[1, 3, 5], [1, 3, 6]], "sensing.noise_scale": [1, 2]}, trials=1)
    tags = Tags(Path("out/report.html").read_text())
    found = [str(attributes["id"]) for _, attributes in tags.found if "id" in attributes]
    assert len(set(found)) == len(found) == 8
    assert not any(re.search(r"\s", each) for each in found)
    links = {a["href"] for tag, a in tags.found if tag == "a" and "download" not in a}
    assert links == {f"#{each}" for each in found}


def test_a_page_of_many_entries_is_small_and_made_quickly() -> None:
    methods = ("kraft", "conservative-kraft", "oneshot-openloop", "oneshot-geometric")
    experiment = experiment_of((), methods, suite=suite_of(30), trials=30)
    by_seed = {seed: measured(TrialSpec.load("turns", seed=seed)) for seed in experiment.seeds}
    rows = {}
    for job in experiment.jobs():
        key = (job.entry, job.method.name, job.seed)
        rows[key] = trial_row(key, by_seed[job.seed], 1.0)
    results = Results.of(experiment, manifest_of(experiment, {}), rows, summarise(experiment, rows, 1.0), run_command)
    assert len(results.rows) == results.expected == 3600
    begin = time.process_time()
    text = page(results)
    assert time.process_time() - begin < 2.0
    assert len(text.encode()) < 3_000_000


def test_an_outsider_s_folder_is_not_written_to() -> None:
    Path("empty").mkdir()
    with refused(("empty", Code.NOT_FOUND)):
        write_report(Path("empty"))
    assert list(Path("empty").iterdir()) == []
