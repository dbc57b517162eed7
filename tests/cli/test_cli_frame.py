"""The frame of the command line: exit codes, streams, and errors that explain themselves."""

from __future__ import annotations

import errno
import io
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from support.messages import without_loading
from support.paths import ROOT
from support.screen import Screen

from kraft import __version__
from kraft.errors import (
    Defect,
    Diagnostic,
    InputError,
    KraftError,
    MissingAsset,
    MissingDependency,
    NegativeResult,
)
from kraft_cli.boundary import guarded
from kraft_cli.exit_status import ExitStatus
from kraft_cli.main import main
from kraft_cli.signals import Stopped
from kraft_cli.terminal import Terminal
from ompl_ext.cores import ONE_BLAS_THREAD


def ended_with(error: BaseException, *, traceback: bool = False) -> tuple[ExitStatus, str]:
    """Exit code and stderr of a command that raises ``error``."""

    def command() -> ExitStatus:
        raise error

    terminal = Terminal(io.StringIO(), io.StringIO(), traceback=traceback)
    status = guarded(terminal, command)
    assert isinstance(terminal.out, io.StringIO)
    assert terminal.out.getvalue() == ""
    assert isinstance(terminal.err, io.StringIO)
    return status, terminal.err.getvalue()


@pytest.mark.parametrize(("code", "status"), [(None, 0), (0, 0), (2, 2), (5, 70), ("goodbye", 70), ([2], 70)])
def test_an_exit_with_a_code_that_kraft_does_not_have_is_a_defect(code: object, status: int) -> None:
    found, err = ended_with(SystemExit(code))
    assert found == status
    assert ("ended the command" in err) == (status == 70)
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (InputError.of("x", "is wrong", "expected right"), 2),
        (MissingDependency("gtsam does not load"), 3),
        (MissingAsset("no scenarios"), 3),
        (NegativeResult("no plan found"), 1),
        (Defect("a plan is in collision"), 70),
        (KraftError("something else"), 70),
        (ZeroDivisionError("division by zero"), 70),
        (KeyboardInterrupt(), 130),
        (Stopped(signal.SIGTERM), 143),
        (Stopped(signal.SIGHUP), 129),
    ],
)
def test_each_kind_of_error_has_its_exit_code_and_no_traceback(error: BaseException, status: int) -> None:
    code, text = ended_with(error)
    assert code == status
    assert text
    assert "Traceback" not in text


def test_causes_are_shown_as_a_chain() -> None:
    error = MissingDependency("gtsam does not load")
    error.__cause__ = ImportError("libboost.so is missing")
    error.__cause__.__cause__ = OSError("no such file")
    _, text = ended_with(error)
    assert text.splitlines() == [
        "error: gtsam does not load",
        "  caused by: ImportError: libboost.so is missing",
        "  caused by: OSError: no such file",
    ]


def test_a_traceback_is_shown_when_it_is_asked_for() -> None:
    _, text = ended_with(ZeroDivisionError("division by zero"), traceback=True)
    assert "Traceback (most recent call last)" in text
    assert "raise error" in text


def test_every_diagnostic_is_one_line_that_an_editor_can_jump_to() -> None:
    error = InputError([Diagnostic("b.yaml", "p", "e", 2, 1), Diagnostic("a.yaml", "p", "e", 3, 4, "goal.radius")])
    _, text = ended_with(error)
    assert text.splitlines() == ["a.yaml:3:4: goal.radius: p; e", "b.yaml:2:1: p; e"]


def test_colour_is_for_a_terminal_that_did_not_refuse_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    screen = Screen()
    Terminal(err=screen).error("x")
    assert "\033[" in screen.getvalue()
    monkeypatch.setenv("NO_COLOR", "1")
    plain = Screen()
    Terminal(err=plain).error("x")
    assert plain.getvalue() == "error: x\n"


def test_numbers_that_are_not_json_are_refused() -> None:
    with pytest.raises(ValueError, match="Out of range float"):
        Terminal(io.StringIO()).json("kraft.test/1", {"a": float("nan")})


