"""The whole suite: interrupts can be tested in any shell, and kernels are compiled before the workers need them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import pytest
from support.paths import ROOT

COMPILE = """
import sys
from kraft.planning.compilation import ensure_compiled
from kraft.sysid.compilation import ensure_compiled as ensure_identification
from kraft.vehicles.load import load_vehicle
for name in sys.argv[1:]:
    vehicle = load_vehicle(name)
    ensure_compiled(vehicle, str)
    if name.startswith("mushr"):
        ensure_identification(vehicle, name, str)
"""
VEHICLES = (("mushr", "unicycle2", "benchmark"), ("mushr-drive", "mushr-lag"))
"""Vehicles that two processes compile, in about the same time each."""
LONG = (
    "test_interrupts", "test_cli_sysid", "test_evaluation_workers", "test_theorem", "test_benchmarks",
    "test_evaluation_cluster", "test_example_identify", "test_examples", "test_ompl_planner", "test_docs_python",
    "test_kernel", "test_video", "test_mutations",
)  # fmt: skip
"""Beginnings of the names of the files that take longest, which begin first."""


def pytest_configure(config: pytest.Config) -> None:
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # shells do so for jobs in the background
        signal.signal(signal.SIGINT, signal.default_int_handler)
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # a hundred processes of the tests would compile every module
    in_a_worker = hasattr(config, "workerinput")
    if not in_a_worker and config.getoption("numprocesses", None):
        with ThreadPoolExecutor(len(VEHICLES)) as pool:  # otherwise each worker would compile all of them
            list(pool.map(_compile, VEHICLES))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files: a core is idle while the other one runs what began last."""
    items.sort(key=lambda item: next((k for k, name in enumerate(LONG) if item.path.name.startswith(name)), len(LONG)))


def _compile(vehicles: Sequence[str]) -> None:
    subprocess.run([sys.executable, "-c", COMPILE, *vehicles], cwd=ROOT, check=True)
