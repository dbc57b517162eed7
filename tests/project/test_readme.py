"""README.md's two commands are the ones that are run."""

from __future__ import annotations

import re

import pytest
from PIL import Image
from support.paths import ROOT


def commands() -> list[str]:
    return re.findall(r"^    (python3 -m venv .*)$", (ROOT / "README.md").read_text(), re.MULTILINE)


def test_readme_has_exactly_two_commands_that_begin_from_nothing() -> None:
    assert len(commands()) == 2


def test_continuous_integration_runs_the_second_one() -> None:
    assert commands()[1] in (ROOT / ".ci" / "run").read_text().splitlines()


@pytest.mark.parametrize("page", ["README.md", "docs/introduction.md"])
def test_every_file_that_a_first_page_points_to_exists(page: str) -> None:
    targets = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)|src=\"([^\"]+)\"", (ROOT / page).read_text())
    paths = [a or b for a, b in targets if not (a or b).startswith("http")]
    assert len(paths) > 5
    assert [path for path in paths if not ((ROOT / page).parent / path).exists()] == []


def test_the_moving_picture_of_the_readme_is_small_and_moves() -> None:
    path = ROOT / "docs" / "drive.webp"
    assert path.stat().st_size < 1_500_000
    with Image.open(path) as film:
        assert getattr(film, "n_frames", 1) > 30
