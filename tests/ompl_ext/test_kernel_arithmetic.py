"""The same seed gives the same bytes whatever instructions the processor has."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys

import pytest
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


def test_two_processes_make_the_same_plan() -> None:
    assert planned() == planned()


@pytest.mark.slow
def test_a_processor_without_vector_extensions_makes_the_same_plan(tmp_path_factory: pytest.TempPathFactory) -> None:
    cache = tmp_path_factory.mktemp("kernels")
    native, _ = planned()
    generic, name = planned(KRAFT_CACHE_DIR=str(cache), NUMBA_CPU_NAME="generic")
    assert name == "generic"
    assert generic == native
