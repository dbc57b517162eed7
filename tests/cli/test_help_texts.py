"""Pages of help: one style of defaults, lines of usage, and defaults as the code has them."""

import inspect
import re

import pytest

from kraft.evaluation.experiment import METHODS, SUITE, TRIALS
from kraft.sysid.data import HOLDOUT_FRACTION
from kraft.worlds.generate import DENSITY, KINDS, MIXED
from kraft.worlds.generate import USUAL as USUAL_VEHICLES
from kraft.worlds.imports import CAR, ROBOT
from kraft_cli.app import _COMMANDS
from kraft_cli.main import main
from kraft_cli.work.record import PLANNED_RUNS, RUNS, RecordRequest

USAGE = {
    "plan": "SCENARIO",
    "run": "SCENARIO",
    "eval": "[SCENARIO...]",
    "drive": "SCENARIO",
    "world": "SCENARIO",
    "report": "RESULTS",
    "compare": "A B",
    "record": "[SCENARIO]",
    "sysid": "LOGS...",
    "import": "{barn|dynobench|map} SOURCE...",
    "generate": "{" + "|".join((*KINDS, MIXED)) + "}",
    "validate": "FILE...",
    "list": "{scenarios|suites|methods|vehicles|planners|robots}",
    "doctor": "",
}
DEFAULT = re.compile(r"\[default: .*?\]")


def help_of(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Page of help in one line."""
    assert main([command, "--help"]) == 0
    return " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("command", _COMMANDS)
def test_the_line_of_usage_has_each_argument_once(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    usage = f"Usage: kraft {command} [OPTIONS] {USAGE[command]}".rstrip()
    first_line = (inspect.getdoc(_COMMANDS[command]) or "").splitlines()[0]
    assert help_of(command, capsys).startswith(f"{usage} {first_line}")


@pytest.mark.parametrize("command", _COMMANDS)
def test_defaults_are_in_brackets_and_types_of_python_nowhere(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = help_of(command, capsys)
    assert not re.search(
        r"default|\(\d+\)|instead of the (method|scenario|usual)|else the source", DEFAULT.sub("", text)
    )
    assert not re.search(r"<\w+|Path\]", text)
    assert not re.search(r"\[default: \d+\.0\]", text), "whole numbers are written as such, as elsewhere"


@pytest.mark.parametrize(
    ("command", "option", "default"),
    [
        ("eval", "SCENARIO", f"those of the suite {SUITE}"),
        ("eval", "--trials N", str(TRIALS)),
        ("eval", "--methods A,B", f"the paper's {('six', 'seven', 'eight')[len(METHODS) - 6]}"),
        ("record", "SCENARIO", RecordRequest.scenario),
        ("record", "--runs N", f"{RUNS}; with --for {PLANNED_RUNS}"),
        ("record", "--seed N", str(RecordRequest.seed)),
        ("plan", "--after S", "0"),
        ("world", "--speed X", "1"),
        ("sysid", "--horizon S", "3"),
        ("sysid", "--extras auto|plan|none|A,B", "auto; with --out plan"),
        ("sysid", "--holdout FRACTION", f"{HOLDOUT_FRACTION:g} of four logs or more, else 0"),
        ("generate", "--density SHARE", f"{DENSITY:g}"),
        ("generate", "--vehicle NAME|FILE", "mushr; " + ", ".join(f"for {k} {v}" for k, v in USUAL_VEHICLES.items())),
        ("import", "--vehicle NAME|FILE", f"barn {ROBOT}, dynobench the problem's, map {CAR}"),
    ],
)
def test_a_default_is_that_of_the_code(
    command: str, option: str, default: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text = help_of(command, capsys)
    described = text[text.index(" " + option + " ", text.index("Arguments:")) :]
    found = DEFAULT.search(described)
    assert found is not None
    assert found.group() == f"[default: {default}]"
