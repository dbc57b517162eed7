"""Processes of a drive: their memory stays where it is, and collections of garbage are short."""

from __future__ import annotations

import gc
import os
import subprocess
import sys

import pytest
from support.paths import ROOT

from kraft.robot.priority import short_collections

LOCKED = """
from pathlib import Path
from kraft.robot.priority import lock_memory
permitted = lock_memory()
block = bytearray(50_000_000)
status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
print(permitted, int(status["VmLck"].split()[0]), int(status["VmSize"].split()[0]))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux locks what was touched")
def test_memory_is_locked_if_it_is_permitted_also_what_comes_later() -> None:
    done = subprocess.run([sys.executable, "-c", LOCKED], cwd=ROOT, capture_output=True, text=True, check=True)
    permitted, locked, size = done.stdout.split()
    assert permitted == "True" or os.getuid() != 0
    assert (int(locked) > 0.9 * int(size)) if permitted == "True" else int(locked) == 0


def test_what_was_left_out_of_collections_is_collected_again_afterwards() -> None:
    gc.unfreeze()  # of the whole suite
    with short_collections():
        assert gc.get_freeze_count() > 1000
    assert gc.get_freeze_count() == 0


def test_processes_of_a_drive_load_nothing_that_only_identification_from_logs_needs() -> None:
    program = (
        "import sys, kraft.robot.guard, kraft.robot.control_process; "
        "print(sorted({'scipy.stats', 'scipy.optimize', 'kraft.sysid.identify', 'mujoco', 'matplotlib'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
