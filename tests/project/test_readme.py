"""README.md's two commands are the ones that are run."""

from __future__ import annotations

import re

from support.paths import ROOT


def commands() -> list[str]:
    return re.findall(r"^    (python3 -m venv .*)$", (ROOT / "README.md").read_text(), re.MULTILINE)


def test_readme_has_exactly_two_commands_that_begin_from_nothing() -> None:
    assert len(commands()) == 2


def test_continuous_integration_runs_the_second_one() -> None:
    assert commands()[1] in (ROOT / ".ci" / "run").read_text().splitlines()


def test_every_file_that_readme_points_to_exists() -> None:
    targets = re.findall(r"\]\(([^)#]+)\)|src=\"([^\"]+)\"", (ROOT / "README.md").read_text())
    paths = [a or b for a, b in targets if not (a or b).startswith("http")]
    assert paths
    assert [path for path in paths if not (ROOT / path).exists()] == []
