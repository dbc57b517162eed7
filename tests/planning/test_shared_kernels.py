"""Kernels that vehicles share: other processes compile them meanwhile, and what these cannot is compiled here."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from kraft.planning import shared_kernels
from kraft.planning.shared_kernels import SHARED, Meanwhile, Progress, SharedKernels, processes_for

NAMES = ("one", "two", "three")
SLEEPS = "import time; time.sleep(1000)"


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[list[str]]:
    """Names of the parts that this process compiles, of three that there are."""
    compiled = list[str]()
    for name in NAMES:
        part = SharedKernels(f"part {name}", lambda name=name: compiled.append(name))
        monkeypatch.setitem(SHARED, name, part)
    monkeypatch.setattr(shared_kernels, "_marker", lambda name: tmp_path / name)
    monkeypatch.setattr(shared_kernels, "mark", lambda _: None)
    yield compiled
    assert not [thread for thread in threading.enumerate() if "_serve" in thread.name]


def processes_run(monkeypatch: pytest.MonkeyPatch, program: str) -> list[subprocess.Popen[bytes]]:
    """Processes that run a program with the name of the part as its argument, as they begin."""
    begun = list[subprocess.Popen[bytes]]()

    def compiling(name: str) -> subprocess.Popen[bytes]:
        begun.append(subprocess.Popen([sys.executable, "-c", program, name]))
        return begun[-1]

    monkeypatch.setattr(shared_kernels, "_compiling", compiling)
    return begun


def test_a_process_compiles_what_this_one_does_not(here: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    begun, told = processes_run(monkeypatch, ""), list[str]()
    with Meanwhile(NAMES, Progress(3, told.append), 1) as meanwhile:
        deadline = time.monotonic() + 30.0
        while len(told) < 3 and time.monotonic() < deadline:
            time.sleep(0.01)
        meanwhile.finish(lambda: None)
    assert (len(begun), here) == (3, [])
    assert [line.split(": ")[1] for line in told] == [
        "compiled part one (1 of 3)", "compiled part two (2 of 3)", "compiled part three (3 of 3)",
    ]  # fmt: skip


def test_this_process_takes_its_share(here: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    program = f"import pathlib, time\nwhile not pathlib.Path({str(tmp_path / 'go')!r}).exists(): time.sleep(0.01)"
    begun, told = processes_run(monkeypatch, program), list[str]()
    with Meanwhile(NAMES, Progress(3, told.append), 1) as meanwhile:
        while not begun:
            time.sleep(0.01)
        meanwhile.finish((tmp_path / "go").touch)
    assert (len(begun), here) == (1, ["two", "three"])
    assert len(told) == 3


def test_what_a_process_cannot_compile_is_compiled_here(here: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    begun, told = processes_run(monkeypatch, "import sys; sys.exit(sys.argv[1] == 'two')"), list[str]()
    with Meanwhile(NAMES, Progress(3, told.append), 3) as meanwhile:
        while len(begun) < 3:
            time.sleep(0.01)
        meanwhile.finish(lambda: None)
    assert here == ["two"]
    assert len(told) == 3


def test_processes_end_with_the_context(here: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    begun = processes_run(monkeypatch, SLEEPS)

    def interrupted() -> None:
        raise KeyboardInterrupt

    progress = Progress(3, lambda _: None)
    with pytest.raises(KeyboardInterrupt), Meanwhile(NAMES[:2], progress, 2) as meanwhile:  # noqa: PT012
        while len(begun) < 2:
            time.sleep(0.01)
        assert progress.present in ("compiling part one; part two", "compiling part two; part one")
        meanwhile.finish(interrupted)
    assert all(process.poll() is not None for process in begun)
    assert here == []


def test_one_core_compiles_everything_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    for cores, counts in ((1, [0, 0, 0]), (2, [0, 1, 1]), (16, [0, 1, 3])):
        monkeypatch.setattr(shared_kernels, "usable_cores", lambda cores=cores: cores)
        assert [processes_for(shared, with_others=True) for shared in (0, 1, 5)] == counts
    assert [processes_for(shared, with_others=False) for shared in (0, 1, 5)] == [0, 0, 3]
