"""Worker processes: results do not depend on how many there are, and nothing that happens to them is fatal."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from support import dead_worker, fake_trials
from support.evaluation import StoppingObserver, kept, places, refused
from support.paths import ROOT

from kraft.errors import Code, Defect, InputError, MissingDependency
from kraft.evaluation import Evaluation, evaluate, evaluator, job, processes
from kraft.evaluation.experiment import experiment_of
from kraft.evaluation.job import Job, perform
from kraft.evaluation.journal import TrialRow
from kraft.trial.result import TrialResult, TrialSpec
from kraft_cli.main import main


@pytest.fixture(autouse=True)
def left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder in which trials leave files."""
    folder = tmp_path / "left"
    folder.mkdir()
    monkeypatch.setenv(fake_trials.LEFT, str(folder))
    return folder


def run(
    trial: fake_trials.Trial, jobs: int = 2, trials: int = 4, *, inline: bool = False, **options: Any
) -> Evaluation:
    with pytest.MonkeyPatch.context() as patch:
        fake_trials.use(patch, trial, inline=inline)
        return evaluate(["turns"], ["kraft"], trials, 0, jobs, **options)


def outcomes(found: Evaluation) -> list[tuple[int, str]]:
    return [(row.seed, row.outcome) for row in found.rows]


def kraft(trial: fake_trials.Trial, *arguments: str) -> subprocess.Popen[str]:
    """Start `kraft` in a process group of its own."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*sys.path, str(ROOT)])}
    command = [sys.executable, "-m", "support.kraft_command", trial.__name__, *arguments]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, env=environment, text=True, start_new_session=True, **pipes)  # type: ignore[call-overload, no-any-return]


def until_lines(path: Path, count: int) -> None:
    """Wait for a file to have that many lines."""
    limit = time.monotonic() + 60
    while not path.exists() or path.read_bytes().count(b"\n") < count:
        assert time.monotonic() < limit
        time.sleep(0.02)


@pytest.fixture
def whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of an evaluation of two rows of six trials that nothing happened to."""
    with monkeypatch.context() as patched:
        fake_trials.use(patched, fake_trials.quick, inline=True)
        evaluate(["turns"], ["kraft", "oneshot-openloop"], 6, 0, out=tmp_path / "whole")
    return tmp_path / "whole"


COMMAND = ("eval", "turns", "--methods", "kraft,oneshot-openloop", "--trials", "6")


def test_one_and_two_workers_give_the_same_whatever_ends_first(tmp_path: Path) -> None:
    one = run(fake_trials.quick, 1, out=tmp_path / "one")
    two = run(fake_trials.uneven, 2, out=tmp_path / "two")
    assert outcomes(one) == outcomes(two)
    assert kept(tmp_path / "one") == kept(tmp_path / "two")
    order = [json.loads(line)["seed"] for line in (tmp_path / "two/trials.jsonl").read_text().splitlines()]
    assert order != sorted(order)


def test_a_worker_that_dies_is_replaced_and_its_trial_repeated(left: Path) -> None:
    observer = StoppingObserver()
    assert outcomes(run(fake_trials.dies_once, observer=observer)) == outcomes(run(fake_trials.quick, inline=True))
    assert len(list(left.glob("*-1-died-*"))) == 2
    assert len(observer.messages) == 1
    assert "turns, kraft, seed 1" in observer.messages[0]
    assert "SIGKILL" in observer.messages[0]


def test_a_trial_that_kills_its_worker_twice_has_failed_and_the_others_go_on(left: Path) -> None:
    found = run(fake_trials.dies, trials=6)
    failed = [row for row in found.rows if row.outcome == "failed"]
    assert [(row.seed, row.error) for row in failed] == [(1, "its worker process died 2 times (exit code 7)")]
    assert len(found.rows) == 6
    assert len(list(left.glob("*-died-*"))) == 2


def test_a_defect_in_a_trial_fails_that_trial_only() -> None:
    found = run(fake_trials.raises, 1)
    assert [row.seed for row in found.rows if row.outcome == "failed"] == [1]
    assert (found.rows[1].error or "").startswith("ZeroDivisionError: no speed at all (")


def test_an_error_whose_text_utf_8_cannot_write_is_a_row_of_the_journal() -> None:
    """As of a file whose name is in another encoding, for which Python has surrogates."""
    failed = job.failed_row(next(experiment_of(["turns"], ["kraft"], trials=1).jobs()), "no file map-\udce4.yaml")
    assert TrialRow.model_validate_json(failed.model_dump_json()).error == "no file map-\\udce4.yaml"


def test_a_worker_that_outlives_an_evaluation_reads_a_changed_vehicle_again_and_refuses_another_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, driven = tmp_path / "mine.yaml", list[float]()
    text = (ROOT / "configs/vehicles/mushr.yaml").read_text()

    def trial(spec: TrialSpec) -> TrialResult:
        driven.append(spec.vehicle.parameters["L"])
        return fake_trials.quick(spec)

    def job_of(wheelbase: float) -> Job:
        file.write_text(text.replace("value: 0.328663", f"value: {wheelbase}"))
        (found,) = experiment_of(["turns"], ["kraft"], vehicle=str(file), trials=1).jobs()
        return found

    monkeypatch.setattr(job, "simulated_trial", trial)
    for wheelbase in (0.3, 0.4):
        assert perform(job_of(wheelbase)).outcome != "failed"
    assert driven == [0.3, 0.4]
    before = job_of(0.35)
    file.write_text(text)
    with refused((file, Code.MISMATCH)):
        perform(before)
    assert len(driven) == 2


def test_workers_have_one_numeric_thread_each_and_this_process_keeps_its_environment() -> None:
    before = dict(os.environ)
    assert run(fake_trials.threads, 1, 1).summary.failed == 0
    assert dict(os.environ) == before


