"""`report.html`: everything is on it, nothing else is needed to read it, and it is made again from the folder alone."""

from __future__ import annotations

import json
import re
import shlex
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import pytest
from support import fake_trials
from support.evaluation import StoppingObserver, places, refused, room_for
from support.html import Tags, text_of
from support.paths import ROOT

from kraft.config.user_code import imported
from kraft.errors import Code, InputError, UserCodeError
from kraft.evaluation import Evaluation, evaluate
from kraft.evaluation.journal import reason_of_failures
from kraft.evaluation.report import Results, page, read_results, write_report
from kraft.evaluation.report.elements import document, element, script_data
from kraft.evaluation.report.entry import floor_plan
from kraft.scenario import OccupancyMap, load_scenario
from kraft.trial.cause import CauseKind
from kraft.trial.measures import Kept, Measures
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


def test_a_warning_is_kept_in_the_folder_and_shown_at_the_top_of_the_page(
    capsys: pytest.CaptureFixture[str],
) -> None:
    model = (ROOT / "configs" / "vehicles" / "f1tenth.yaml").read_text(encoding="utf-8")
    Path("mine.yaml").write_text("\n".join(line for line in model.splitlines() if not line.startswith("truth:")))
    arguments = ["eval", "turns", "slip", "--methods", "kraft", "--trials", "1", "--jobs", "1"]
    assert main([*arguments, "--vehicle", "mine.yaml", "--out", "warned"]) == 0
    lines = capsys.readouterr().err.splitlines()
    told, again = (line.removeprefix("warning: ") for line in lines if line.startswith("warning: "))
    assert again == told
    assert told.startswith("turns: the true robot is the MuSHR")
    assert told.endswith("; the same in 1 other entry")
    assert lines[-1] == f"warning: {told}"
    for name in ("manifest.json", "summary.json"):
        assert json.loads(Path("warned", name).read_text())["warnings"] == [told]
    for made in (Path("warned/report.html").read_text(encoding="utf-8"), page(read_results(Path("warned")))):
        text = text_of(Tags(made))
        assert text.index(f"Warning: {told}") < text.index("Overview")
    assert main(["-q", *arguments, "--vehicle", "mine.yaml", "--out", "quiet", "--json"]) == 0
    printed = capsys.readouterr()
    assert printed.err.splitlines() == [f"warning: {told}"]
    assert json.loads(printed.out)["warnings"] == [told]
    assert main([*arguments, "--out", "silent"]) == 0
    assert json.loads(Path("silent/manifest.json").read_text())["warnings"] == []
    assert "Warning" not in text_of(Tags(Path("silent/report.html").read_text(encoding="utf-8")))


def test_an_evaluation_ends_with_a_page_that_needs_nothing_else() -> None:
    run()
    text = Path("out/report.html").read_text(encoding="utf-8")
    tags = Tags(text)
    assert tags.open == []
    assert not re.search(r"https?:|@import|url\(", text.replace("http://www.w3.org", ""))
    assert all("src" not in attributes for _, attributes in tags.found)
    links = {str(attributes["href"]) for tag, attributes in tags.found if tag == "a"}
    anchors = {link for link in links if not link.startswith(("#trial=", "#show"))}
    sections = {"#overview", "#causes", "#methods", "#trials", "#entries"}
    assert anchors == {"#turns", "#slip"} | sections
    assert {f"#{attributes['id']}" for _, attributes in tags.found if "id" in attributes} >= anchors
    rows = [
        f"#trial={scenario}/{method}/{seed}"
        for scenario in ("turns", "slip")
        for method in METHODS
        for seed in (5, 6, 7)
    ]
    assert {link for link in links if link.startswith("#trial=")} == set(rows)


def test_times_of_commands_and_those_that_came_late_are_on_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    run(out="before")
    assert "% late" not in Path("before/report.html").read_text(encoding="utf-8")

    def timed(spec: TrialSpec) -> TrialResult:
        return replace(fake_trials.quick(spec), command_ms=(4.0, 5.0, 6.0, 40.0), late_commands=1)

    fake_trials.use(monkeypatch, timed, inline=True)
    run()
    written = Path("out/report.html").read_text(encoding="utf-8")
    assert written.count('data-label="command, ms, median"') == len(METHODS)
    text = text_of(Tags(written))
    assert text.count("5.00 99 %: 40.00 25.0% late") == len(METHODS)
    assert text.count("command 5.00, 99 %: 40.00, 3 late") == 2 * len(METHODS)


