"""The whole suite: interrupts can be tested in any shell, and kernels are compiled before the workers need them."""

from __future__ import annotations

import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
from support.paths import ROOT

COMPILE = """
import sys
from kraft.planning.compilation import ensure_compiled
from kraft.sysid.compilation import ensure_compiled as ensure_identification
from kraft.vehicles.load import load_vehicle
vehicle = load_vehicle(sys.argv[1])
ensure_compiled(vehicle, str)
if vehicle.name.startswith("mushr"):
    ensure_identification(vehicle, vehicle.name, str)
"""


def pytest_configure(config: pytest.Config) -> None:
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # shells do so for jobs in the background
        signal.signal(signal.SIGINT, signal.default_int_handler)
    in_a_worker = hasattr(config, "workerinput")
    if not in_a_worker and config.getoption("numprocesses", None):
        _compile("mushr", "mushr-drive", "mushr-lag", "unicycle2", "benchmark")


def _compile(*vehicles: str) -> None:
    """Two vehicles at a time; otherwise each worker would compile all of them."""
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(_compile_one, vehicles))


def _compile_one(vehicle: str) -> None:
    subprocess.run([sys.executable, "-c", COMPILE, vehicle], cwd=ROOT, check=True)
