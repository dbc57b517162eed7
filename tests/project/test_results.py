"""The documentation's tables are those of the results folders."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from support import fake_trials
from support.paths import ROOT

from benchmarks import results
from benchmarks.report import Report, Target, row
from kraft.evaluation import evaluate
from kraft.evaluation.report.results import read_results
from kraft.evaluation.statistics import wilson


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    own = tmp_path / "scenes" / "boxes.yaml"
    own.parent.mkdir()
    own.write_bytes((ROOT / "scenarios" / "boxes.yaml").read_bytes())
    methods = ["kraft", "oneshot-kinodynamic", "conservative-kraft"]
    evaluate(["turns", str(own)], methods, 6, 3, 1, tmp_path / "results", arguments={"scenarios": ["turns", str(own)]})
    return tmp_path / "results"


def test_the_document_has_the_counts_of_the_folder_and_the_command(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "results.md"
    assert results.main([str(folder), "--out", str(out)]) == 0
    text = out.read_text()
    found = read_results(folder)
    assert "    kraft eval turns scenes/boxes.yaml" in text
    assert str(tmp_path) not in text
    for result in found.summary.results:
        assert results.cell(result) in text
    mine = [result for result in found.summary.results if result.method == "kraft"]
    success, collision = sum(r.success for r in mine), sum(r.collision for r in mine)
    low, high = wilson(success, 12)
    assert f"| KRAFT | {success} of 12 | {100 * low:.1f} to {100 * high:.1f} % | {collision} |" in text
    assert "| boxes | KRAFT |" in text
    assert "23 of 30" in text


def test_successes_differ_from_the_papers_where_a_test_of_both_samples_says_so(folder: Path) -> None:
    found = read_results(folder)
    counts = {"kraft": 6, "oneshot-kinodynamic": 6, "conservative-kraft": 0}
    rows = tuple(replace(each, success=counts[each.method]) for each in found.summary.results)
    (text,) = results.differences([replace(found, summary=replace(found.summary, results=rows))])
    lines = [line.strip("|").split("|") for line in text.splitlines() if "|" in line]
    shown = {tuple(cells[:2]): cells[2:] for cells in lines}
    verdicts = {key: cells[-1].strip() for key, cells in shown.items()}
    assert verdicts[" turns ", " Conservative KRAFT "] == "lower here"
    low, high = wilson(6, 6)
    assert not low <= 17 / 30 <= high, "an exact 17 of 30 would be excluded"
    assert verdicts[" boxes ", " OneShot + Kinodynamic "] == ""
    assert shown[" boxes ", " OneShot + Kinodynamic "][4].strip() == "0.068"


def test_evaluations_of_the_same_suite_have_headings_of_their_own_and_one_adjustment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    halves, out = [["kraft"], ["conservative-kraft", "oneshot-kinodynamic"]], tmp_path / "results.md"
    for k, methods in enumerate(halves):
        evaluate(["turns", "boxes"], methods, 3, 0, 1, tmp_path / str(k), arguments={"scenarios": ["turns", "boxes"]})
    assert results.main([str(tmp_path / "0"), str(tmp_path / "1"), "--out", str(out)]) == 0
    text = out.read_text()
    assert [line for line in text.splitlines() if line.startswith("## ")] == [
        "## turns, boxes: kraft", "## turns, boxes: conservative-kraft, oneshot-kinodynamic",
        results.PAPER_HEADING, "## What the paper claims",
    ]  # fmt: skip
    section = text.partition(results.PAPER_HEADING)[2].partition("## ")[0]
    assert "rows of this table, 6." in " ".join(section.split())
    rows = [tuple(line.split(" | ")[:2]) for line in section.splitlines() if line.startswith(("| turns", "| boxes"))]
    titles = ("OneShot + Kinodynamic", "KRAFT", "Conservative KRAFT")
    assert rows == [(f"| {entry}", title) for entry in ("turns", "boxes") for title in titles]


def test_claims_are_tested_on_the_same_trials(folder: Path) -> None:
    found = read_results(folder)
    lines = results.claims(found)
    first = next(k for k, line in enumerate(lines) if line.startswith("| ---")) + 1
    assert [line.split(" | ")[0] for line in lines[first:-1]] == ["| replanning", "| safety, with feedback"]
    pairs = [
        (found.rows[entry, "conservative-kraft", seed].outcome, found.rows[entry, "kraft", seed].outcome)
        for entry in ("turns", "boxes")
        for seed in found.manifest.seeds
    ]
    gained = sum(mine == "success" != theirs for mine, theirs in pairs)
    lost = sum(theirs == "success" != mine for mine, theirs in pairs)
    assert f"{gained} / {lost}" in lines[first + 1]
    changes = [sum((a == "success") - (b == "success") for a, b in pairs[k : k + 6]) for k in (0, 6)]
    least = {0: "1", 1: "1", 2: "0.5"}[sum(change != 0 for change in changes)]
    assert lines[first + 1].endswith(f" | {least} |"), "the least that a test of as many entries can give"


def test_of_each_method_only_trials_count_that_the_other_has_too(folder: Path) -> None:
    found = read_results(folder)
    rows = {key: row for key, row in found.rows.items() if key[1] != "kraft" or key[2] != 3 or key[0] != "turns"}
    lines = results.claims(replace(found, rows=rows))
    assert lines[-2].startswith("| safety, with feedback | Conservative KRAFT | KRAFT | ")
    both = [key[::2] for key in rows if key[1] == "kraft"]
    counts = [sum(rows[entry, name, seed].outcome == "success" for entry, seed in both)
              for name in ("conservative-kraft", "kraft")]  # fmt: skip
    assert f" {counts[0]} : {counts[1]} of 11 " in lines[-2]


def test_the_value_beside_a_target_is_the_one_that_it_judges() -> None:
    rows = [row("hits", "", [1.0, 1.0, 3.0], Target(2.0, of="worst")), row("time", "s", [1.0, 1.0, 3.0], Target(2.0))]
    lines = results.benchmark_section({"topics": {"faults": Report("faults", rows).as_json()}}).splitlines()
    assert "| hits | 3 |  | 3 | worst <= 2 | missed |" in lines
    assert "| time | 1 | s | 3 | median <= 2 | met |" in lines


def test_the_table_of_the_readme_is_replaced_and_the_rest_stays(folder: Path, tmp_path: Path) -> None:
    readme, out = tmp_path / "README.md", tmp_path / "results.md"
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    readme.write_text(text, encoding="utf-8")
    assert results.main([str(folder), "--out", str(out), "--readme", str(readme)]) == 0
    before, _, rest = readme.read_text(encoding="utf-8").partition(results.BEGIN)
    table, _, after = rest.partition(results.END)
    assert (before, after) == (text.partition(results.BEGIN)[0], text.partition(results.END)[2])
    assert table.strip().splitlines() == results.method_table([read_results(folder)])
    readme.write_text("no marks")
    assert results.main([str(folder), "--out", str(out), "--readme", str(readme)]) == 2
    assert results.main([str(tmp_path / "none"), "--out", str(out)]) == 2


def test_of_a_large_suite_kinds_and_failing_entries_are_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    names = [f"{kind}-{k:03}" for k in range(5) for kind in ("maze", "posts")]
    entries = "".join(f"  - {{name: {name}, scenario: turns, set: {{name: {name}}}}}\n" for name in names)
    (tmp_path / "suite.yaml").write_text(f"name: many\nentries:\n{entries}")
    methods = ["kraft", "conservative-kraft"]
    evaluate(None, methods, 1, 3, 1, tmp_path / "results", suite=tmp_path / "suite.yaml", arguments={})
    found, out = read_results(tmp_path / "results"), tmp_path / "results.md"
    assert results.main([str(tmp_path / "results"), "--out", str(out)]) == 0
    rows = {row[0]: row[1:] for row in (line.strip("| ").split(" | ") for line in out.read_text().splitlines())}
    by_cell = found.summary.by_cell
    for kind in ("maze", "posts"):
        mine = [by_cell[name, "kraft"] for name in names if name.startswith(kind)]
        assert rows[kind][0] == "5"
        assert rows[kind][1].startswith(f"{sum(r.success for r in mine)} of 5")
        assert f"{sum(r.collision for r in mine)} hit" in rows[kind][1]
    failures = {
        name: sum(by_cell[name, each].trials - by_cell[name, each].success for each in methods) for name in names
    }
    listed = [name for name in rows if name in names]
    assert set(listed) == {name for name in names if failures[name]}
    assert set(listed) != set(names)
    assert [failures[name] for name in listed] == sorted((failures[name] for name in listed), reverse=True)


def test_no_two_sections_of_the_page_have_the_same_heading() -> None:
    lines = (ROOT / "docs" / "results.md").read_text(encoding="utf-8").splitlines()
    headings = [line for line in lines if line.startswith("#")]
    assert len(headings) > 5
    assert "\n".join(lines).startswith(results.HEADING)
    assert len(headings) == len(set(headings))
