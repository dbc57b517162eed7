"""The results folder keeps finished trials, refuses other evaluations, and is never overwritten."""

from __future__ import annotations

import json
import random
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import fake_trials
from support.evaluation import StoppingObserver, kept, places, refused, room_for
from support.paths import ROOT

import kraft.evaluation.manifest
from kraft.errors import Code, InputError
from kraft.evaluation import Evaluation, Observer, TrialRow, evaluate, folder
from kraft.evaluation.experiment import experiment_of
from kraft.evaluation.journal import Journal, Replays, read_journal
from kraft.evaluation.manifest import check_continues, grown_manifest, manifest_differences, manifest_of
from kraft.trial.measures import Kept, Measures
from kraft.vehicles.load import load_vehicle

SCENARIOS, METHODS = ("turns", "slip"), ("oneshot-openloop", "kraft")


@pytest.fixture(autouse=True)
def inline(monkeypatch: pytest.MonkeyPatch) -> None:
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)


def run(
    out: Path, *, resume: bool = False, trials: int = 3, observer: Observer | None = None, **options: Any
) -> Evaluation:
    arguments = {"scenarios": SCENARIOS, "methods": METHODS, **options}
    return evaluate(trials=trials, seed=5, out=out, resume=resume, observer=observer, **arguments)


def test_arguments_may_hold_what_json_does_not(tmp_path: Path) -> None:
    run(tmp_path / "out", arguments={"noise": np.float32(0.5), "from": Path("here"), "seeds": np.arange(2)})
    content = json.loads((tmp_path / "out/manifest.json").read_text())
    assert content["arguments"] == {"noise": 0.5, "from": "here", "seeds": [0, 1]}


def test_arguments_that_are_no_mapping_leave_no_folder(tmp_path: Path) -> None:
    with pytest.raises(TypeError):
        run(tmp_path / "out", arguments=3)
    assert not (tmp_path / "out").exists()


def test_a_camera_that_does_not_see_the_start_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        run(tmp_path / "out", settings={"sensing.preset": "rendered", "sensing.camera": [1, 30, 5]})
    assert {(each.path, each.code) for each in caught.value.diagnostics} == {("sensing.camera", Code.GEOMETRY)}
    assert not (tmp_path / "out").exists()


def test_a_folder_holds_everything(tmp_path: Path) -> None:
    found = run(tmp_path / "out")
    assert found.complete
    assert len(found.rows) == 12
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "manifest.json", "trials.jsonl", "replays.jsonl", "summary.json", "benchmark-turns.log", "benchmark-slip.log", "benchmark.db",
        "report.html",
    }  # fmt: skip
    assert len((tmp_path / "out/trials.jsonl").read_text().splitlines()) == 12
    content = json.loads((tmp_path / "out/manifest.json").read_text())
    assert content["schema"] == "kraft.eval-manifest/1"
    assert (content["trials"], content["seed"]) == (3, 5)
    assert content["rows"][1] == {
        "entry": "turns", "base": "turns", "scenario": "turns", "reference": "turns", "set": {}, "method": "kraft",
        "title": "KRAFT", "vehicle": "mushr-drive", "robot": {"car": {}}, "of_paper": True,
    }  # fmt: skip
    assert content["scenarios"]["slip"]["content"]["truth"]["friction_patches"]
    assert content["methods"]["kraft"]["content"]["planner"]["mode"] == "replanning"
    assert content["vehicles"]["mushr"]["content"]["parameters"] == load_vehicle("mushr").parameters
    assert {"kraft", "numba", "ompl", "mujoco", "python"} <= set(content["versions"])


