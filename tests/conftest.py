"""The whole suite: interrupts can be tested in any shell, and kernels are compiled before the workers need them."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import hypothesis
import pytest
from support.paths import ROOT, TESTS

from ompl_ext.cores import ONE_BLAS_THREAD

COMPILE = """
import sys
from kraft.planning.shared_kernels import SHARED, compile_shared
from kraft.sysid.factor_graph import ensure_identification_compiled
from kraft.vehicles.load import load_vehicle
from ompl_ext.kernels.callback_kernel import grow
from ompl_ext.kernels.specialise import (
    are_steps_cached, is_cached, kernels, optional_module, polish_kernels, step_kernels
)
from support.kernels import ROVER
for name in sys.argv[1:]:
    if name in SHARED:
        compile_shared(name)
        continue
    if name == "identification":
        ensure_identification_compiled(load_vehicle("mushr"), "mushr", str)
        continue
    if name == "callbacks":
        grow()
        continue
    vehicle = ROVER if name == "rover" else load_vehicle(name)
    if not is_cached(vehicle):
        kernels(vehicle)
    polish_kernels(vehicle)
    if name == "mushr":
        optional_module(vehicle, "rollouts")
        optional_module(vehicle, "sst")
    if name not in ("benchmark", "rover") and not are_steps_cached(vehicle):
        step_kernels(vehicle)
"""
FIRST = (("planner", "mushr"), ("maps", "poses", "control", "filter", "callbacks", "identification"))
"""What a process each compiles first: the others use the kernels that the first one shares with them."""
OTHERS = (("benchmark", "mushr-drive", "mushr-force", "f1tenth"), ("rover", "jackal", "unicycle2", "mushr-lag"))
"""Takes about the same time in two processes that compile nothing twice."""
LONG = (
    "test_interrupts", "test_quality", "test_cli_sysid", "test_evaluation_workers", "test_examples", "test_theorem",
    "test_example_identify", "test_evaluation_cluster", "test_benchmarks", "test_docs_python", "test_ompl_planner",
    "test_kernel", "test_video", "test_mutations",
)  # fmt: skip
"""Beginnings of the names of the files that take longest, which begin first."""
DRIVES = "test_drive.py", "test_faults.py"  # on the wall clock


def pytest_configure(config: pytest.Config) -> None:
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # shells do so for jobs in the background
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:  # nohup does
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
    # deadlines and the time that examples take to make tell how busy the machine is
    busy = [hypothesis.HealthCheck.too_slow]
    hypothesis.settings.register_profile("kraft", deadline=None, suppress_health_check=busy)
    hypothesis.settings.load_profile("kraft")
    os.environ.update(ONE_BLAS_THREAD)  # as the command `kraft` does
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # a hundred processes of the tests would compile every module
    in_a_worker = hasattr(config, "workerinput")
    if not in_a_worker and config.getoption("numprocesses", None):
        with ThreadPoolExecutor(len(FIRST)) as pool:  # otherwise each worker would compile all of it
            for stage in FIRST, OTHERS:
                list(pool.map(_compile, stage))


def pytest_collection_finish() -> None:
    """Look for garbage less often, and not among the modules and tests: it took an eighth of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


def pytest_unconfigure() -> None:
    """Let all of it be collected at the end, where OMPL's bindings count what is left."""
    gc.unfreeze()


def pytest_xdist_auto_num_workers() -> int:
    """One worker more than cores: drives on the wall clock, and tests of processes, wait most of their time."""
    return 1 + (os.cpu_count() or 1)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Give the drives to the first worker and the longest files to the second, at the beginning.

    Workers begin with equal shares of the tests in their order here, and take over tests of others when they are done.
    Drives wait most of their time: two of them at once leave a core idle.
    """
    share = len(items) // getattr(config, "workerinput", {"workercount": 1})["workercount"]
    parts: dict[str, list[pytest.Item]] = {"drives": [], "long": [], "other": []}
    for item in items:
        name = item.path.name
        parts["drives" if name in DRIVES else "long" if name.startswith(LONG) else "other"].append(item)
    parts["long"].sort(key=lambda item: next(k for k, name in enumerate(LONG) if item.path.name.startswith(name)))
    beside_drives = max(0, share - len(parts["drives"]))
    other = parts["other"]
    items[:] = [*parts["drives"], *other[:beside_drives], *parts["long"], *other[beside_drives:]]


def _compile(names: Sequence[str]) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(TESTS), *sys.path])}
    subprocess.run([sys.executable, "-c", COMPILE, *names], cwd=ROOT, env=environment, check=True)


@pytest.fixture(autouse=True)
def no_word_of_loading(monkeypatch: pytest.MonkeyPatch) -> None:
    """A command on a busy machine says no more than on an idle one; only this depends on the time that it takes."""
    monkeypatch.setattr("kraft.elapsed.LOADING_INTERVAL", 600.0)
