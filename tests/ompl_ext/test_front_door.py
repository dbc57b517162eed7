"""`from ompl_ext import ...`: every name is there, is the one of its module, and costs nothing until it is used."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module

import pytest
from support.paths import ROOT

import ompl_ext

NAMES = {
    "DIRT": "planner",
    "DirtSolver": "solver",
    "Footprint": "vehicle",
    "Goal": "query",
    "Safety": "query",
    "SafetyValidityChecker": "validity",
    "Settings": "query",
    "Vehicle": "vehicle",
    "Workspace": "obstacles",
    "atan": "trigonometry",
    "box": "obstacles",
    "cos": "trigonometry",
    "derivative": "vehicle",
    "simple_setup": "system",
    "sin": "trigonometry",
    "tan": "trigonometry",
    "verify": "verification",
}


def test_the_public_names_are_these() -> None:
    assert dir(ompl_ext) == sorted(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_the_one_of_its_module(name: str) -> None:
    assert getattr(ompl_ext, name) is getattr(import_module(f"ompl_ext.{NAMES[name]}"), name)


def test_importing_the_package_loads_nothing_heavy() -> None:
    script = "import sys, ompl_ext; print(*sorted({'numba', 'numpy', 'ompl', 'fcl', 'scipy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.split() == []
