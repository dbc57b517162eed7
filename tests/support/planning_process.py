"""A plan, its tree and its grids, in this process and as another process makes them."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys

from ompl_ext.query import Safety
from support.kernels import START, turns
from support.paths import ROOT, TESTS

PROGRAM = """
import sys
sys.path.insert(0, {tests!r})
import numba
from support.planning_process import planned
print(planned(), numba.config.CPU_NAME)
"""


def planned() -> str:
    """Hash of a plan, its tree and its grids."""
    dirt = turns(Safety(delta=0.02, delta_per_speed=0.05))
    dirt.start(START, 7)
    dirt.grow(iterations=1500)
    plan, tree = dirt.plan(), dirt.tree()
    assert plan is not None
    assert plan.contingency is not None
    parts = [
        plan.trajectory,
        plan.controls,
        plan.durations,
        plan.times,
        plan.contingency.states,
        tree.states,
        tree.costs,
    ]
    content = b"".join(a.tobytes() for a in (*parts, dirt.problem.field, dirt.problem.togo))
    assert len(content) > 10_000
    return hashlib.sha256(content).hexdigest()


def planned_elsewhere(**environment: str) -> tuple[str, str]:
    """Hash of the same as another process makes them, and the processor that it compiled for."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(tests=str(TESTS))],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    digest, processor = done.stdout.split()
    return digest, processor