def test_every_trial_is_a_cell_that_says_how_it_ended_and_how_to_drive_it_again() -> None:
    found = run()
    tags = Tags(page(read_results(Path("out"), run_command)))
    text = text_of(tags)
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
    text = text_of(Tags(page(read_results(Path("out")))))
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
    text = text_of(Tags(page(read_results(Path("out")))))
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
    assert "8 of 12 trials not run yet: this page is of those that were." in text_of(tags)
    assert tags.classes("rect")["missing"] == 2  # of the row that has begun
    assert text_of(tags).count("Not run yet: ") == 1  # both rows of the second entry


@pytest.mark.parametrize(
    ("failed", "defects", "reason"),
    [
        (2, 2, "which is a defect in kraft"),
        (2, 0, "because of an error in the user's own code"),
        (10, 1, "9 because of an error in the user's own code, and 1 by a defect in kraft"),
    ],
)
def test_failures_of_both_kinds_are_counted_apart(failed: int, defects: int, reason: str) -> None:
    assert reason_of_failures(failed, defects) == reason


def test_failed_trials_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    fake_trials.use(monkeypatch, fake_trials.raises, inline=True)
    evaluate(["turns"], ["kraft"], trials=2, seed=0, out="out")
    text = text_of(Tags(Path("out/report.html").read_text()))
    assert "1 trial failed, which is a defect in kraft" in text
    assert "seed 1: failed: ZeroDivisionError: no speed at all" in text


def test_trials_that_the_users_own_code_ended_are_no_defects_and_their_error_is_among_the_causes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def own_code_fails(spec: TrialSpec) -> TrialResult:
        if spec.seed < 2:
            raise UserCodeError.of("own.py:7", "has no gain", "expected a number")
        return fake_trials.quick(spec)

    fake_trials.use(monkeypatch, own_code_fails, inline=True)
    evaluate(["turns"], ["kraft"], trials=3, seed=0, out="out")
    written = Path("out/report.html").read_text(encoding="utf-8")
    text = text_of(Tags(written))
    assert "2 trials failed, because of an error in the user's own code" in text
    assert "2 failed" in text
    assert "2 trials: own.py:7: has no gain; expected a number" in text
    assert "2 defects" not in written
    assert '<a href="#show&amp;method=kraft&amp;cause=error+in+own+code">2</a>' in written


def test_trials_that_the_users_own_vehicle_ended_are_no_defects(monkeypatch: pytest.MonkeyPatch) -> None:
    Path("own.py").write_text("def half(x):\n    return 1 / x\n", encoding="utf-8")

    def own_vehicle_fails(spec: TrialSpec) -> TrialResult:
        imported("own.py", "own.py", "")[0].half(0.0)
        return fake_trials.quick(spec)

    fake_trials.use(monkeypatch, own_vehicle_fails, inline=True)
    (row,) = evaluate(["turns"], ["kraft"], trials=1, seed=0, out="out").rows
    assert row.own_code
    assert "own.py:2: ZeroDivisionError" in (row.error or "")


def test_trials_that_take_no_time_and_never_deviate_give_a_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """As with a start in the goal, and with the exact model."""

    def at_once(spec: TrialSpec) -> TrialResult:
        shares = Kept(ticks=2, held=2, delta_sum_m=0.0)
        measures = Measures(plans=shares, deviation_mm=((0, 0),))
        return replace(fake_trials.quick(spec), outcome=Outcome.SUCCESS, time=0.0, obstacle=None, measures=measures)

    fake_trials.use(monkeypatch, at_once, inline=True)
    evaluate(["parking"], ["kraft"], trials=2, seed=0, out="out")  # the paper has no times of it
    assert "Deviation from the prediction" in text_of(Tags(Path("out/report.html").read_text(encoding="utf-8")))


def test_what_did_not_succeed_is_listed_with_the_command_that_films_it() -> None:
    found = run(trials=8, vehicle="mushr-lag", arguments={"vehicle": "mushr-lag"})
    text = text_of(Tags(Path("out/report.html").read_text()))
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
    assert "kraft run 'my scene.yaml' --method kraft --seed 0" in text_of(Tags(Path("out/report.html").read_text()))


def test_the_page_and_its_documentation_say_the_same_of_a_deviation() -> None:
    documented = (ROOT / "docs/eval.md").read_text(encoding="utf-8")
    assert f"| `deviation` | {CauseKind.DEVIATION.meaning} |".replace("the clearance δ(v)", "delta(v)") in documented


