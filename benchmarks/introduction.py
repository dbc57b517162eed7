"""Pictures of docs/introduction.md and of the README: python -m benchmarks.introduction [FOLDER].

The three drives are those of `kraft run slope --method METHOD --seed 0 --plot FILE`, without the curves below the map,
and the plan is that of `kraft plan turns --plot FILE`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from PIL import Image

from kraft_cli.main import main as kraft

METHODS: Final = ("oneshot-openloop", "oneshot-kinodynamic", "kraft")
WIDTH: Final = 900
"""Width of the pictures, px."""
LEGEND: Final = 0.527, 0.602
"""Begin and end of the legend of a drive's page, as shares of its height; the map is above it."""
PLAN: Final = 0.65
"""End of the legend of a plan's page, likewise."""


def main(arguments: Sequence[str]) -> int:
    """Write `ways.png`, `plan.png` and `turns.png` into the folder, docs by default; 1 if one cannot be made."""
    folder = Path(arguments[0] if arguments else "docs")
    with TemporaryDirectory() as scratch:
        pages = [Path(scratch) / f"{name}.png" for name in METHODS]
        plan = Path(scratch) / "plan.png"
        commands = [
            ["run", "slope", "--method", name, "--seed", "0", "--plot", str(page)]
            for name, page in zip(METHODS, pages, strict=True)
        ]
        for command in [*commands, ["plan", "turns", "--plot", str(plan)]]:
            kraft(command)  # a collision is no success of the command, and has its page
        if not all(page.exists() for page in [*pages, plan]):
            return 1
        drives = [Image.open(page).convert("RGB") for page in pages]
        parts = [_band(page, 0.0, LEGEND[0]) for page in drives]
        save([*parts, _band(drives[-1], *LEGEND)], folder / "ways.png")
        turns = Image.open(plan).convert("RGB")
        save([_band(turns, 0.0, PLAN)], folder / "plan.png")
        turns.save(folder / "turns.png", optimize=True)
    return 0


def _band(page: Image.Image, begin: float, end: float) -> Image.Image:
    """Part of a page between two shares of its height."""
    return page.crop((0, round(begin * page.height), page.width, round(end * page.height)))


def save(parts: Sequence[Image.Image], path: Path) -> None:
    """Write pictures of one width as one, below each other."""
    whole = Image.new("RGB", (parts[0].width, sum(part.height for part in parts)), "white")
    top = 0
    for part in parts:
        whole.paste(part, (0, top))
        top += part.height
    small = whole.resize((WIDTH, round(whole.height * WIDTH / whole.width)), Image.Resampling.LANCZOS)
    small.save(path, optimize=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