def test_messages_go_to_a_log_where_no_observer_receives_them(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def compiles(_: object, report: Callable[[str], None]) -> None:
        report("compiling")

    monkeypatch.setattr("kraft.evaluation.evaluator.ensure_all_compiled", compiles)
    messages: list[str] = []
    run(tmp_path / "out", log=messages.append)
    assert messages == ["compiling"]
    with pytest.raises(TypeError, match="observer"):
        run(tmp_path / "other", log=messages.append, observer=Observer())
    assert not (tmp_path / "other").exists()


def test_all_methods_and_scenes_have_the_same_seeds(tmp_path: Path) -> None:
    found = run(tmp_path / "out")
    by_cell: dict[tuple[str, str], list[int]] = {}
    for row in found.rows:
        by_cell.setdefault(row.key[:2], []).append(row.seed)
    assert list(by_cell.values()) == [[5, 6, 7]] * 4


def test_the_order_in_which_trials_end_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(tmp_path / "straight")
    for number in range(3):
        shuffled = fake_trials.Inline(shuffle=random.Random(number).shuffle)
        monkeypatch.setattr("kraft.evaluation.evaluator.Processes", lambda _, executor=shuffled: executor)
        run(tmp_path / f"shuffled{number}")
        assert kept(tmp_path / f"shuffled{number}") == kept(tmp_path / "straight")


def test_nothing_is_written_where_there_is_a_folder(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "file").write_text("x")
    with refused((tmp_path / "out", Code.EXISTS)):
        run(tmp_path / "out")
    with refused((tmp_path / "file", Code.EXISTS)):
        run(tmp_path / "file")
    with refused((tmp_path / "file/deeper", Code.UNWRITABLE)):
        run(tmp_path / "file/deeper")
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize("after", [0, 1, 7, 11])
def test_a_stopped_evaluation_goes_on_to_the_same_result(after: int, tmp_path: Path) -> None:
    run(tmp_path / "whole")
    stopped = run(tmp_path / "out", observer=StoppingObserver(after))
    assert not stopped.complete
    assert len(stopped.rows) == after
    assert not (tmp_path / "out/summary.json").exists()
    rest = StoppingObserver()
    assert run(tmp_path / "out", resume=True, observer=rest).complete
    assert len(rest.rows) == 12 - after
    assert kept(tmp_path / "out") == kept(tmp_path / "whole")


def test_going_on_with_what_is_complete_runs_nothing(tmp_path: Path) -> None:
    run(tmp_path / "out")
    (tmp_path / "out/summary.json").unlink()
    again = StoppingObserver()
    run(tmp_path / "out", resume=True, observer=again)
    assert again.rows == []
    assert (tmp_path / "out/summary.json").exists()


def test_a_finished_evaluation_keeps_the_time_that_it_took(tmp_path: Path) -> None:
    took = run(tmp_path / "out").summary.wall
    assert run(tmp_path / "out", resume=True).summary.wall >= took - 1e-3
    assert json.loads((tmp_path / "out/summary.json").read_text())["wall_s"] >= took - 1e-3


@pytest.mark.parametrize("last", [{}, {"outcome": "failed", "error": "ValueError: no way"}])
def test_the_time_that_an_evaluation_took_is_that_of_all_its_commands(last: dict[str, str], tmp_path: Path) -> None:
    run(tmp_path / "out", observer=StoppingObserver(4))
    rows = tmp_path / "out" / "trials.jsonl"
    lines = [json.loads(line) for line in rows.read_text().splitlines()]
    lines[-1] |= last
    lines[-1]["measured"]["elapsed_s"] = 1000.0
    rows.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert run(tmp_path / "out", resume=True).summary.wall > 1000.0
    assert json.loads(rows.read_text().splitlines()[-1])["measured"]["elapsed_s"] > 1000.0


@pytest.mark.parametrize("content", ["", "{", '{"wall_s": "x"}', '{"wall_s": Infinity}'])
def test_a_damaged_summary_is_written_again(tmp_path: Path, content: str) -> None:
    run(tmp_path / "out")
    before = json.loads((tmp_path / "out" / "summary.json").read_text())
    (tmp_path / "out" / "summary.json").write_text(content)
    run(tmp_path / "out", resume=True)
    after = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert {**after, "wall_s": 0.0} == {**before, "wall_s": 0.0}


def test_a_incomplete_last_line_is_reported_and_its_trial_repeated(tmp_path: Path) -> None:
    run(tmp_path / "whole")
    run(tmp_path / "out", observer=StoppingObserver(4))
    path = tmp_path / "out/trials.jsonl"
    path.write_bytes(path.read_bytes()[:-20])
    rest = StoppingObserver()
    run(tmp_path / "out", resume=True, observer=rest)
    assert places(rest.messages[0]) == [str(path)]
    assert len(rest.messages) == 1
    assert len(rest.rows) == 9
    assert kept(tmp_path / "out") == kept(tmp_path / "whole")


def test_an_evaluation_stopped_before_its_manifest_begins_anew(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out/.manifest.json.x1.part").write_text("{")
    assert run(tmp_path / "out", resume=True).complete


def test_a_folder_of_something_else_is_not_adopted(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.txt").write_text("mine")
    (out / ".manifest.json.x.part").touch()  # what a stopped evaluation may leave
    with refused((out, Code.MISMATCH)):
        run(out, resume=True)
    assert {path.name for path in out.iterdir()} == {"thesis.txt", ".manifest.json.x.part"}


@pytest.mark.parametrize(
    ("content", "code"),
    [
        ({"schema": "kraft.eval-manifest/1"}, Code.SYNTAX),
        ({"schema": "kraft.eval-manifest/1", "rows": [{"method": "kraft"}]}, Code.SYNTAX),
        ({"schema": "kraft.plan/1", "rows": []}, Code.MISMATCH),
        ({}, Code.MISSING),
    ],
)
def test_a_damaged_manifest_is_refused(tmp_path: Path, content: dict[str, Any], code: Code) -> None:
    run(tmp_path / "out")
    (tmp_path / "out/manifest.json").write_text(json.dumps(content))
    with refused((tmp_path / "out/manifest.json", code)):
        run(tmp_path / "out", resume=True)


def test_parts_of_a_manifest_that_only_the_report_needs_are_checked_before_the_trials(tmp_path: Path) -> None:
    run(tmp_path / "out")
    file = tmp_path / "out/manifest.json"
    file.write_text(json.dumps({key: value for key, value in json.loads(file.read_text()).items() if key != "began"}))
    with refused((file, Code.SYNTAX)):
        run(tmp_path / "out", resume=True)


@pytest.mark.parametrize("part", ["drive", "trees", "seed"])
def test_a_replay_with_a_part_of_another_type_is_refused_at_its_line(tmp_path: Path, part: str) -> None:
    file = tmp_path / "replays.jsonl"
    replay = {"entry": "turns", "method": "kraft", "seed": 0, "drive": "", "trees": None}
    file.write_text(json.dumps(replay) + "\n" + json.dumps(replay | {part: [1]}) + "\n")
    with refused((f"{file}:2:1", Code.SYNTAX)):
        Replays(file)


def test_there_must_be_something_to_go_on_with(tmp_path: Path) -> None:
    with refused((tmp_path / "out", Code.NOT_FOUND)):
        run(tmp_path / "out", resume=True)
    (tmp_path / "out").mkdir()
    (tmp_path / "out/manifest.json").write_text("[]")
    with refused((tmp_path / "out/manifest.json", Code.MISSING)):
        run(tmp_path / "out", resume=True)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"trials": 2}, ["trials"]),
        ({"methods": ("kraft",)}, ["methods.oneshot-openloop"]),
        ({"scenarios": ("turns", "slip", "boxes")}, ["scenarios.boxes"]),
        ({"realtime": True}, ["realtime"]),
        (
            {"vehicle": "mushr-lag"},
            ["rows.slip, kraft", "vehicles.mushr", "vehicles.mushr-lag"],
        ),
    ],
)  # fmt: skip
def test_a_folder_of_another_configuration_is_refused_field_by_field(
    change: dict[str, Any], expected: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def compiled(*_: object, **__: object) -> None:
        raise AssertionError("compiled before the folder was checked")

    run(tmp_path / "out", observer=StoppingObserver(2))
    monkeypatch.setattr("kraft.evaluation.evaluator.ensure_all_compiled", compiled)
    before = (tmp_path / "out/trials.jsonl").read_bytes()
    with pytest.raises(InputError) as caught:
        run(tmp_path / "out", resume=True, **change)
    differing = [each.path for each in caught.value.diagnostics]
    assert {each.code for each in caught.value.diagnostics} == {Code.MISMATCH}
    assert set(expected) <= set(differing)
    if len(expected) == 1:
        assert len(differing) == 1
    assert (tmp_path / "out/trials.jsonl").read_bytes() == before


def test_a_changed_file_and_another_version_are_refused(tmp_path: Path) -> None:
    method = tmp_path / "mine.yaml"
    method.write_text("name: mine\ntitle: A\nplanner: {mode: replanning}\ncontroller: {kind: open_loop}\n")
    run(tmp_path / "out", methods=(method,), observer=StoppingObserver(2))
    method.write_text(method.read_text().replace("title: A", "title: B  # only words"))
    run(tmp_path / "out", methods=(method,), observer=StoppingObserver(1), resume=True)
    method.write_text(method.read_text().replace("open_loop", "open_loop, rate_hz: 10"))
    path = tmp_path / "out/manifest.json"
    content = json.loads(path.read_text())
    content["versions"]["mujoco"] = "3.9"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError) as caught:
        run(tmp_path / "out", methods=(method,), resume=True)
    problems = {each.path: each.problem for each in caught.value.diagnostics}
    assert problems.keys() == {"methods.mine.content.controller.rate_hz", "versions.mujoco"}
    assert problems["methods.mine.content.controller.rate_hz"] == "was 30.0, is 10.0 now"