def test_commands_on_the_page_name_the_file_of_a_method_and_run(capsys: pytest.CaptureFixture[str]) -> None:
    Path("track.yaml").write_text("name: my-track\ntitle: My track\nbase: oneshot-openloop\n")
    arguments = ["eval", "turns", "--methods", "kraft, track.yaml", "--trials", "2", "--jobs", "1", "--out", "out"]
    assert main(arguments) == 0
    written = Path("out/report.html").read_text(encoding="utf-8")
    assert write_report(Path("out"), command_line=run_command)[1].read_text(encoding="utf-8") == written
    commands = set(re.findall(r"kraft run [^\"<]*", written))
    assert {shlex.split(each)[4] for each in commands} == {"kraft", "track.yaml"}
    shortest = min((each for each in commands if "track.yaml" in each), key=len)
    assert main(shlex.split(shortest)[1:]) == 1  # it drives, and collides, as this method does without feedback


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


def test_obstacles_without_a_name_are_those_that_were_hit() -> None:
    scenario = load_scenario("turns")
    unnamed = replace(scenario, obstacles=tuple(replace(each, name=None) for each in scenario.obstacles))
    drawing = floor_plan(unnamed, {"obstacles[1]": 7})
    assert [str(found[0].text) for found in shapes(drawing, "hit")] == ["obstacles[1]: 7 collisions"]
    assert [found.text for found in shapes(drawing, "number")] == ["1"]
    assert not list(shapes(floor_plan(scenario, {"left wall": 7}), "number")), "names are in the words below"


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


def lost(count: int) -> None:
    """Remove the last lines of the journal."""
    file = Path("out/trials.jsonl")
    file.write_text("".join(file.read_text().splitlines(keepends=True)[:-count]))


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
        (lambda: Path("out/trials.jsonl").unlink(), ["out/trials.jsonl", "", "mismatch"]),
        (lambda: lost(1), ["out/trials.jsonl", "", "mismatch"]),
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


@pytest.mark.parametrize("command", ["drive", "run"])
def test_a_folder_of_another_command_is_said_to_be_that(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("mine").mkdir()
    Path("mine/manifest.json").write_text(json.dumps({"schema": f"kraft.{command}-manifest/1"}))
    assert main(["report", "mine"]) == 2
    said = capsys.readouterr().err
    assert places(said) == ["mine"]
    assert f"(kraft {command}); expected the results folder of an evaluation" in said


def test_wrong_folders_and_files_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    run()
    Path("file").touch()
    for arguments, place in (
        (["none"], "none"),
        (["file"], "file"),
        (["out", "--out", "out"], "out"),
        (["out", "--out", "file/page.html"], "file/page.html"),
        (["out", "--out", "/proc/x.html"], "/proc/x.html"),
        (["out", "--out", "page.txt"], "page.txt"),
        (["out", "--out", "page"], "page"),
        (["none", "--serve"], "none"),
        (["out", "--serve", "--out", "x.html"], "--serve"),
    ):
        assert main(["report", *arguments]) == 2
        assert places(capsys.readouterr().err) == [place]
    assert not Path("page.txt").exists()
    assert main(["report", "none", "--out", "page.txt"]) == 2
    assert sorted(places(capsys.readouterr().err)) == ["none", "page.txt"], "all problems at once"
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
    assert {"#turns", "#slip", "#trial=turns/kraft/5"} <= {
        attributes["href"] for tag, attributes in tags.found if tag == "a"
    }
    assert tags.classes("table")["measures"] == 0


def test_names_and_causes_that_anybody_wrote_cannot_end_the_script() -> None:
    data = script_data("data", {"name": "</script><script>alert(1)</script>"})
    text = document("t", "", scripts=[data])
    assert text.count("<script") == text.count("</script") == 1
    assert json.loads(data.text or "") == {"name": "</script><script>alert(1)</script>"}


def test_an_outsider_s_folder_is_not_written_to() -> None:
    Path("empty").mkdir()
    with refused(("empty", Code.NOT_FOUND)):
        write_report(Path("empty"))
    assert list(Path("empty").iterdir()) == []


def test_numbers_of_obstacles_have_the_colour_of_text_without_a_halo_and_are_smaller_in_replays() -> None:
    style = (ROOT / "kraft/evaluation/report/style.css").read_text(encoding="utf-8")
    rules = dict(re.findall(r"^(\S+ \.number) \{(.*?)\}", style, re.MULTILINE | re.DOTALL))
    assert "fill: var(--ink);" in rules[".floor .number"]
    assert "stroke" not in rules[".floor .number"]
    sizes = {place: float(re.findall(r"font-size: ([\d.]+)px", rule)[0]) for place, rule in rules.items()}
    assert sizes["#stage .number"] < sizes[".floor .number"]