@pytest.mark.parametrize(
    ("trial", "error"), [(fake_trials.refuses, InputError), (fake_trials.missing, MissingDependency)]
)
def test_what_concerns_every_trial_ends_the_evaluation(trial: fake_trials.Trial, error: type[Exception]) -> None:
    with pytest.raises(error):
        run(trial, 1)


def test_a_simulator_that_does_not_load_is_a_missing_dependency(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluator, "Processes", fake_trials.Inline)
    monkeypatch.setitem(sys.modules, "kraft.trial.trial", None)
    with pytest.raises(MissingDependency):
        evaluate(["turns"], ["kraft"], 1)


def test_workers_that_raise_before_they_are_ready_name_the_guard_that_a_script_needs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(processes, "serve", dead_worker.raises)
    with pytest.raises(Defect, match=r'exit code 1.*if __name__ == "__main__":'):
        evaluate(["turns"], ["kraft"], 1)


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_a_program_from_stdin_is_refused_before_its_folder_is_made(tmp_path: Path, jobs: str) -> None:
    program = f"import kraft; kraft.evaluate(['turns'], ['kraft'], 1, jobs={jobs}, out='out')"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-"], input=program, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.stderr.splitlines()[-1].startswith("kraft.errors.InputError: <stdin>: the program is not in a file")
    assert "save it in a file" in done.stderr
    assert list(tmp_path.iterdir()) == [tmp_path / "left"]


def test_a_prompt_and_a_notebook_have_no_program_to_import(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "__main__", ModuleType("__main__"))
    processes.check_script()


def test_workers_that_do_not_start_are_a_defect(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "serve", dead_worker.ends)
    with pytest.raises(Defect, match="exit code 9"):
        evaluate(["turns"], ["kraft"], 1, 0, 1)


def test_after_kill_9_of_everything_it_goes_on_to_the_same_result(
    tmp_path: Path, left: Path, whole: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    process = kraft(fake_trials.slow, *COMMAND, "--jobs", "1", "--out", str(out))
    until_lines(out / "trials.jsonl", 4)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    with (out / "trials.jsonl").open("ab") as file:
        file.write(b'{"scenario":"turns","meth')
    there = (out / "trials.jsonl").read_bytes().count(b"\n")
    begun = len(list(left.iterdir()))
    fake_trials.use(monkeypatch, fake_trials.slow, inline=True)
    assert main([*COMMAND, "--out", str(out), "--resume"]) == 0
    err = capsys.readouterr().err
    assert places(err)[0] == str(out / "trials.jsonl")
    assert f"12 trials, {there} of them" in err
    assert len(list(left.iterdir())) == begun + 12 - there
    assert kept(out) == kept(whole)


def test_workers_end_when_the_process_that_gave_the_jobs_is_killed(tmp_path: Path, left: Path) -> None:
    process = kraft(fake_trials.slow, *COMMAND, "--trials", "60", "--jobs", "2", "--out", str(tmp_path / "out"))
    until_lines(tmp_path / "out/trials.jsonl", 1)
    process.kill()
    process.communicate()  # until nobody holds its streams any more
    before = len(list(left.iterdir()))
    time.sleep(0.6)
    assert len(list(left.iterdir())) == before


def test_signals_stay_blocked_where_the_first_worker_starts() -> None:
    program = (
        "import signal; from multiprocessing import resource_tracker\n"
        "from kraft.evaluation.processes import STOPPING, _no_signals\n"
        "with _no_signals():\n"
        "    resource_tracker.getfd()\n"
        "    print(set(STOPPING) <= signal.pthread_sigmask(signal.SIG_BLOCK, []))\n"
    )
    assert (
        subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout == "True\n"
    )


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal_finishes_what_runs_and_names_the_command_that_resumes(
    number: signal.Signals, status: int, tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    process = kraft(fake_trials.slow, *COMMAND, "--jobs", "2", "--out", str(out), "--json")
    until_lines(out / "trials.jsonl", 2)
    os.killpg(process.pid, number)  # as a terminal does: to everybody in the group
    stdout, err = process.communicate(timeout=60)
    assert (process.returncode, stdout) == (status, "")
    assert "died" not in err
    assert "interrupt again" in err
    assert "Traceback" not in err
    lines = (out / "trials.jsonl").read_bytes()
    assert lines.endswith(b"\n")
    assert 2 < lines.count(b"\n") < 12
    command = err.splitlines()[-1].split("to resume: ")[1].split()
    assert command == [
        "kraft",
        *COMMAND[:2],
        "--trials",
        "6",
        *COMMAND[2:4],
        "--jobs",
        "2",
        "--out",
        str(out),
        "--resume",
    ]
    fake_trials.use(monkeypatch, fake_trials.slow, inline=True)
    assert main(command[1:]) == 0
    assert kept(out) == kept(whole)


def test_a_second_interrupt_stops_at_once(tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = kraft(fake_trials.endless, *COMMAND, "--jobs", "1", "--out", str(out))
    until_lines(out / "trials.jsonl", 1)
    for _ in range(2):
        process.send_signal(signal.SIGINT)
        time.sleep(0.3)
    _, err = process.communicate(timeout=20)
    assert process.returncode == 130
    assert "to resume: kraft eval" in err
    assert "Traceback" not in err


def test_what_trials_print_does_not_reach_stdout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    fake_trials.use(monkeypatch, fake_trials.prints)
    assert main([*COMMAND, "--jobs", "1", "--json", "--out", str(tmp_path / "out")]) == 0
    out, err = capfd.readouterr()
    assert json.loads(out)["schema"] == "kraft.eval/1"
    assert err.count("a word from a library") == 12
