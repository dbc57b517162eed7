"""The user's code fails or does not return in a drive on the wall clock: the vehicle is stopped."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.rig import Rig

CODE = """
import time
from pathlib import Path

PROCESS = Path("/proc/self/comm")

class Own:
    def __init__(self, model): ...
    def command(self, estimate, reference):
        controls = PROCESS.read_text().strip() in ("kraft control", "kraft guard")
        if estimate.time > 2.5 and {where}:
            {what}
        return reference.control_at(estimate.time)
"""


ELSEWHERE = """
from pathlib import Path

from kraft.robot.{module} import {subject}

PROCESS = Path("/proc/self/comm")

def failing(self, *arguments):
    controls = PROCESS.read_text().strip() == "kraft control"
    if float(getattr(arguments[0], "time", arguments[0])) > 2.5 and controls == {controls}:
        raise ValueError("no number")
    return usual(self, *arguments)

usual = {subject}.{method}
{subject}.{method} = failing

class Own:
    def __init__(self, model): ...
    def command(self, estimate, reference):
        return reference.control_at(estimate.time)
"""
"""Code that raises where kraft does not call the controller, as the functions of a user's vehicle can."""


@pytest.mark.parametrize(
    ("where", "what", "status", "word"),
    [
        ("not controls", "raise RuntimeError('no way')", 2, "the vehicle is stopped at once: "),
        ("controls", "raise RuntimeError('no way')", 2, "the vehicle is stopped at once: "),
        ("not controls", "time.sleep(1000)", 1, "the planner has waited for "),
        ("controls", "time.sleep(1000)", 1, "the controller has not reported for "),
    ],
)
def test_the_vehicle_is_stopped_and_the_terminal_says_so(
    tmp_path: Path, where: str, what: str, status: int, word: str
) -> None:
    check_stop(tmp_path, CODE.format(where=where, what=what), status, word)


@pytest.mark.parametrize(
    ("module", "subject", "method", "controls", "word"),
    [
        ("planner", "Planner", "decide", False, "the vehicle is stopped at once: "),
        ("tracker", "Tracker", "estimate", True, "the brake guard stops the vehicle: "),
    ],
)
def test_errors_that_are_raised_anywhere_in_motion_are_those_of_the_users_line(
    tmp_path: Path, module: str, subject: str, method: str, controls: bool, word: str
) -> None:
    code = ELSEWHERE.format(module=module, subject=subject, method=method, controls=controls)
    check_stop(tmp_path, code, 2, word + f"{tmp_path}/own.py:11: ValueError: no number")


def check_stop(folder: Path, code: str, status: int, word: str) -> None:
    """Drive with a controller of this `code`, which fails after 2.5 s, until the vehicle stands."""
    (folder / "own.py").write_text(code, encoding="utf-8")
    method = folder / "own.yaml"
    method.write_text("base: adaptive-kraft\nname: own\ntitle: Own\ncontroller: {kind: code, code: own.py:Own}\n")
    with Rig(folder, arguments=("--method", str(method))) as rig:
        rig.drive_until(0.5)
        assert rig.stands(6.0)
        _, errors = rig.process.communicate(timeout=30)
    assert word in errors
    assert rig.process.returncode == status
    assert rig.result is None or rig.result.obstacle is None
