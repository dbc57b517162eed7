"""Ctrl-C, SIGTERM and SIGHUP at any time: one word, an exit code, and nothing left that stands in the way."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import numba
import pytest
from support.paths import ROOT
from support.planning_process import planned, planned_elsewhere

from kraft_cli import entry
from kraft_cli import main as command_line
from kraft_cli.signals import Stopped, handled
from ompl_ext.interrupts import interrupts_between_passes
from ompl_ext.signals import STOPPING


def interrupt() -> None:
    signal.raise_signal(signal.SIGINT)


def test_an_interrupt_waits_for_the_next_pass_of_the_compiler() -> None:
    reached = []

    def compile_something() -> None:
        with interrupts_between_passes():
            interrupt()
            reached.append("after the interrupt")
            numba.njit("float64(float64)")(lambda x: x + 1.0)
            reached.append("after compiling")

    with pytest.raises(KeyboardInterrupt):
        compile_something()
    assert reached == ["after the interrupt"]


def test_an_interrupt_is_raised_when_it_is_asked_for_and_at_the_end_of_the_outermost_block() -> None:
    with interrupts_between_passes() as check:
        interrupt()
        with pytest.raises(KeyboardInterrupt):
            check()
        check()  # once
    reached = []

    def nested() -> None:
        with interrupts_between_passes():
            with interrupts_between_passes():
                interrupt()
            reached.append("after the inner block")

    with pytest.raises(KeyboardInterrupt):
        nested()
    assert reached == ["after the inner block"]
    with interrupts_between_passes(), interrupts_between_passes() as check:
        interrupt()
        with pytest.raises(KeyboardInterrupt):
            check()


def test_interrupts_mean_what_they_did_before_afterwards() -> None:
    before = signal.getsignal(signal.SIGINT)
    with interrupts_between_passes():
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with interrupts_between_passes():
            interrupt()
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_signal_without_a_handler_of_python_is_left_alone_and_others_keep_their_number() -> None:
    received = list[int]()
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    with interrupts_between_passes():
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    with handled(received.append), interrupts_between_passes() as check:
        signal.raise_signal(signal.SIGTERM)
        assert received == []
        check()
        assert received == [signal.SIGTERM]


def test_another_thread_may_compile() -> None:
    errors: list[BaseException] = []

    def compile_there() -> None:
        try:
            with interrupts_between_passes() as check:
                check()
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=compile_there)
    thread.start()
    thread.join()
    assert errors == []


@pytest.mark.parametrize(
    ("error", "status", "word"),
    [
        (KeyboardInterrupt(), 130, "interrupted"),
        (Stopped(signal.SIGTERM), 143, "terminated"),
        (Stopped(signal.SIGHUP), 129, "hung up"),
    ],
)
def test_a_signal_while_modules_load_is_quiet_and_others_after_it_are_ignored(
    error: BaseException, status: int, word: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped() -> int:
        raise error

    set_handlers = list[tuple[object, ...]]()
    monkeypatch.setattr(command_line, "main", stopped)
    monkeypatch.setattr("kraft_cli.entry.set_handler", lambda _: None)
    monkeypatch.setattr("kraft_cli.entry.signal.signal", lambda *arguments: set_handlers.append(arguments))
    assert entry.main() == status
    assert capsys.readouterr().err == f"{word}\n"
    assert set_handlers == [(number, signal.SIG_IGN) for number in STOPPING]


def test_signals_that_are_ignored_stay_so_and_an_echo_is_ignored() -> None:
    received = list[int]()
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with handled(received.append):
            for number in (signal.SIGHUP, signal.SIGTERM, signal.SIGTERM, signal.SIGINT):
                signal.raise_signal(number)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
    assert received == [signal.SIGTERM, signal.SIGINT]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_in_a_finalizer_ends_the_command_all_the_same(number: int) -> None:
    """Python ignores exceptions of finalizers, so that the signal would be lost."""
    code = f"""
        import signal, time
        from kraft_cli.signals import raise_stopped, repeat_ignored_signals, set_handler, word_of
        class Finalized:
            def __del__(self):
                signal.raise_signal({int(number)})
        repeat_ignored_signals()
        set_handler(raise_stopped)
        try:
            Finalized()
            time.sleep(10.0)
        except KeyboardInterrupt as error:
            print(word_of(error))
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    run = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    assert (run.stdout, run.stderr) == ({signal.SIGINT: "interrupted\n", signal.SIGTERM: "terminated\n"}[number], "")


def test_a_terminal_that_was_closed_gets_no_more_messages_and_hinders_nothing() -> None:
    program = textwrap.dedent("""
        import time
        from kraft_cli import signals, terminal
        signals.set_handler(signals.raise_stopped)
        try:
            print("x", flush=True)
            time.sleep(30)
        except KeyboardInterrupt as error:
            terminal.Terminal().problem("lost")
            raise SystemExit(signals.status_of(error))
    """)
    process, screen = pty.fork()
    if process == 0:
        os.chdir(ROOT)
        os.execv(sys.executable, [sys.executable, "-c", program])
    assert os.read(screen, 1) == b"x"
    os.close(screen)
    assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == 129


def test_an_interrupt_of_the_first_compilation_leaves_a_cache_that_serves_and_a_simpler_processor_plans_the_same(
    tmp_path: Path,
) -> None:
    """To the whole process group, as a terminal sends it.

    The kernels are compiled for a processor without vector extensions, which must make the same bytes: one compilation
    serves two tests, without what neither of them uses.
    """
    compilation = {"KRAFT_CACHE_DIR": str(tmp_path), "NUMBA_CPU_NAME": "generic"}
    environment = {**os.environ, **compilation, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    command = [sys.executable, "-m", "kraft_cli", "plan", "turns", "--vehicle", "benchmark", "--iterations", "100"]
    command += ["--set", "planning.polish=false"]
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, process_group=0
    ) as process:
        assert process.stderr is not None
        assert process.stderr.readline().startswith("compiling 5 parts for this machine, once")
        while not list(tmp_path.rglob("*.nbc")):  # the first functions are in the cache, and others not
            assert process.poll() is None
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate()
    assert (process.returncode, out, err) == (130, "", "interrupted\n")
    begun = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbc")}
    again = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert [line[:8] for line in again.stderr.splitlines() if not line.startswith("  ")][1] == "compiled"
    generic, name = planned_elsewhere(**compilation)
    assert name == "generic"
    assert generic == planned()
    assert begun.items() <= {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbc")}.items(), "used again"
