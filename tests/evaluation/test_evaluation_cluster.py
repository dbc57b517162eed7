"""The same trials on a Dask cluster: a scheduler and its workers in processes of their own."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support import fake_trials
from support.evaluation import StoppingObserver, kept, refused
from support.messages import without_loading
from support.paths import ROOT

from kraft.errors import Code, MissingDependency
from kraft.evaluation import TrialRow, cluster, evaluate, evaluator
from kraft.provenance import install_command
from kraft_cli.main import main

CELLS = (["turns", "slip"], ["kraft", "oneshot-openloop"])


class Dask:
    """A scheduler and workers on this machine."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / "scheduler.json"
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", "0")
        limit = time.monotonic() + 60
        while not self._file.exists() or not self._file.read_text().endswith("}"):  # it is being written
            assert time.monotonic() < limit
            time.sleep(0.05)
        self.address: str = json.loads(self._file.read_text())["address"]
        self.workers = [self.worker(), self.worker()]

    @property
    def whole(self) -> bool:
        """Whether the scheduler and a worker are there; workers that died are replaced."""
        self.workers = [worker if worker.poll() is None else self.worker() for worker in self.workers]
        return self.scheduler.poll() is None

    def worker(self) -> subprocess.Popen[bytes]:
        return self._start("worker", "--nthreads", "1", "--no-nanny", "--host", "127.0.0.1")

    def stop(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()

    def _start(self, kind: str, *options: str) -> subprocess.Popen[bytes]:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*sys.path, str(ROOT)])}
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", "--scheduler-file", str(self._file)]
        return subprocess.Popen(
            [*command, "--no-dashboard", *options], env=environment, cwd=self._file.parent,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip


@pytest.fixture(scope="module")
def started(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Dask]]:
    """The clusters that were started; starting one takes seconds, so tests share it while it is whole."""
    found: list[Dask] = []
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv(fake_trials.LEFT, str(tmp_path_factory.mktemp("left")))
        yield found
    for each in found:
        each.stop()


@pytest.fixture
def dask(started: list[Dask], tmp_path: Path) -> Dask:
    if not started or not started[-1].whole:
        started.append(Dask(tmp_path))
    return started[-1]


class KillingObserver(StoppingObserver):
    """Kills a process after some trials."""

    def __init__(self, process: subprocess.Popen[bytes], after: int) -> None:
        super().__init__()
        self._process, self._after = process, after

    def trial_ended(self, row: TrialRow) -> None:
        super().trial_ended(row)
        if len(self.rows) == self._after:
            self._process.kill()


def run(dask: Dask, trial: fake_trials.Trial, trials: int, **options: Any) -> evaluator.Evaluation:
    with pytest.MonkeyPatch.context() as patch:
        fake_trials.use(patch, trial)
        return evaluate(*CELLS, trials, 0, cluster=dask.address, **options)


def test_with_a_worker_killed_every_trial_arrives_once_and_the_same(
    dask: Dask, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    observer = KillingObserver(dask.workers[0], 4)
    found = run(dask, fake_trials.slow, 4, out=tmp_path / "out", observer=observer)
    assert found.complete
    assert dask.workers[0].poll() is not None
    keys = [row.key for row in observer.rows]
    assert len(keys) == len(set(keys)) == 16
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    evaluate(*CELLS, 4, 0, out=tmp_path / "here")
    assert kept(tmp_path / "out") == kept(tmp_path / "here")


def test_stopping_waits_for_what_runs_and_workers_of_another_version_are_refused(
    dask: Dask, monkeypatch: pytest.MonkeyPatch
) -> None:
    stopped = run(dask, fake_trials.slow, 6, observer=StoppingObserver(3))
    assert not stopped.complete
    assert 3 <= len(stopped.rows) <= 3 + 4
    monkeypatch.setattr(cluster, "versions", lambda _: {"kraft": "99"})
    with refused(("cluster", Code.MISMATCH)):
        run(dask, fake_trials.quick, 1)


def test_without_its_scheduler_an_evaluation_ends_and_goes_on_elsewhere(
    dask: Dask, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last of these tests, because the next one would have to start another cluster."""
    observer = KillingObserver(dask.scheduler, 3)
    with refused(("cluster", Code.NOT_FOUND)):
        run(dask, fake_trials.slow, 4, out=tmp_path / "out", observer=observer)
    fake_trials.use(monkeypatch, fake_trials.slow, inline=True)
    rest = StoppingObserver()
    assert evaluate(*CELLS, 4, 0, out=tmp_path / "out", resume=True, observer=rest).complete
    assert len(observer.rows) + len(rest.rows) == 16


def test_an_address_where_nobody_answers_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def compiled(*_: object, **__: object) -> None:
        raise AssertionError("compiled before the address was tried")

    monkeypatch.setattr(cluster, "ANSWER_TIMEOUT", 0.5)
    monkeypatch.setattr("kraft.evaluation.evaluator.ensure_all_compiled", compiled)
    with refused(("cluster", Code.NOT_FOUND)):
        evaluate(["turns"], ["kraft"], 1, cluster="tcp://127.0.0.1:9")
    with refused(("cluster", Code.NOT_FOUND)):
        evaluate(["turns"], ["kraft"], 1, cluster="nowhere")


def test_a_wrong_address_ends_at_once_with_one_line_and_leaves_no_folder(tmp_path: Path) -> None:
    command = ["eval", "turns", "--trials", "1", "--methods", "kraft", "--cluster", "nowhere", "--out", "out"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*sys.path, str(ROOT)])}
    done = subprocess.run(
        [sys.executable, "-m", "kraft_cli", *command],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"--cluster: .*\n", without_loading(done.stderr))
    assert not (tmp_path / "out").exists()


def test_without_the_extra_it_ends_with_3_and_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingDependency):
        cluster.Cluster("tcp://127.0.0.1:9")
    assert main(["eval", "turns", "--cluster", "tcp://127.0.0.1:9", "--out", str(tmp_path / "out")]) == 3
    assert install_command("cluster") in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
