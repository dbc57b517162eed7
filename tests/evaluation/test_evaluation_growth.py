"""A results folder may get more trials and more methods; what it has stays as it is, also after a kill."""

from __future__ import annotations

import json
import threading
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from support import fake_trials
from support.evaluation import StoppingObserver, kept, refused
from support.paths import ROOT

from kraft.errors import Code, InputError
from kraft.evaluation import Evaluation, evaluate, folder
from kraft.evaluation.journal import REPLAYS, Replays
from kraft.evaluation.report import read_results
from kraft.evaluation.report.server import ReportServer

METHODS = ("kraft", "oneshot-openloop")
DERIVED = ("summary.json", "report.html", "benchmark-turns.log", "benchmark-slip.log", "benchmark.db")


class Killed(BaseException):
    """What stands for SIGKILL: nothing handles it."""


@pytest.fixture(autouse=True)
def inline(monkeypatch: pytest.MonkeyPatch) -> None:
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)


def run(out: Path, trials: int, methods: Any = METHODS, **options: Any) -> Evaluation:
    return evaluate(["turns", "slip"], methods, trials, 5, out=out, **options)


def manifest(out: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((out / "manifest.json").read_text())
    del content["began"]
    return content


def test_more_trials_give_what_an_evaluation_with_all_of_them_gives(tmp_path: Path) -> None:
    run(tmp_path / "whole", 4, arguments={"trials": 4})
    run(tmp_path / "out", 2, arguments={"trials": 2})
    began = json.loads((tmp_path / "out/manifest.json").read_text())["began"]
    before = {name: (tmp_path / "out" / name).read_bytes() for name in ("trials.jsonl", "replays.jsonl")}
    observer = StoppingObserver()
    assert run(tmp_path / "out", 4, resume=True, observer=observer, arguments={"trials": 4}).complete
    assert [row.key for row in observer.rows] == [
        (entry, method, seed) for entry in ("turns", "slip") for method in METHODS for seed in (7, 8)
    ]
    assert kept(tmp_path / "out") == kept(tmp_path / "whole")
    for name, content in before.items():
        assert (tmp_path / "out" / name).read_bytes().startswith(content)
    assert manifest(tmp_path / "out") == manifest(tmp_path / "whole")
    assert json.loads((tmp_path / "out/manifest.json").read_text())["began"] == began
    assert len(read_results(tmp_path / "out").rows) == 16


@pytest.mark.parametrize("methods", [METHODS, METHODS[::-1]])
def test_more_methods_give_what_an_evaluation_with_all_of_them_gives(tmp_path: Path, methods: tuple[str, ...]) -> None:
    run(tmp_path / "whole", 2, methods)
    run(tmp_path / "out", 2, ["kraft"])
    assert set(manifest(tmp_path / "out")["vehicles"]) == {"mushr-drive"}
    observer = StoppingObserver()
    assert run(tmp_path / "out", 2, methods, resume=True, observer=observer).complete
    assert {row.method for row in observer.rows} == {"oneshot-openloop"}
    assert kept(tmp_path / "out") == kept(tmp_path / "whole")
    assert manifest(tmp_path / "out") == manifest(tmp_path / "whole")


def test_an_unfinished_evaluation_gets_more_trials_too(tmp_path: Path) -> None:
    run(tmp_path / "whole", 3)
    run(tmp_path / "out", 2, ["kraft"], observer=StoppingObserver(3))
    assert not run(tmp_path / "out", 3, resume=True, observer=StoppingObserver(2)).complete
    assert run(tmp_path / "out", 3, resume=True).complete
    assert kept(tmp_path / "out") == kept(tmp_path / "whole")


def test_while_it_grows_a_folder_has_no_results_of_fewer_trials(tmp_path: Path) -> None:
    run(tmp_path / "out", 2)
    assert set(DERIVED) <= {path.name for path in (tmp_path / "out").iterdir()}
    assert not run(tmp_path / "out", 4, resume=True, observer=StoppingObserver(1)).complete
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"manifest.json", "trials.jsonl", "replays.jsonl"}
    found = read_results(tmp_path / "out")
    assert (len(found.rows), found.expected) == (9, 16)


