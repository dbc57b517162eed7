"""`kraft compare`: what it prints, and that everything it prints is described."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from support import fake_trials
from support.evaluation import places
from support.paths import ROOT
from support.screen import Screen

from kraft.evaluation.comparison_table import COLUMNS, MEANINGS
from kraft_cli.main import main
from kraft_cli.terminal import Terminal

EVAL = (ROOT / "docs" / "eval.md").read_text(encoding="utf-8")
SECTION = EVAL[EVAL.index("`kraft compare A B` compares") : EVAL.index("## On a cluster")]


@pytest.fixture(autouse=True)
def folders(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two evaluations, of which the second has other versions of a scenario and fewer trials."""
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    for out, arguments in (("a", ["--trials", "5"]), ("b", ["--trials", "4", "--set", "sensing.noise_scale=2"])):
        command = ["eval", "turns", "slip", "--methods", "kraft,oneshot-openloop", *arguments, "--out", out, "-q"]
        assert main(command) == 0


def test_a_pipe_gets_a_row_for_each_entry_and_method_and_the_differences(capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["compare", "a", "b"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    lines = out.splitlines()
    assert lines[:3] == ["A: a", "B: b", ""], "the tables use these letters"
    lines = lines[3:]
    rows = [re.split(r"  +", line) for line in lines[1:5]]
    assert [row[:3] for row in rows] == [
        ["turns *", "KRAFT", "4"], ["turns *", "OneShot + OpenLoop", "4"],
        ["slip *", "KRAFT", "4"], ["slip *", "OneShot + OpenLoop", "4"],
    ]  # fmt: skip
    assert [row[-1] for row in rows] == ["4/4"] * 4
    assert lines[6] == "all entries"
    assert "16 pairs in 4 rows: all drives are the same, bit by bit" in lines
    assert "too few" not in out, "what is the same needs no test"
    assert any(line.startswith("dT 95 % CI") and "- with fewer than three" in line for line in lines)
    assert "trials: 5 in A, 4 in B" in lines
    assert "scenarios.slip.content.sensing.noise_scale: 1.0 in A, 2.0 in B" in lines


def test_a_terminal_gets_a_table_that_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    for width in (60, 160):
        monkeypatch.setenv("COLUMNS", str(width))
        out = Screen()
        assert main(["compare", "a", "b"], Terminal(out, Screen())) == 0
        lines = re.sub(r"\033\[[\d;?]*[A-Za-z]", "", out.getvalue()).splitlines()
        table = [line for line in lines if line.startswith(("│", "╭", "├"))]
        assert table
        assert max(len(line) for line in table) <= width
        assert ("only A/B" in table[1]) == (width == 160)
        assert ("no room for" in out.getvalue()) == (width == 60)
        names = [cells[2] for line in table if len(cells := line.split("│")) > 2 and "KRAFT" in cells[2]]
        assert names
        assert all(name.startswith(" KRAFT ") for name in names), "text is aligned to the left"


def test_every_key_and_every_column_is_described(capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["compare", "a", "b", "--json"]) == 0
    content: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert content["schema"] == "kraft.compare/1"
    described = set(re.findall(r"`([\w]+)`", SECTION))
    parts = [*content["results"], *content["totals"], *content["differences"], *content["only_in_a"]]
    assert {key for part in [content, *parts] for key in part} - {"schema"} <= described
    assert [row["method"] for row in content["totals"]] == ["kraft", "oneshot-openloop"]
    assert set(COLUMNS) <= set(re.findall(r"`([^`]+)`", SECTION))
    assert set(MEANINGS) <= set(COLUMNS)


def test_the_problems_of_both_folders_are_reported(capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    Path("c").mkdir()
    assert main(["compare", "c", "nowhere", "--json"]) == 2
    out, err = capsys.readouterr()
    assert (out, places(err)) == ("", ["c", "nowhere"])
