"""One rule for all outputs: folders on the way are made, a folder of results must be new, a file is replaced."""

from __future__ import annotations

from pathlib import Path

import pytest
from support import fake_trials
from support.paths import ROOT

from kraft_cli.main import main

PLAN = ("plan", "turns", "--iterations", "100")
FILES = [("--plot", "p.svg"), ("--out", ".")]
FOLDERS = {
    "run": ("run", "turns"),
    "eval": ("eval", "turns", "--methods", "kraft", "--trials", "1"),
    "generate": ("generate", "posts"),
    "record": ("record", "--runs", "1"),
}
DOCS = (ROOT / "docs" / "plan.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("output", FILES)
def test_a_file_is_written_into_folders_that_are_made_and_replaces_another(
    output: tuple[str, str], folder: Path
) -> None:
    option, name = output
    for seed in ("0", "1"):
        assert main([*PLAN, option, f"new/folder/{name}", "--seed", seed, "-q"]) in (0, 1)
        written = [path for path in Path("new/folder").iterdir() if path.is_file()]
        assert len(written) == 1


@pytest.mark.parametrize("command", FOLDERS)
def test_a_folder_is_made_with_those_on_the_way_and_must_be_new(
    command: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if command == "eval":
        fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    arguments = [*FOLDERS[command], "--out", "new/folder", "-q"]
    assert main(arguments) in (0, 1)
    assert any(Path("new/folder").iterdir())
    capsys.readouterr()
    assert main(arguments) == 2
    assert capsys.readouterr().err.startswith("new/folder: is there already; expected a new folder")


def test_the_documentation_names_every_command_that_needs_a_new_folder() -> None:
    rule = DOCS[DOCS.index("## What commands write") : DOCS.index("## Compiled kernels")]
    assert [name for name in FOLDERS if f"`{name}`" not in rule.replace("`kraft run`", "`run`")] == []
