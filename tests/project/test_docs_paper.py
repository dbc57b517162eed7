"""What comments and documentation say of the paper: lines of its algorithms, and which methods its theorem covers."""

from __future__ import annotations

import re

import pytest
from support.paths import ROOT

from kraft.config import bundled
from kraft.driving.method import load_method

DIRT = (ROOT / "ompl_ext" / "kernels" / "dirt.py").read_text(encoding="utf-8")
PLANNER = (ROOT / "docs" / "planner.md").read_text(encoding="utf-8")
CLEARANCE = (ROOT / "docs" / "clearance.md").read_text(encoding="utf-8")
BASIS = {"deltas": "with `safety`:", "bounds": "with `bound`:", "none": "without `safety` and `bound`:"}
ALGORITHM_1 = {
    11: "select(",
    12: "sample_edges(",
    13: "propagate(",
    15: "check(",
    16: "insert(",
    18: "check(",
    19: "insert(",
    20: "AT_GOAL",
    21: "AT_GOAL",
    22: "AT_GOAL",
    24: "TOGO",
}
"""Lines of Algorithm 1, its comments counted as in the paper (SAFETY is in ll. 7-8 and 18-19), and what does them."""


def section(text: str, heading: str) -> str:
    return re.split(r"\n##+ ", text.split(f"# {heading}\n")[1])[0]


def test_comments_cite_the_lines_of_the_paper_s_algorithm() -> None:
    cited = {}
    for code, lines in re.findall(r"\n(.*\S)  # (?:Alg\. 1, )?l\. (\d[\d, -]*\d)", DIRT):
        for first, last in re.findall(r"(\d+)(?:-(\d+))?", lines):
            cited.update(dict.fromkeys(range(int(first), int(last or first) + 1), code))
    assert cited.keys() == ALGORITHM_1.keys()
    assert [line for line, code in cited.items() if ALGORITHM_1[line] not in code] == []


@pytest.mark.parametrize("name", re.findall(r"`(\w+)`", " ".join(
    row.split(" | ")[1] for row in section(PLANNER, "Line by line").splitlines()[4:] if row.startswith("| ")
)))  # fmt: skip
def test_the_functions_of_the_table_of_lines_exist(name: str) -> None:
    kernels = [path.read_text(encoding="utf-8") for path in (ROOT / "ompl_ext" / "kernels").glob("*.py")]
    assert any(f"\ndef {name}(" in text for text in kernels)


def basis(name: str) -> str:
    planner = load_method(name).planner
    return "bounds" if planner.bound else "deltas" if planner.safety else "none"


@pytest.mark.parametrize("kind", ["deltas", "none"])
def test_the_theorem_names_the_methods_without_a_bound(kind: str) -> None:
    (row,) = (line for line in CLEARANCE.splitlines() if line.startswith(f"| {BASIS[kind]}"))
    named = set(re.findall(r"`([\w-]+)`", row.split(" | ")[0].removeprefix(f"| {BASIS[kind]}")))
    if "the one-shot methods" in row:
        named |= {name for name in methods() if load_method(name).planner.mode == "one-shot"}
    assert named == {name for name in methods() if basis(name) == kind}


def test_the_theorem_names_the_methods_whose_messages_must_arrive() -> None:
    (row,) = (line for line in CLEARANCE.splitlines() if line.startswith("| without `on_board: contingency`:"))
    cells = row.split(" | ")
    beyond = {name for name in methods() if load_method(name).planner.on_board == "plan" and not of_the_paper(name)}
    assert set(re.findall(r"`([\w-]+)`", cells[0].split(":", 2)[2])) == beyond


def of_the_paper(name: str) -> bool:
    table = (ROOT / "kraft" / "evaluation" / "paper.py").read_text(encoding="utf-8")
    return f'"{name}"' in table


def methods() -> list[str]:
    return list(bundled.names("method"))
