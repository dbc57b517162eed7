"""`kraft eval`: what it prints, writes and answers, and that nothing wrong gets past it."""

from __future__ import annotations

import io
import json
import re
import signal
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from support import fake_trials
from support.evaluation import KEYS, kept, places, room_for
from support.paths import ROOT
from support.screen import Screen

from kraft.config import bundled
from kraft.evaluation import METHODS, TrialRow, evaluator
from kraft.evaluation.experiment import experiment_of
from kraft.evaluation.suite import load_suite
from kraft.evaluation.table import COLUMNS, MEANINGS, TIME_OF_ALL
from kraft.trial.result import Outcome, TrialResult, TrialSpec
from kraft_cli.main import main
from kraft_cli.progress import Interrupts, Progress
from kraft_cli.signals import Stopped
from kraft_cli.tables import REMARK_MANY
from kraft_cli.terminal import Terminal

EVAL = (ROOT / "docs" / "eval.md").read_text(encoding="utf-8")


@pytest.fixture
def inline(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run trials of `fake_trials` in this process."""
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    assert main(["eval", *arguments, "--json"]) == 0
    content: dict[str, Any] = json.loads(capsys.readouterr().out)
    return content


def test_real_trials_are_the_same_with_two_workers_and_in_this_process(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("turns", "--methods", "kraft,oneshot-openloop", "--trials", "1", "--seed", "3")
    content = run_json(capsys, *arguments, "--jobs", "2", "--out", "two")
    monkeypatch.setattr(evaluator, "Processes", fake_trials.Inline)
    run_json(capsys, *arguments, "--out", "here")
    assert kept(Path("here")) == kept(Path("two"))
    assert content["schema"] == "kraft.eval/1"
    assert all(set(result) >= KEYS for result in content["results"])
    lines = [json.loads(line) for line in Path("here/trials.jsonl").read_text().splitlines()]
    assert all(line["digest"] and line["seed"] == 3 and line["measured"]["planning_ms"] for line in lines)
    assert content["results"][0]["planning_ms_p99"] > 0
    assert content["results"][0]["cycles"] > 5


def failing(spec: TrialSpec) -> TrialResult:
    """A trial of which `kraft` collides in seeds below 12, and other methods in all."""
    fails = spec.method.name != "kraft" or spec.seed < 12
    return replace(fake_trials.quick(spec), outcome=Outcome.COLLISION if fails else Outcome.SUCCESS)


@pytest.mark.parametrize(("trials", "listed"), [(30, 10), (20, 3)])
def test_unsuccessful_trials_of_methods_that_mostly_succeed_are_listed_with_their_replays(
    trials: int, listed: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fake_trials.use(monkeypatch, failing, inline=True)
    assert main(["eval", "turns", "--methods", "oneshot-openloop,kraft", "--trials", str(trials), "--out", "o"]) == 0
    lines = capsys.readouterr().out.splitlines()
    (begin,) = (k for k, line in enumerate(lines) if line.endswith("trials did not succeed"))
    rows = [json.loads(line) for line in Path("o/trials.jsonl").read_text().splitlines()]
    failed = [row for row in rows if row["outcome"] != "success"]
    assert len(failed) == trials + 12
    assert lines[begin].startswith(f"{len(failed)} trials ")
    assert lines[begin + 1].split() == ["entry", "method", "seed", "outcome", "cause", "replay"]
    for line in lines[begin + 2 : begin + 2 + listed]:
        entry, method, seed = line.split()[:3]
        assert method == "kraft"
        assert line.endswith(f"/report.html#trial={entry}/{method}/{seed}")
        (row,) = (row for row in failed if (row["method"], row["seed"]) == (method, int(seed)))
        assert f"  {row['outcome']}" in line
    assert lines[begin + 2 + listed] == f"and {len(failed) - listed} more, which the page has"


def test_without_arguments_it_runs_six_scenes_and_seven_methods_thirty_times(
    inline: None, capsys: pytest.CaptureFixture[str]
) -> None:
    content = run_json(capsys, "-q")
    scenes = [entry.name for entry in load_suite("paper")]
    assert [(r["scenario"], r["method"]) for r in content["results"]] == [(s, m) for s in scenes for m in METHODS]
    assert {r["trials"] for r in content["results"]} == {content["trials"]} == {30}
    assert len(scenes) * len(METHODS) == 42
    (folder,) = Path("results").iterdir()
    assert re.fullmatch(r"eval-\d{8}-\d{6}-seed0", folder.name)
    assert content["folder"] == f"results/{folder.name}"
    summary = json.loads((folder / "summary.json").read_text())
    assert summary == {key: value for key, value in content.items() if key != "folder"}
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["arguments"] == {
        "scenarios": [], "suite": "paper", "settings": [], "vary": [], "methods": list(METHODS), "vehicle": None,
        "trials": 30, "seed": 0, "realtime": False,
    }  # fmt: skip


def test_a_pipe_gets_tables_on_stdout_and_a_line_for_each_trial_on_stderr(
    inline: None, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["eval", "turns", "slip", "--methods", "kraft,oneshot-openloop", "--trials", "2", "--out", "o"]) == 0
    out, err = capsys.readouterr()
    assert out.splitlines()[0] == "turns"
    assert re.split(r"  +", out.splitlines()[1])[:5] == ["method", "succ", "coll", "timeout", "T_ex s"]
    assert "\033" not in out + err
    lines = err.splitlines()
    headings = {cell for line in out.splitlines() if line.startswith("method") for cell in re.split(r"  +", line)}
    explained = [re.split(r"  +", line)[0] for line in out[out.index("all entries") :].split("\n\n")[1].splitlines()]
    assert explained == [name for name in MEANINGS if name in headings]
    assert f"{MEANINGS['T_ex s']}{TIME_OF_ALL}\n" in out
    assert main(["eval", "turns", "--methods", "conservative-kraft", "--trials", "2", "--out", "one"]) == 0
    alone = capsys.readouterr().out
    assert f"{MEANINGS['T_ex s']}\n" in alone, "one entry has no table of all entries"
    assert MEANINGS["delta"].endswith("no promise of a fixed one")
    assert {"cont", "emerg", "regr", "clear m"} <= set(explained)
    assert lines[0] == "8 trials; results in o"
    assert all(re.match(rf"{n}/8  \w+ [\w-]+ seed \d: (success|collision|timeout)", lines[n]) for n in range(1, 9))
    assert lines[-1].endswith("o/report.html")


def test_a_terminal_gets_tables_that_fit(inline: None, monkeypatch: pytest.MonkeyPatch) -> None:
    for width in (50, 80, 160):
        monkeypatch.setenv("COLUMNS", str(width))
        out, err = Screen(), Screen()
        arguments = [
            "eval",
            "turns",
            "--methods",
            "kraft,cons-replanner-openloop",
            "--trials",
            "2",
            "--out",
            f"o{width}",
        ]
        assert main(arguments, Terminal(out, err)) == 0
        lines = [re.sub(r"\033\[[\d;?]*[A-Za-z]", "", line) for line in out.getvalue().splitlines()]
        assert max(len(line) for line in lines[:-1]) <= width
        assert "KRAFT" in out.getvalue()
        assert "Cons. Replanner" in out.getvalue()
        table = [line for line in lines if line.startswith("│")]
        assert ("plan ms" in table[0]) == (width == 160)
        assert any("plan ms" in line for line in lines), "as a column, or as one that has no room"
        assert "turns kraft" in err.getvalue()


SWEEP = ("eval", "turns", "slip", "--methods", "kraft,cons-replanner-openloop,oneshot-openloop", "--trials", "2",
         "--vary", "sensing.noise_scale=0,1,2,3,4")  # fmt: skip


def test_many_entries_get_one_table_with_totals(inline: None, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*SWEEP, "--out", "o"]) == 0
    lines = capsys.readouterr().out.splitlines()
    cells = [re.split(r"  +", line) for line in lines[:12]]
    assert cells[0] == ["succ/coll/timeout", "KRAFT", "Cons. Replanner + OpenLoop", "OneShot + OpenLoop"]
    assert [row[0] for row in cells[1:]] == [f"{s} noise_scale={k}" for s in ("turns", "slip") for k in range(5)] + [
        "all"
    ]
    results = json.loads(Path("o/summary.json").read_text())["results"]
    counts = [f"{r['success']}/{r['collision']}/{r['timeout']}" for r in results]
    assert [cell for row in cells[1:-1] for cell in row[1:]] == counts
    mine = [r for r in results if r["method"] == "kraft"]
    assert cells[-1][1] == "/".join(str(sum(r[name] for r in mine)) for name in ("success", "collision", "timeout"))
    assert lines[15].endswith("trials did not succeed")


def test_the_table_of_many_entries_fits_a_terminal(inline: None, monkeypatch: pytest.MonkeyPatch) -> None:
    for width in (40, 60, 120):
        monkeypatch.setenv("COLUMNS", str(width))
        out, err = Screen(), Screen()
        assert main([*SWEEP, "--out", f"o{width}"], Terminal(out, err)) == 0
        lines = [re.sub(r"\033\[[\d;?]*[A-Za-z]", "", line) for line in out.getvalue().splitlines()]
        links = [line for line in lines if line.startswith(f"  o{width}/report.html#trial=")]
        assert links, "in one piece, so that a terminal opens them"
        assert max(len(line) for line in lines if line not in (REMARK_MANY, *links)) <= width
        assert (sum("┬" in line for line in lines) == 1) == (width > 40)  # otherwise several tables
        assert "…" not in out.getvalue()


def test_an_existing_folder_is_refused_with_the_command_that_goes_on(
    inline: None, capsys: pytest.CaptureFixture[str]
) -> None:
    run_json(capsys, "turns", "--trials", "1", "--out", "o")
    assert main(["eval", "turns", "--trials", "1", "--out", "o"]) == 2
    out, err = capsys.readouterr()
    assert (out, err) == ("", "o: is there already; expected a new folder, or --out o --resume to continue this one\n")


def test_going_on_needs_no_more_than_the_folder(inline: None, capsys: pytest.CaptureFixture[str]) -> None:
    whole = run_json(
        capsys, "slip", "--methods", "kraft, oneshot-openloop", "--trials", "3", "--seed", "8", "--out", "o"
    )
    path = Path("o/trials.jsonl")
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:2]))
    again = run_json(capsys, "--out", "o", "--resume")
    for content in (whole, again):
        del content["wall_s"]
    assert again == whole
    assert run_json(capsys, "slip", "--out", "o", "--resume") | {"wall_s": 0} == whole | {"folder": "o", "wall_s": 0}
    assert main(["eval", "--trials", "2", "--out", "o", "--resume"]) == 2
    expected = "o/manifest.json: trials: was 3, is 2 now; expected at least 3, or another folder\n"
    assert capsys.readouterr().err == expected


def test_an_evaluation_gets_more_trials_and_methods_by_options(
    inline: None, capsys: pytest.CaptureFixture[str]
) -> None:
    run_json(capsys, "slip", "--methods", "kraft", "--trials", "2", "--out", "o")
    run_json(capsys, "--out", "o", "--resume", "--trials", "5", "-q")
    more = run_json(capsys, "--out", "o", "--resume", "--methods", "oneshot-openloop,kraft", "-q")
    run_json(capsys, "slip", "--methods", "oneshot-openloop,kraft", "--trials", "5", "--out", "whole")
    assert kept(Path("o")) == kept(Path("whole"))
    assert (more["trials"], [row["method"] for row in more["results"]]) == (5, ["oneshot-openloop", "kraft"])
    arguments = json.loads(Path("o/manifest.json").read_text())["arguments"]
    assert arguments == json.loads(Path("whole/manifest.json").read_text())["arguments"]
    assert main(["report", "o"]) == 0
    assert main(["eval", "--out", "o", "--resume", "--methods", "kraft"]) == 2
    assert capsys.readouterr().err.startswith("o/manifest.json: methods.oneshot-openloop: method oneshot-openloop is ")


def test_what_is_not_said_when_going_on_comes_from_the_folder_and_what_is_said_is_compared(
    inline: None, capsys: pytest.CaptureFixture[str]
) -> None:
    run_json(capsys, "slip", "turns", "--methods", "kraft", "--trials", "2", "--seed", "3", "--out", "o")
    before = Path("o/manifest.json").read_bytes()
    for said in (["--trials", "2"], ["turns", "slip"], ["--seed", "3"], ["--methods", "kraft", "--trials", "2"]):
        assert main(["eval", "--out", "o", "--resume", *said]) == 0
    assert "4 trials, 4 of them" in capsys.readouterr().err
    assert main(["eval", "boxes", "slip", "turns", "--out", "o", "--resume", "--seed", "0"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(": ")[:2] for line in lines] == [
        ["o/manifest.json", "seed"], ["o/manifest.json", "scenarios.boxes"],
    ]  # fmt: skip
    assert Path("o/manifest.json").read_bytes() == before


def test_an_evaluation_that_is_resumed_in_another_folder_says_what_its_paths_are_relative_to(
    inline: None, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("own.yaml").write_text((ROOT / "scenarios" / "slip.yaml").read_text())
    run_json(capsys, "own.yaml", "--methods", "kraft", "--trials", "1", "--out", "o")
    Path("elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    assert main(["eval", "--out", "../o", "--resume"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("own.yaml: there is no such file; ")
    assert "resume it there" in error
    assert main(["eval", "nowhere.yaml", "--out", "new"]) == 2
    assert "resume it there" not in capsys.readouterr().err


def test_a_folder_that_does_not_tell_what_was_not_said_is_refused(
    inline: None, capsys: pytest.CaptureFixture[str]
) -> None:
    run_json(capsys, "slip", "--methods", "kraft", "--trials", "1", "--out", "o")
    path = Path("o/manifest.json")
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "arguments": {"trials": "many", "seed": 0}}))
    assert main(["eval", "slip", "--out", "o", "--resume"]) == 2
    assert capsys.readouterr().err.startswith("o/manifest.json: arguments: lacks methods, trials; ")
    assert main(["eval", "slip", "--methods", "kraft", "--trials", "1", "--out", "o", "--resume"]) == 0


def test_a_folder_without_a_manifest_is_not_taken_for_the_default_evaluation(
    inline: None, capsys: pytest.CaptureFixture[str]
) -> None:
    out = Path("o")
    out.mkdir()
    (out / ".manifest.json.x.part").touch()  # what an evaluation leaves that was killed before its manifest
    assert main(["eval", "--out", "o", "--resume", "--methods", "kraft", "--trials", "1"]) == 2
    assert capsys.readouterr().err.startswith("o: has no manifest.json, so that it does not say which evaluation")
    assert [path.name for path in out.iterdir()] == [".manifest.json.x.part"]
    (out / "thesis.txt").touch()
    assert main(["eval", "--out", "o", "--resume"]) == 2
    assert "other files, such as thesis.txt" in capsys.readouterr().err
    (out / "thesis.txt").unlink()
    content = run_json(capsys, "slip", "--methods", "kraft", "--trials", "1", "--out", "o", "--resume")
    assert [row["entry"] for row in content["results"]] == ["slip"]


def test_a_failed_trial_ends_with_70_after_everything_else_is_done(
    inline: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fake_trials.use(monkeypatch, fake_trials.raises, inline=True)
    assert main(["eval", "turns", "--methods", "kraft", "--trials", "3", "--out", "o", "--json"]) == 70
    out, err = capsys.readouterr()
    assert json.loads(out)["results"][0]["failed"] == 1
    assert "turns, kraft, seed 1: failed: ZeroDivisionError: no speed at all (" in err
    assert "error: 1 of 3 trials failed" in err
    assert Path("o/summary.json").exists()


def test_a_full_disk_is_explained_with_the_command_that_goes_on(
    inline: None, capsys: pytest.CaptureFixture[str]
) -> None:
    with room_for(12_000):
        assert main(["eval", "turns", "--methods", "kraft", "--trials", "60", "--out", "o"]) == 2
    err = capsys.readouterr().err.splitlines()
    assert err[-2] == (
        "every finished trial is kept; to resume: kraft eval turns --trials 60 --methods kraft --out o --resume"
    )
    assert places(err[-1]) == ["o/replays.jsonl"]  # the file that grows fastest


def test_a_disk_that_is_full_at_the_end_is_explained_and_nothing_is_run_again(
    inline: None, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["eval", "turns", "--methods", "kraft", "--trials", "30", "--out", "o"]
    with room_for(30_000):  # enough for trials and summary, not for the page
        assert main(arguments) == 2
    assert places(capsys.readouterr().err)[-1] == "o/report.html"
    assert main([*arguments, "--resume"]) == 0
    assert "30 trials, 30 of them" in capsys.readouterr().err


def test_realtime_is_recorded_and_counts_missed_deadlines(inline: None, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["eval", "turns", "--methods", "kraft", "--trials", "4", "--realtime", "--out", "o"]
    assert main(arguments) == 0
    assert "missed" in capsys.readouterr().out
    summary = json.loads(Path("o/summary.json").read_text())
    assert summary["realtime"] is True
    assert summary["results"][0]["missed_deadlines"] > 0


def test_a_method_that_has_no_time_to_plan_by_the_clock_is_refused(
    inline: None, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (ROOT / "configs/methods/kraft.yaml").read_text()
    text = text.replace("mode: replanning", "mode: replanning, lead: 0.85")
    Path("hasty.yaml").write_text(text)
    arguments = ["eval", "turns", "--methods", "hasty.yaml", "--trials", "1", "--out", "o"]
    assert main([*arguments, "--realtime"]) == 2
    assert re.match(r"hasty.yaml:\d+:\d+: planner.lead: ", capsys.readouterr().err)
    assert main(arguments) == 0


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["turn", "--trials", "0"], ["--trials", "turn"]),
        (["--jobs", "0", "--seed", "-1", "--methods", "krft,kraft"], ["--jobs", "--seed", "krft"]),
        (["--methods", ""], ["--methods"]),
        (["--methods", "kraft,,oneshot-openloop"], ["--methods"]),
        ([""], ["scenarios"]),
        (["turns", "turns"], ["turns"]),
        (["--methods", "kraft,kraft"], ["kraft"]),
        (["--vehicle", "mushrr"], ["mushrr"]),
        (["--resume"], ["--resume"]),
        (["--resume", "--out", "o"], ["o"]),
        (["none.yaml"], ["none.yaml"]),
        (["--trials", "x"], ["--trials", "try 'kraft eval --help'"]),
    ],
)
def test_everything_wrong_is_said_at_once_and_nothing_is_written(
    arguments: list[str], expected: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["eval", *arguments]) == 2
    out, err = capsys.readouterr()
    assert (out, sorted(places(err))) == ("", expected)
    assert list(tmp_path.iterdir()) == []


def test_a_start_in_collision_is_found_before_any_trial(capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "scenarios/turns.yaml").read_text().replace("start: {x: 1.0, y: -0.5", "start: {x: 0.5, y: 1.5")
    Path("mine.yaml").write_text(text)
    assert main(["eval", "mine.yaml", "boxes", "--out", "o"]) == 2
    assert re.match(r"mine.yaml:\d+:\d+: start: mushr at .* is in collision with 'first box'", capsys.readouterr().err)
    assert not Path("o").exists()


def test_a_vehicle_whose_parameters_cannot_be_estimated_is_found_before_any_trial(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["eval", "turns", "--methods", "kraft,adaptive-kraft", "--vehicle", "benchmark", "--out", "o"]) == 2
    assert places(capsys.readouterr().err) == [f"{bundled.folder('vehicle') / 'benchmark.yaml'}:10:3"]
    assert not Path("o").exists()


def test_quiet_says_nothing_and_bars_are_only_for_a_terminal(inline: None) -> None:
    out, err = io.StringIO(), Screen()
    assert main(["eval", "turns", "--methods", "kraft", "--trials", "1", "--out", "o", "-q"], Terminal(out, err)) == 0
    assert err.getvalue() == ""


def test_a_folder_that_was_not_chosen_is_told_if_nothing_else_is(
    inline: None, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["-q", "eval", "turns", "--methods", "kraft", "--trials", "1"]) == 0
    (folder,) = Path("results").iterdir()
    assert capsys.readouterr().err == f"results in {folder}\n"


def test_the_first_signal_while_trials_run_is_a_request_and_all_others_raise() -> None:
    terminal = Terminal(io.StringIO(), io.StringIO())
    interrupts = Interrupts(terminal)
    progress = Progress(terminal, interrupts)
    with pytest.raises(Stopped):
        interrupts.handle(signal.SIGINT)
    interrupts.trials_run = True
    assert not progress.stop_requested()
    interrupts.handle(signal.SIGTERM)
    assert progress.stop_requested()
    with pytest.raises(Stopped) as stopped:
        interrupts.handle(signal.SIGHUP)
    assert stopped.value.number == signal.SIGHUP


@pytest.mark.parametrize("resumed", [False, True])
def test_after_the_last_trial_a_signal_waits_for_the_results(resumed: bool) -> None:
    err = io.StringIO()
    terminal = Terminal(io.StringIO(), err)
    interrupts = Interrupts(terminal)
    experiment = experiment_of(["turns"], ["kraft"], trials=2)
    row = partial(TrialRow, scenario="turns", method="kraft", outcome="timeout", t_s=1.0)
    rows = {each.key: each for each in (row(seed=0), row(seed=1))}
    with Progress(terminal, interrupts) as progress:
        progress.started(experiment, None, rows if resumed else {})
        for each in () if resumed else rows.values():
            assert interrupts.awaited == "the running trials"
            progress.trial_ended(each)
        interrupts.handle(signal.SIGINT)
    assert "waiting for the results to be written; interrupt again to abort" in err.getvalue()


def test_every_option_and_every_key_is_described(inline: None, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", "--help"]) == 0
    options = set(re.findall(r"(?<![\w-])--[a-z]+", capsys.readouterr().out)) - {"--help"}
    assert options
    assert options <= set(re.findall(r"--[a-z]+", EVAL))
    content = run_json(capsys, "turns", "--methods", "kraft", "--trials", "1", "--out", "o")
    described = set(re.findall(r"`(\w+)`", EVAL))
    assert set(content) | set(content["results"][0]) <= described
    line = json.loads(Path("o/trials.jsonl").read_text())
    assert set(line) | set(line["measured"]) <= described


def test_every_column_of_the_tables_is_in_the_legend() -> None:
    legend = EVAL[EVAL.index("## The tables") : EVAL.index("## Suites and sweeps")]
    columns = {
        name for row in re.findall(r"^\| (`.*?) \|", legend, re.MULTILINE) for name in re.findall(r"`(.+?)`", row)
    }
    assert columns == set(COLUMNS)
    assert set(MEANINGS) == set(COLUMNS) - {"method", "succ", "coll", "timeout", "score", "failed"}
