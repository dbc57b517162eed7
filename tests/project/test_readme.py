"""README.md's two commands are the ones that are run."""

from __future__ import annotations

import re

from PIL import Image
from support.paths import ROOT


def commands() -> list[str]:
    return re.findall(r"^    (python3 -m venv .*)$", (ROOT / "README.md").read_text(), re.MULTILINE)


def test_readme_has_exactly_two_commands_that_begin_from_nothing() -> None:
    assert len(commands()) == 2


def test_the_small_table_adds_up_the_scenarios_of_the_large_one() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    large = _rows(text[text.index("<!-- results") : text.index("<!-- end of results")])
    small = _rows(text[text.index("## What it achieves") : text.index("## Extras and tests")])
    assert len(small) == 8
    harder = _totals((ROOT / "docs" / "results.md").read_text(encoding="utf-8"), "hard")
    for name, (_, *numbers) in small.items():
        reached = sum(int(cell.split()[0].rstrip(",")) for cell in large[name])
        hit = sum(int(found[1]) for cell in large[name] if (found := re.search(r"(\d+) hit", cell)))
        assert list(map(int, numbers)) == [reached, hit, *harder[name]], name
    assert f"{len(large) - len(small)} more" in text.replace("eight more", "8 more")


def test_what_the_commands_of_the_readme_write_is_ignored_in_a_clone() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    block = text[text.index("## Use it") : text.index("- [kraft in five minutes]")]
    found = re.findall(r"^    kraft .*--(?:out|plot|video|bag) ([\w./-]+)", block, re.MULTILINE)
    assert len(found) > 5
    ignored = (ROOT / ".gitignore").read_text().splitlines()
    assert [name for name in found if not {f"/{name}", f"/{name}/"} & set(ignored)] == []


def _totals(text: str, suite: str) -> dict[str, list[int]]:
    """Numbers of successes and of collisions over all entries of a suite, by the title of the method."""
    found: dict[str, list[int]] = {}
    for section in text.split("\n## ")[1:]:
        if section.startswith(f"{suite}: "):
            rows = _rows(section[section.index("| all entries") :].split("\n\n")[0])
            found |= {name: [int(cells[0].split()[0]), int(cells[2])] for name, cells in rows.items()}
    return found


def _rows(text: str) -> dict[str, list[str]]:
    """Cells of the rows of the table in a text, without its heading, by the first of them."""
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in re.findall(r"^\|.*\|$", text, re.MULTILINE)
    ]
    return {name: cells for name, *cells in rows[2:]}


def test_continuous_integration_runs_the_second_one() -> None:
    assert commands()[1] in (ROOT / ".ci" / "run").read_text().splitlines()


def test_the_moving_picture_of_the_readme_is_small_and_moves() -> None:
    path = ROOT / "docs" / "drive.webp"
    assert path.stat().st_size < 1_500_000
    with Image.open(path) as film:
        assert getattr(film, "n_frames", 1) > 30