def test_other_code_of_trials_is_refused_and_code_that_no_trial_runs_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    packages = tmp_path / "kraft", tmp_path / "ompl_ext"
    for package in packages:
        shutil.copytree(ROOT / package.name, package, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(kraft.evaluation.manifest, "PACKAGES", packages)
    path, experiment = tmp_path / "manifest.json", experiment_of(["turns"], ["kraft"], trials=3)
    more = experiment_of(["turns"], ["kraft"], trials=4)
    before = manifest_of(experiment, {})
    for file in ("kraft/plot/page.py", "kraft/evaluation/table.py"):
        (tmp_path / file).write_text("")
        assert not check_continues(path, before, manifest_of(experiment, {}))
    older = {key: value for key, value in before.items() if key != "source"}
    assert check_continues(path, before, manifest_of(more, {}))
    for file in ("kraft/driving/replanner.py", "ompl_ext/kernels/dirt.py"):
        with (tmp_path / file).open("a") as code:
            code.write("\n")
        now = manifest_of(more, {})
        with pytest.raises(InputError, match="the code of kraft that trials run has changed; expected that of the"):
            check_continues(path, before, now)
        assert ("source",) in [each.path for each in manifest_differences(before, now)]
        assert check_continues(path, older, now)
        assert "source" not in grown_manifest(older, now)  # not what its first trials ran
        before = manifest_of(experiment, {})


def test_what_only_estimators_know_of_a_vehicle_is_compared(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    text = (ROOT / "configs/vehicles/mushr-force.yaml").read_text()
    file.write_text(text)
    run(tmp_path / "out", vehicle=str(file), observer=StoppingObserver(2))
    file.write_text(text.replace("footprint:", "delay: {value: 0.1, std: 0.02}\nfootprint:"))
    assert file.read_text() != text
    with pytest.raises(InputError) as caught:
        run(tmp_path / "out", vehicle=str(file), resume=True)
    assert [each.path for each in caught.value.diagnostics] == ["vehicles.mushr-force.content.delay"]


def test_a_full_disk_keeps_every_finished_trial(tmp_path: Path) -> None:
    run(tmp_path / "whole", trials=30)
    observer = StoppingObserver()
    with (
        room_for(30_000),
        refused((tmp_path / "out/replays.jsonl", Code.UNWRITABLE)),  # it grows faster than the trials
    ):
        run(tmp_path / "out", trials=30, observer=observer)
    content, replays = ((tmp_path / "out" / name).read_bytes() for name in ("trials.jsonl", "replays.jsonl"))
    assert content.endswith(b"\n")
    assert replays.endswith(b"\n")
    assert 27_000 < len(replays) <= 30_000
    assert len(observer.rows) == len(content.splitlines()) == len(replays.splitlines())
    run(tmp_path / "out", trials=30, resume=True)
    assert kept(tmp_path / "out") == kept(tmp_path / "whole")


def test_a_disk_that_is_full_from_the_start_leaves_nothing_behind(tmp_path: Path) -> None:
    with room_for(100), refused((tmp_path / "out/manifest.json", Code.UNWRITABLE)):
        run(tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_only_one_process_writes_a_journal(tmp_path: Path) -> None:
    first = Journal(tmp_path / "trials.jsonl")
    with refused((tmp_path / "trials.jsonl", Code.CONFLICT)):
        Journal(tmp_path / "trials.jsonl")
    first.close()
    Journal(tmp_path / "trials.jsonl").close()


def test_damage_in_the_middle_is_refused_at_its_line(tmp_path: Path) -> None:
    run(tmp_path / "out", observer=StoppingObserver(4))
    path = tmp_path / "out/trials.jsonl"
    lines = path.read_text().splitlines()
    other = lines[3].replace('"seed":5', '"seed":99')
    path.write_text("\n".join([lines[0], "}{", lines[2], lines[2], other, '{"scenario":1}']) + "\n")
    with pytest.raises(InputError) as caught:
        run(tmp_path / "out", resume=True)
    assert [(each.line, each.code) for each in caught.value.diagnostics] == [
        (2, Code.SYNTAX),
        (4, Code.DUPLICATE),
        (5, Code.MISMATCH),
        (6, Code.SYNTAX),
    ]


@pytest.mark.parametrize(
    ("was", "instead", "key"),
    [
        ('"t_s":9.0', '"t_s":null', "t_s"),
        ('"t_s":9.0', '"t_s":-9.0', "t_s"),
        ('"cycles":3', '"cycles":-3', "cycles"),
        ('"held":1', '"held":-1', "measures.plans.held"),
    ],
)
def test_a_trial_that_no_drive_can_have_is_refused_with_its_key(
    was: str, instead: str, key: str, tmp_path: Path
) -> None:
    path = tmp_path / "trials.jsonl"
    row = TrialRow(
        scenario="turns", method="kraft", seed=1, outcome="success", t_s=9.0, cycles=3,
        measures=Measures(plans=Kept(ticks=2, held=1)),
    )  # fmt: skip
    line = row.model_dump_json()
    assert was in line
    path.write_text(f"{line.replace(was, instead)}\n")
    with pytest.raises(InputError, match=key) as caught:
        read_journal(path)
    assert [(each.line, each.code) for each in caught.value.diagnostics] == [(1, Code.SYNTAX)]


def test_failed_trials_are_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(fake_trials.LEFT, str(tmp_path))
    fake_trials.use(monkeypatch, fake_trials.raises_once, inline=True)
    broken = run(tmp_path / "out")
    assert broken.summary.failed == len(broken.rows) == 12
    observer = StoppingObserver(2)
    assert not run(tmp_path / "out", resume=True, observer=observer).complete
    left = {path.name for path in (tmp_path / "out").iterdir()}
    assert left == {"manifest.json", "trials.jsonl", "replays.jsonl"}, "results of before have trials that are gone"
    observer.after = 100
    mended = run(tmp_path / "out", resume=True, observer=observer)
    assert len({row.key for row in observer.rows}) == len(observer.rows) == 12
    assert mended.summary.failed == 0
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    run(tmp_path / "whole")
    assert kept(tmp_path / "out")[1] == kept(tmp_path / "whole")[1]


rows = st.builds(
    TrialRow,
    scenario=st.text(), method=st.text(), seed=st.integers(0, 10**12), t_s=st.floats(0, 1e6),
    outcome=st.sampled_from(["success", "collision", "timeout", "failed"]), obstacle=st.none() | st.text(),
    error=st.none() | st.text(), min_clearance_m=st.floats(-1, 1e6),
)  # fmt: skip


@settings(max_examples=50)
@given(st.lists(rows, max_size=5, unique_by=lambda row: row.key), st.data())
def test_a_journal_cut_anywhere_holds_its_whole_lines(found: list[TrialRow], data: st.DataObject) -> None:
    content = b"".join(row.model_dump_json().encode() + b"\n" for row in found)
    cut = data.draw(st.integers(0, len(content)))
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "trials.jsonl"
        path.write_bytes(content[:cut])
        read = read_journal(path)
        assert list(read.values()) == found[: content[:cut].count(b"\n")]
        opened = Journal(path)
        opened.close()
        kept = content[: content[:cut].rfind(b"\n") + 1]
        assert (path.read_bytes(), opened.was_cut) == (kept, len(kept) < cut)


def test_the_default_folder_is_never_one_that_exists(tmp_path: Path) -> None:
    first = folder.default_path(3, tmp_path)
    first.mkdir(parents=True)
    assert first.name.endswith("-seed3")
    assert not folder.default_path(3, tmp_path).exists()


def test_a_manifest_does_not_depend_on_where_files_are(tmp_path: Path) -> None:
    source = (ROOT / "configs/vehicles/mushr.yaml").read_text()
    contents = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "car.yaml").write_text(source)
        experiment = experiment_of(["turns"], ["kraft"], vehicle=str(tmp_path / name / "car.yaml"))
        contents.append(manifest_of(experiment, {}))
    assert not check_continues(tmp_path, *contents)


@pytest.mark.parametrize(
    ("name", "scene", "file", "old", "new", "path"),
    [
        ("mushr", "turns", "mushr.yaml", "footprint:", "truth: {car: {mass: 4}}\nfootprint:", "turns, kraft.car.mass"),
        ("jackal", "posts", "jackal.xml", "<mujoco", "<!-- heavier --><mujoco", "posts, kraft.mjcf.sha256"),
    ],
)
def test_a_folder_of_a_robot_that_has_changed_is_refused_once_and_one_that_states_none_is_continued(
    name: str, scene: str, file: str, old: str, new: str, path: str, tmp_path: Path
) -> None:
    """The true robot is in the file of the vehicle, or in another one that this names."""
    for each in ("mushr.yaml", "jackal.yaml", "jackal.xml"):
        (tmp_path / each).write_text((ROOT / "configs/vehicles" / each).read_text())

    def manifest() -> dict[str, Any]:
        return manifest_of(experiment_of([scene], ["kraft", "oneshot-openloop"], vehicle=f"{tmp_path}/{name}.yaml"), {})

    before = manifest()
    assert not check_continues(tmp_path, before, manifest())
    text = (tmp_path / file).read_text()
    (tmp_path / file).write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        check_continues(tmp_path, before, manifest())
    assert [each.path for each in caught.value.diagnostics] == [f"robots.{path}"]
    assert [".".join(each.path) for each in manifest_differences(before, manifest())] == [f"robots.{path}"]
    for row in before["rows"]:
        del row["robot"]
    assert not check_continues(tmp_path, before, manifest())