@pytest.mark.parametrize("steps", range(len(DERIVED) + 2))
def test_a_kill_at_any_step_leaves_a_folder_that_goes_on(
    steps: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(tmp_path / "out", 2)
    whole = run(tmp_path / "whole", 3).summary
    done = list[str]()
    unlink, write = Path.unlink, folder.write_json

    def step(name: str) -> None:
        if len(done) == steps:
            raise Killed
        done.append(name)

    def unlink_or_die(path: Path, missing_ok: bool = False) -> None:
        if path.name in DERIVED:
            step(path.name)
        unlink(path, missing_ok)

    def write_or_die(path: Path, content: dict[str, Any]) -> None:
        step(path.name)
        write(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", unlink_or_die)
        patch.setattr(folder, "write_json", write_or_die)
        patch.setattr(fake_trials.Inline, "run", lambda *_: step("trials") or iter(()))
        with pytest.raises(Killed):
            run(tmp_path / "out", 3, resume=True)
    assert done == [*DERIVED, "manifest.json"][:steps]
    read_results(tmp_path / "out")  # which refuses a folder that has a summary without its trials
    replaced = steps > len(DERIVED)
    assert run(tmp_path / "out", 3 if replaced else 2, resume=True).complete  # as it is now recorded
    assert run(tmp_path / "out", 3, resume=True).summary.results == whole.results
    assert kept(tmp_path / "out") == kept(tmp_path / "whole")


def test_a_vehicle_with_the_name_of_an_added_one_stays_the_same(tmp_path: Path) -> None:
    text = (ROOT / "configs/vehicles/mushr-drive.yaml").read_text()
    (tmp_path / "mushr-drive.yaml").write_text(text)
    (tmp_path / "mine.yaml").write_text(
        "name: mine\ntitle: Mine\nplanner: {mode: replanning, vehicle: mushr-drive.yaml}\ncontroller: {kind: open_loop}\n"
    )
    methods = ["kraft", tmp_path / "mine.yaml"]
    run(tmp_path / "out", 2, ["kraft"])
    run(tmp_path / "out", 2, methods, resume=True)
    run(tmp_path / "whole", 2, methods)
    assert len(manifest(tmp_path / "out")["vehicles"]) == 2
    assert manifest(tmp_path / "out") == manifest(tmp_path / "whole")
    assert kept(tmp_path / "out") == kept(tmp_path / "whole")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"methods": ("oneshot-openloop",)}, ["methods.kraft"]),
        ({"seed": 6}, ["seed"]),
        ({"scenarios": ["turns", "slip", "boxes"]}, ["scenarios.boxes"]),
        ({"realtime": True}, ["realtime"]),
        ({"settings": {"sensing.noise_scale": 2}}, ["scenarios.turns.content.sensing.noise_scale"]),
    ],
)
def test_other_changes_are_refused_although_there_are_more_trials(
    tmp_path: Path, change: dict[str, Any], expected: list[str]
) -> None:
    given: dict[str, Any] = {"scenarios": ["turns", "slip"], "methods": ("kraft",), "seed": 5}
    evaluate(**given, trials=2, out=tmp_path / "out")
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    with pytest.raises(InputError) as caught:
        evaluate(**(given | change), trials=4, out=tmp_path / "out", resume=True)
    paths = [each.path for each in caught.value.diagnostics]
    assert set(expected) <= set(paths)
    assert "trials" not in paths
    assert {each.code for each in caught.value.diagnostics} == {Code.MISMATCH}
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before


def test_a_changed_method_is_refused_beside_an_added_one(tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("name: mine\ntitle: A\nplanner: {mode: replanning}\ncontroller: {kind: open_loop}\n")
    run(tmp_path / "out", 2, [mine])
    mine.write_text(mine.read_text().replace("replanning", "replanning, margin: 0.1"))
    with pytest.raises(InputError) as caught:
        run(tmp_path / "out", 2, [mine, "kraft"], resume=True)
    assert [each.path for each in caught.value.diagnostics] == ["methods.mine.content.planner.margin"]


def test_a_missing_method_or_scenario_is_reported_once_and_not_by_its_vehicle_too(tmp_path: Path) -> None:
    text = (ROOT / "configs/vehicles/mushr-drive.yaml").read_text()
    (tmp_path / "other.yaml").write_text(text.replace("name: mushr-drive", "name: other"))
    mine = tmp_path / "mine.yaml"
    mine.write_text("name: mine\ntitle: Mine\nbase: replanner-openloop\nplanner: {vehicle: other.yaml}\n")
    evaluate(["turns", "track"], ["kraft", mine], 2, 5, out=tmp_path / "out")
    recorded = json.loads((tmp_path / "out/manifest.json").read_text())
    assert set(recorded["vehicles"]) == {"mushr-drive", "other", "f1tenth"}
    for scenarios, methods, path in (
        (["turns", "track"], ["kraft"], "methods.mine"),
        (["turns"], ["kraft", mine], "scenarios.track"),
    ):
        with pytest.raises(InputError) as caught:
            evaluate(scenarios, methods, 2, 5, out=tmp_path / "out", resume=True)
        assert [each.path for each in caught.value.diagnostics] == [path]
    evaluate(["turns"], ["kraft"], 2, 5, out=tmp_path / "one")
    with pytest.raises(InputError) as caught:
        evaluate(["turns", "track"], ["kraft"], 2, 5, out=tmp_path / "one", resume=True)
    assert [each.path for each in caught.value.diagnostics] == ["scenarios.track"]


ROW = {"scenario": "turns", "method": "kraft", "vehicle": ["mushr"]}
DAMAGE = [{"methods": None}, {"trials": "2"}, {"methods": {}}, {"rows": [ROW]}, {"rows": [{"scenario": "turns"}]}]


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_manifest_is_not_replaced(tmp_path: Path, damage: dict[str, Any]) -> None:
    run(tmp_path / "out", 2)
    path = tmp_path / "out/manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | damage))
    before = path.read_bytes()
    with pytest.raises(InputError):
        run(tmp_path / "out", 3, resume=True)
    assert path.read_bytes() == before


def test_a_journal_with_other_trials_keeps_its_results_and_its_manifest(tmp_path: Path) -> None:
    run(tmp_path / "out", 2)
    journal = tmp_path / "out/trials.jsonl"
    journal.write_text(journal.read_text().replace('"seed":6', '"seed":99', 1))
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    with refused((f"{journal}:2:1", Code.MISMATCH)):
        run(tmp_path / "out", 3, resume=True)
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before


def test_a_page_that_is_served_finds_its_replays_after_the_evaluation_got_more_trials(tmp_path: Path) -> None:
    """A trial of it has another number then; its entry, method and seed stay."""
    run(tmp_path / "out", 1)
    with ReportServer(tmp_path / "out") as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            address, key = f"{server.url}replay/drive/slip/kraft/5", ("slip", "kraft", 5)
            before = read(address)
            run(tmp_path / "out", 2, resume=True)
            read(server.url)
            assert read(address) == before == Replays(tmp_path / "out" / REPLAYS).read(key).drive
        finally:
            server.shutdown()
            thread.join()


def read(address: str) -> str:
    with urllib.request.urlopen(address) as answer:
        text: str = answer.read().decode()
    return text
