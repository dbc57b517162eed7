"""A plan, its tree and its grids as another process makes them."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys

from support.paths import ROOT, TESTS

PROGRAM = """
import sys
sys.path.insert(0, {tests!r})
import numba
from support.kernels import START, turns
from ompl_ext.query import Safety
dirt = turns(Safety(delta=0.02, delta_per_speed=0.05))
dirt.start(START, 7)
dirt.grow(iterations=1500)
plan, tree = dirt.plan(), dirt.tree()
parts = [plan.trajectory, plan.controls, plan.durations, plan.times, plan.contingency.states, tree.states, tree.costs]
sys.stdout.buffer.write(b"".join(a.tobytes() for a in (*parts, dirt.problem.field, dirt.problem.togo)))
sys.stderr.write(str(numba.config.CPU_NAME))
"""


def planned(**environment: str) -> tuple[str, str]:
    """Hash of a plan, its tree and its grids as another process makes them, and the processor compiled for."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(tests=str(TESTS))],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr.decode()
    assert len(done.stdout) > 10_000
    return hashlib.sha256(done.stdout).hexdigest(), done.stderr.decode()