@pytest.mark.parametrize(
    ("argv", "expected"),
    [
        (["lst"], "'lst'; did you mean 'list'?\n"),
        (["validate", "--jsn", "x"], "--jsn; did you mean '--json'?\n"),
        (["validate"], "'FILE'"),
        (["list", "vehicle"], "'vehicles'"),
        (["--vision"], "--vision; did you mean '--version'?\n"),
    ],
)
def test_wrong_usage_ends_with_2_and_a_suggestion(
    argv: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(argv) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert expected in err


def test_without_a_command_the_help_is_shown_and_usage_is_wrong(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("Usage: kraft")


def test_help_and_version_are_data(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"kraft {__version__}\n"
    assert main(["validate", "--help"]) == 0
    assert "--json" in capsys.readouterr().out


def test_global_flags_mean_the_same_before_and_after_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "methods", "-q"]) == main(["-q", "list", "methods"]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("closed", [(0,), (1,), (2,), (0, 1, 2)])
def test_closed_streams_change_neither_the_other_stream_nor_the_exit_code(
    closed: tuple[int, ...], tmp_path: Path
) -> None:
    redirections = " ".join(f"{number}>&-" for number in closed)
    command = f"{sys.executable} -m kraft_cli generate posts --json --out {tmp_path}/worlds {redirections}"
    done = subprocess.run(
        ["sh", "-c", command], check=False, capture_output=True, text=True, stdin=subprocess.DEVNULL, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    assert ("world 1 of 1" in done.stderr) == (2 not in closed)
    if 1 in closed:
        assert done.stdout == ""
    else:
        assert json.loads(done.stdout)["schema"].startswith("kraft.")


def test_names_that_are_no_text_are_refused_before_the_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenario = tmp_path / os.fsdecode(b"t\xfcr.yaml")
    scenario.write_bytes((ROOT / "scenarios/turns.yaml").read_bytes())
    out = tmp_path / "plans"
    assert main(["plan", str(scenario), "--out", str(out)]) == 2
    problems = capsys.readouterr().err.splitlines()
    assert len(problems) == 1
    assert "not text in the encoding of file names" in problems[0]
    assert not out.exists()


def test_a_closed_pipe_is_not_an_error() -> None:
    script = "import sys; from kraft_cli.main import main; sys.exit(main(['list', 'scenarios']))"
    read, write = os.pipe()
    os.close(read)
    try:
        done = subprocess.run(
            [sys.executable, "-c", script], cwd=ROOT, stdout=write, stderr=subprocess.PIPE, check=False
        )
    finally:
        os.close(write)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize("buffered", [True, False])
@pytest.mark.parametrize("argv", [["list", "planners"], ["list", "planners", "--json"], ["--help"], ["run", "--help"]])
def test_a_full_disk_behind_stdout_is_wrong_input_in_one_line(argv: list[str], buffered: bool) -> None:
    environment = {**os.environ, "PYTHONUNBUFFERED": "" if buffered else "1"}
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            [sys.executable, "-m", "kraft_cli", *argv],
            cwd=ROOT, env=environment, stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert done.returncode == 2
    assert re.fullmatch("stdout: .*No space left on device.*\n", done.stderr)


def test_a_full_disk_behind_something_else_is_no_defect(capsys: pytest.CaptureFixture[str]) -> None:
    status, text = ended_with(OSError(errno.ENOSPC, "No space left on device", "cache/kernel.nbc"))
    assert status == 2
    assert text.startswith("cache/kernel.nbc: ")


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="there is no /proc")
def test_a_cache_that_cannot_be_written_is_explained_in_one_line() -> None:
    environment = {**os.environ, "KRAFT_CACHE_DIR": "/proc/c"}
    done = subprocess.run(
        [sys.executable, "-m", "kraft_cli", "plan", "turns"],
        cwd=ROOT, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"/proc/c/\S+: .*KRAFT_CACHE_DIR.*\n", without_loading(done.stderr))


def test_light_commands_do_not_load_heavy_packages() -> None:
    script = (
        "import sys; from kraft_cli.main import main\n"
        "for argv in (['--version'], ['list', 'scenarios'], ['list', 'planners']): assert main(argv) == 0\n"
        "heavy = {'numba', 'ompl', 'matplotlib', 'mujoco', 'gtsam', 'scipy', 'numpy', 'fcl'} & set(sys.modules)\n"
        "sys.exit(f'loaded {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(("given", "threads"), [({}, 1), ({"OPENBLAS_NUM_THREADS": "2"}, 2)])
def test_linear_algebra_works_in_one_thread_unless_the_environment_says_otherwise(
    given: dict[str, str], threads: int
) -> None:
    script = (
        "import os, sys; sys.argv = ['kraft', '--version']\n"
        "from kraft_cli.entry import main; main()\n"
        "assert 'numpy' not in sys.modules\n"
        "print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    environment = {k: v for k, v in os.environ.items() if k not in ONE_BLAS_THREAD} | given
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split()[-1] == str(threads)


def test_the_version_is_that_of_the_project() -> None:
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project.get("version", __version__) == __version__
