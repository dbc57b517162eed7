"""A controller of the user's own that fails or does not return in a drive on the wall clock: the vehicle is stopped."""

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
    (tmp_path / "own.py").write_text(CODE.format(where=where, what=what), encoding="utf-8")
    method = tmp_path / "own.yaml"
    method.write_text("base: adaptive-kraft\nname: own\ntitle: Own\ncontroller: {kind: code, code: own.py:Own}\n")
    with Rig(tmp_path, arguments=("--method", str(method))) as rig:
        rig.drive_until(0.5)
        assert rig.stands(6.0)
        _, errors = rig.process.communicate(timeout=30)
    assert word in errors
    assert rig.process.returncode == status
    assert rig.result is None or rig.result.obstacle is None
