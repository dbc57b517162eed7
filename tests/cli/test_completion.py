"""The shell completes commands, options and names of bundled files, without a module that takes long to import."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from kraft.config import bundled
from kraft.scenario.planners import PLANNERS
from kraft.worlds.generate import KINDS, MIXED
from kraft_cli.commands.listing import THINGS
from kraft_cli.completion import VARIABLE, comma_separated, names, words
from kraft_cli.main import main

HEAVY = ("numpy", "numba", "scipy", "yaml", "mujoco", "ompl", "gtsam", "matplotlib", "rich", "kraft.driving")
"""Modules that take long to import; typer itself loads pydantic, to read a command line."""


def completed(line: str, patch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """What bash would propose for the last word of a line."""
    patch.setenv(VARIABLE, "complete_bash")
    patch.setenv("COMP_WORDS", line)
    patch.setenv("COMP_CWORD", str(len(line.split(" ")) - 1))
    assert main([]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return out.split()


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("kraft ev", ["eval"]),
        ("kraft -q ev", ["eval"]),
        ("kraft --version ev", ["eval"]),
        ("kraft run --vid", ["--video"]),
        ("kraft list ", list(THINGS)),
        ("kraft plan turns --planner ", list(PLANNERS)),
        ("kraft sysid logs --model au", ["auto"]),
        ("kraft run tur", ["turns", "turns-real"]),
        ("kraft run turns --json --method kraft-", ["kraft-mppi", "kraft-nmpc"]),
        ("kraft eval turns slip mov", ["movable"]),
        ("kraft eval --suite ", ["hard", "paper"]),
        ("kraft eval --methods kraft,kraft-", ["kraft,kraft-mppi", "kraft,kraft-nmpc"]),
        ("kraft eval --methods kraft-mppi,kraft-", ["kraft-mppi,kraft-nmpc"]),
        ("kraft record trainin", ["training", "training-real"]),
        ("kraft generate c", ["corridor", "clutter"]),
        ("kraft generate ", [*KINDS, MIXED]),
        ("kraft validate pap", ["paper"]),
        ("kraft run nothing-like-it", []),
        ("kraft report resul", []),  # the shell completes files then
    ],
)
def test_the_last_word_of_a_line_is_completed(
    line: str, expected: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert completed(line, monkeypatch, capsys) == expected


@pytest.mark.parametrize(
    ("line", "kind"),
    [
        ("kraft plan ", "scenario"), ("kraft run ", "scenario"), ("kraft eval ", "scenario"),
        ("kraft record ", "scenario"), ("kraft drive ", "scenario"), ("kraft world ", "scenario"),
        ("kraft run turns --method ", "method"), ("kraft drive turns --method ", "method"),
        ("kraft eval --methods ", "method"), ("kraft eval --suite ", "suite"),
        ("kraft drive turns --robot ", "robot"), ("kraft world turns --robot ", "robot"),
        ("kraft doctor --robot ", "robot"), ("kraft plan turns --vehicle ", "vehicle"),
        ("kraft run turns --vehicle ", "vehicle"), ("kraft eval --vehicle ", "vehicle"),
        ("kraft drive turns --vehicle ", "vehicle"), ("kraft world turns --vehicle ", "vehicle"),
        ("kraft record --vehicle ", "vehicle"), ("kraft record --for ", "vehicle"),
        ("kraft generate rooms --vehicle ", "vehicle"), ("kraft import map m.yaml --vehicle ", "vehicle"),
    ],
)  # fmt: skip
def test_every_name_that_a_command_takes_is_proposed(
    line: str, kind: bundled.Kind, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert completed(line, monkeypatch, capsys) == list(bundled.names(kind))


@pytest.mark.usefixtures("folder")
def test_names_and_files_that_can_be_checked_are_proposed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("mushroom.yaml", "other.yaml", ".mushr-hidden"):
        Path(name).touch()
    Path("mushr-maps").mkdir()
    proposed = completed("kraft validate mush", monkeypatch, capsys)
    assert len(proposed) == len(set(proposed))
    bundled_names = {name for name in bundled.names("vehicle") + bundled.names("robot") if name.startswith("mush")}
    assert bundled_names | {"mushroom.yaml", "mushr-maps/"} == set(proposed)
    kinds: tuple[bundled.Kind, ...] = ("scenario", "method", "vehicle", "robot", "suite")
    everything = set(completed("kraft validate ", monkeypatch, capsys))
    assert all(set(bundled.names(kind)) < everything for kind in kinds)
    assert completed("kraft validate othe", monkeypatch, capsys) == []  # the shell completes files then


@pytest.mark.parametrize(
    "line",
    [
        "kraft ",
        "kraft run ",
        "kraft generate ",
        "kraft validate ",
        "kraft eval --methods kraft,",
        "kraft plan turns --planner ",
    ],
)
def test_the_shell_waits_for_no_heavy_module(line: str) -> None:
    code = (
        "import sys; from kraft_cli.main import main; status = main([]); "
        f"print('loaded', [name for name in {HEAVY!r} if name in sys.modules], status, file=sys.stderr)"
    )
    environment = {**os.environ, VARIABLE: "complete_bash", "COMP_WORDS": line}
    environment["COMP_CWORD"] = str(len(line.split(" ")) - 1)
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert run.stdout.split()
    assert run.stderr == "loaded [] 0\n"


def test_bash_completes_with_the_script_that_is_shown(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    bash = shutil.which("bash")
    assert bash is not None
    (tmp_path / "kraft").write_text(f'#!/bin/sh\nexec {sys.executable} -m kraft_cli "$@"\n')
    (tmp_path / "kraft").chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}", "HOME": str(tmp_path)}
    script = (
        'eval "$(kraft --show-completion)"; COMP_WORDS=(kraft run slo); COMP_CWORD=2; '
        '_kraft_completion kraft; echo "${COMPREPLY[@]}"; complete -p kraft'
    )
    run = subprocess.run([bash, "--norc", "-c", script], env=environment, capture_output=True, text=True, check=False)
    assert (run.stdout, run.stderr) == ("slope\ncomplete -o default -F _kraft_completion kraft\n", "")


def test_zsh_and_fish_get_their_own_forms(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("_TYPER_COMPLETE_ARGS", "kraft run slo")
    monkeypatch.setenv(VARIABLE, "complete_zsh")
    assert main([]) == 0
    assert capsys.readouterr().out == "_arguments '*: :((\"slope\"))'\n"
    monkeypatch.setenv(VARIABLE, "complete_fish")
    monkeypatch.setenv("_TYPER_COMPLETE_FISH_ACTION", "get-args")
    assert main([]) == 0
    assert capsys.readouterr().out == "slope\n"
    monkeypatch.setenv("_TYPER_COMPLETE_FISH_ACTION", "is-args")
    assert main([]) == 0
    monkeypatch.setenv("_TYPER_COMPLETE_ARGS", "kraft run nothing-like-it")
    assert main([]) == 1  # fish completes files then


def test_a_request_of_an_unknown_shell_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(VARIABLE, "complete_tcsh")
    assert main([]) == 1
    assert capsys.readouterr() == ("", "Shell tcsh not supported.\n")


def test_completion_is_installed_where_the_shell_reads_it(tmp_path: Path) -> None:
    environment = {**os.environ, "HOME": str(tmp_path), "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    command = [sys.executable, "-m", "kraft_cli", "--install-completion", "bash"]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")
    assert VARIABLE in (tmp_path / ".bash_completions" / "kraft.sh").read_text()
    assert "kraft.sh" in (tmp_path / ".bashrc").read_text()


def test_words_of_a_list_are_completed_one_after_the_other() -> None:
    complete = comma_separated(words("one", "only", "two"))
    assert complete("") == ["one", "only", "two"]
    assert complete("on") == ["one", "only"]
    assert complete("one,o") == ["one,only"]
    assert complete("one,two,") == ["one,two,only"]
    assert names("suite", "other")("o") == ["other"]


def test_without_a_request_of_the_shell_a_command_runs(capsys: pytest.CaptureFixture[str]) -> None:
    assert VARIABLE not in os.environ
    assert main(["list", "suites", "--json"]) == 0
    assert [item["name"] for item in json.loads(capsys.readouterr().out)["items"]] == ["hard", "paper"]
