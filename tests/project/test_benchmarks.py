"""Every benchmark runs, in the smallest size; what it measures is of no interest here."""

from __future__ import annotations

import itertools
import json
import math
import sqlite3
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.benchmarks import quantities

import kraft
from benchmarks import (
    arenas,
    callbacks,
    commands,
    disturbances,
    experiment,
    goals,
    headings,
    maps,
    open_loop,
    peers,
    peers_table,
    planner,
    polish,
    predictions,
    random_arenas,
    safety,
    scaling,
    startup,
    structures,
    sysid,
    tuning,
    world,
    worlds,
)
from benchmarks.__main__ import main
from benchmarks.effort import SMOKE
from benchmarks.exact import Body, Disc, Rectangle, Star
from benchmarks.judge import judge
from benchmarks.ompl_log import DATABASE
from benchmarks.parallel import interval
from benchmarks.random_scenes import RandomScene, random_scene
from benchmarks.report import Report, Target, row
from benchmarks.scenes import endless, scene
from benchmarks.synthetic_logs import synthetic_logs
from kraft.driving.control_settings import Predictive
from kraft.driving.method import Method, load_method
from kraft.driving.solvers import method_safety
from kraft.evaluation.suite import Entry
from kraft.recording import experiment as design
from kraft.scenario import load_scenario
from kraft.vehicles.load import load_vehicle
from ompl_ext.plan import Plan
from ompl_ext.query import Safety
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Footprint


def test_planner_finds_solutions_and_judges_them_by_targets() -> None:
    report = planner.run(SMOKE)
    assert quantities(report)["turns: cost after 100 ms"] < 12
    assert {each.met for each in report.rows if each.target is None} == {None}
    assert "turns: checked edges" in report.text()


def test_maps_are_set_up_searched_and_verified() -> None:
    measured = quantities(maps.run(SMOKE))
    assert measured["clearance lost to the grid"] <= 0.02
    assert measured["set-up"] > 0.0
    assert measured["edges per second of 2 threads over one"] > 0.0


def test_peers_write_a_database_with_runs_and_progress(tmp_path: Path) -> None:
    report = peers.run(SMOKE, tmp_path)
    assert quantities(report)["boxes, kpiece1: first solution"] > 0
    with sqlite3.connect(tmp_path / DATABASE) as connection:
        runs = connection.execute("SELECT COUNT(*) FROM runs WHERE graph_states > 0").fetchone()
        best = connection.execute("SELECT MIN(best_duration), COUNT(*) FROM progress WHERE time > 0").fetchone()
    connection.close()
    assert runs == (8,)
    assert 8 < best[0] < 13
    assert best[1] >= 2


def test_goals_are_turned_round_to_and_parked_at() -> None:
    report = quantities(goals.run(replace(SMOKE, seeds=1)))
    assert report["turning round, 2 m: set-up"] > 0
    assert "parking, 1.3 lengths: first solution" in report
    assert report["turning round, 2 m: plans that hold after 0.2 s"] in (0.0, 100.0)


def test_dynobench_judges_plans_by_its_own_step_and_collision_check(tmp_path: Path) -> None:
    pytest.importorskip("dynobench")
    path = tmp_path / "straight_0.yaml"
    path.write_text(
        "name: straight\n"
        "environment: {min: [0, 0], max: [6, 6], obstacles: [{type: box, center: [3, 2], size: [1, 1]}]}\n"
        "robots: [{type: unicycle2_v0, start: [1, 4, 0, 0, 0], goal: [2, 4, 0, 0, 0]}]\n"
    )
    (problem,) = goals.dynobench(tmp_path)

    def holds(acceleration: float, coasting: float, by: tuple[float, float] = (0.0, 0.0)) -> tuple[bool, bool]:
        start = problem.start + np.array([*by, 0.0, 0.0, 0.0])
        moved = replace(problem, start=start, goal=replace(problem.goal, center=(2.0 + by[0], 4.0 + by[1])))
        controls = np.array([[acceleration, 0.0], [0.0, 0.0], [-acceleration, 0.0]])
        plan = SimpleNamespace(controls=controls, durations=np.array([1.6, coasting, 1.6]))
        return goals.holds_by_dynobench(moved, plan), moved.holds(plan)  # type: ignore[arg-type]

    assert holds(0.25, 0.9) == (True, True)
    assert holds(0.25, 1.2) == (False, False)  # past the goal
    assert holds(0.3, (1.0 - 0.3 * 1.6**2) / 0.48)[0] is False  # more than the robot can do
    assert holds(0.25, 0.9, by=(1.0, -1.6)) == (False, False)  # into the box


def test_local_optimisation_is_measured_with_and_without() -> None:
    report = quantities(polish.run(replace(SMOKE, seeds=1)))
    assert report["turns: one optimisation"] > 0
    assert report["boxes, without: edges, optimisation included"] > 0


def test_scaling_times_windows_of_both_sizes_and_keeps_no_memory() -> None:
    windows = scaling.grow(endless(scene("turns")), 3000, seed=0)
    assert scaling.cost_at(windows, 1000) > 0
    assert scaling.cost_at(windows, 3000) > 0
    assert scaling.memory(scene("turns"), cycles=1)[1].median < 1e7


def test_the_world_is_driven_in_every_scene() -> None:
    found = quantities(world.run(SMOKE))
    assert found["slope: faster than real time"] > 1
    assert found["movable: new world"] > 0


def test_an_endless_search_has_no_solution() -> None:
    query = endless(scene("boxes"))
    dirt = query.dirt(capacity=5000)
    dirt.start(query.start)
    assert dirt.grow(iterations=2000).first_solution is None


def test_callbacks_count_edges_and_steps_of_every_planner() -> None:
    seconds = 0.5  # enough for an edge of every planner on a busy machine
    rates = callbacks.one_round(endless(scene("turns")), seconds, seed=0)
    assert rates["compiled"].edges > 0
    assert rates["callbacks"].edges > 0
    assert all(rates[name].steps > 0 for name in ("callbacks", "rrt", "est", "kpiece1"))


def test_startup_runs_kraft_and_compares_plan_files() -> None:
    assert startup.same_bytes("turns", processes=1)[0].median == 1
    failed = startup.kraft("plan", "no-such-scene")
    assert failed.code == 2
    assert "no-such-scene" in failed.said


def test_random_scenes_are_planned_in_and_judged() -> None:
    found = quantities(safety.run(SMOKE))
    assert found["scenes"] == SMOKE.scenes
    assert found["plans in collision"] == 0


def test_the_judges_polygons_are_counter_clockwise_around_their_centre() -> None:
    stars = [solid for number in range(200) for solid in random_scene(number).solids if isinstance(solid, Star)]
    assert len(stars) > 100
    for star in stars:
        a, b = star.corners - star.center, np.roll(star.corners, -1, axis=0) - star.center
        assert np.all(a[:, 0] * b[:, 1] > a[:, 1] * b[:, 0])


def test_a_random_scene_is_the_same_every_time() -> None:
    one, other = random_scene(5), random_scene(5)
    assert one.solids[-1] == other.solids[-1]
    assert np.array_equal(one.start, other.start)


@cache
def planned() -> tuple[RandomScene, Plan]:
    """Turns with another goal, as the judge wants it, without solids, and a plan with a contingency."""
    given = scene("turns")
    goal = replace(given.goal, center=(1.4, 0.6))  # near: the judge looks at every centimetre
    dirt = DirtSolver(given.vehicle, given.workspace, goal, Safety(), capacity=5000)
    dirt.start(given.start)
    dirt.grow(iterations=1000)
    plan = dirt.plan()
    assert plan is not None
    query = RandomScene(
        0, given.vehicle, given.workspace, (), given.start, goal, dirt.safety, dirt.settings, iterations=0
    )
    return query, plan


def test_the_judge_finds_nothing_wrong_where_there_is_nothing() -> None:
    query, plan = planned()
    judgement = judge(query, query.start, plan)
    assert not any(getattr(judgement, fault) for fault in safety.FAULTS)
    assert judgement.integration_error < 1e-4


def test_the_judge_finds_collisions_of_plans_and_contingencies() -> None:
    query, plan = planned()
    assert plan.contingency is not None
    x, y = plan.trajectory[len(plan.trajectory) // 2, :2].tolist()
    assert judge(replace(query, solids=(Disc((x, y), 0.05),)), query.start, plan).collides
    x, y = plan.contingency.states[-1, :2].tolist()
    assert judge(replace(query, solids=(Disc((x, y), 0.05),)), query.start, plan).contingency_collides


def test_the_judge_finds_too_little_clearance() -> None:
    query, plan = planned()
    far_enough = replace(query, solids=(Disc((1.0, -1.5), 0.5),))
    assert not judge(far_enough, query.start, plan).too_close
    assert judge(replace(far_enough, safety=Safety(delta=0.4)), query.start, plan).too_close
    assert judge(replace(far_enough, safety=Safety(delta=5.0)), query.start, plan).contingency_too_close


def test_the_judge_finds_falsified_plans() -> None:
    query, plan = planned()
    assert plan.contingency is not None
    assert judge(query, query.start + 0.01, plan).differs
    assert judge(query, query.start, replace(plan, contingency=None)).no_contingency
    short = replace(plan.contingency, states=plan.contingency.states[:-1], times=plan.contingency.times[:-1])
    assert judge(query, query.start, replace(plan, contingency=short)).no_contingency


@pytest.mark.parametrize(
    "solid", [Rectangle((2.0, 0.0), (1.0, 1.0), 0.0), Disc((2.0, 0.0), 0.5), Star((2.0, 0.0), np.array(
        [[1.5, -0.5], [2.5, -0.5], [2.5, 0.5], [1.5, 0.5]]))],
)  # fmt: skip
def test_distances_of_the_judge_are_those_of_the_plane(solid: Rectangle | Disc | Star) -> None:
    body = Body((solid,), Footprint(0.4, 0.2, 0.1))
    assert body.distance(0.0, 0.0, 0.0) == pytest.approx(1.2, abs=1e-6)
    assert body.distance(0.0, 0.0, math.pi) == pytest.approx(1.4, abs=1e-6)
    assert body.collides(1.3, 0.0, 0.0)


def test_a_verdict_says_met_or_missed_and_by_how_much() -> None:
    slow = row("q", "ms", [1.0, 3.0], Target(1.0))
    assert (slow.median, slow.worst, slow.met) == (2.0, 3.0, False)
    assert slow.cells()[-1] == "MISSED by 100%"
    fast = row("q", "1/s", [8.0, 4.0], Target(2.0, most=False))
    assert (fast.worst, fast.met) == (4.0, True)
    assert fast.cells()[-1] == "met, 3 times it"
    assert row("q", "s", []).as_json()["median"] is None


def test_the_command_writes_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.__main__.QUICK", SMOKE)
    assert main(["scaling", "--quick", "--out", str(tmp_path)]) in (0, 1)
    content = json.loads((tmp_path / "results.json").read_text())
    assert content["machine"]["versions"]["kraft"]
    assert content["topics"]["scaling"]["rows"]


def test_the_results_of_other_topics_are_kept_and_none_of_other_conditions_are_mixed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = Report("t", [row("q", "s", [1.0])])
    monkeypatch.setattr("benchmarks.__main__.run_topic", lambda topic, effort, out: (measured, 1.0))
    for topic in ("scaling", "maps"):
        assert main([topic, "--quick", "--out", str(tmp_path)]) == 0
    before = (tmp_path / "results.json").read_text()
    assert json.loads(before)["topics"].keys() == {"scaling", "maps"}
    with pytest.raises(SystemExit):
        main(["scaling", "--out", str(tmp_path)])  # without --quick
    assert (tmp_path / "results.json").read_text() == before


def test_an_unknown_topic_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["plannr"])
    assert "expected planner, peers" in capsys.readouterr().err


def test_identification_is_timed_and_tried_on_random_problems(monkeypatch: pytest.MonkeyPatch) -> None:
    """With logs of 8 s, and five of them where ten show no more."""
    monkeypatch.setattr(sysid, "synthetic_logs", partial(synthetic_logs, seconds=8.0))
    monkeypatch.setattr(sysid, "LOGS", 5)
    found = quantities(sysid.run(SMOKE))
    assert found["20 logs of 20 s, 50 ms steps, 30 Hz"] > 0
    assert found["converged, of 2 problems from wild parameters"] == 1.0
    assert found["5 % outliers of 0.5 m: change of L"] < 0.02


def test_disturbances_are_found_and_what_they_do_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disturbances, "LOGS", 3)
    report = disturbances.run(SMOKE)
    assert report.rows[0].median >= 0.5
    assert report.rows[1].median < 1.0
    with_all, cut = (
        rows[0] for rows in ([r for r in report.rows if r.quantity.endswith(end)] for end in ("nine", "out"))
    )
    assert cut.median < with_all.median


def test_random_cars_have_the_terms_that_they_state() -> None:
    truth = structures.random_truth(np.random.default_rng(3))
    assert truth == structures.random_truth(np.random.default_rng(3))
    there = structures.terms_of(truth)
    assert 0 < len(there) < len(structures.RANGES)
    many = [structures.terms_of(structures.random_truth(np.random.default_rng(seed))) for seed in range(50)]
    assert any("skid" in terms for terms in many)
    assert all(terms & {"slide", "understeer"} for terms in many if "skid" in terms)  # else it has no effect
    (log,) = structures.drives(truth, [7])
    assert log.controls == ("throttle", "steering")
    errors = {"auto": 0.02, "all terms": 0.03, "terms that are there": 0.025}
    hidden = frozenset(sorted(there)[:1])
    trials = [structures.Trial(there, found, hidden, errors) for found in (there, there - hidden, frozenset())]
    found = quantities(Report("", structures.rows(trials)))
    assert found["the same terms, share of 3 cars"] == pytest.approx(1 / 3)
    assert found["the same of those that the logs can tell, share of the cars"] == pytest.approx(2 / 3)
    assert found["over that of the best fixed choice"] == pytest.approx(0.8)


def test_recommended_drives_are_compared_with_random_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(experiment, "VEHICLES", {"mushr": "mushr-lag"})
    monkeypatch.setattr(experiment, "PLANNED", 1)
    monkeypatch.setattr(experiment, "RANDOM", 2)
    monkeypatch.setattr(design, "FIRST", 10)
    monkeypatch.setattr(design, "ROUNDS", 0)
    found = quantities(experiment.run(SMOKE))
    assert found["mushr: held-out error after 3 s, 1 recommended"] > 0.0
    assert found["mushr: worst standard deviation over that of 2 random"] > 0.0


def test_a_robot_that_is_its_model_ends_where_its_plan_does_and_another_one_does_not() -> None:
    scenario, vehicle = load_scenario("turns"), load_vehicle("mushr-lag")
    plan = kraft.plan(scenario.task(), vehicle=vehicle, iterations=2000).plan
    assert plan is not None
    own = replace(scenario, truth=scenario.truth.model_copy(update={"model": "mushr-lag"}))
    off = [open_loop.deviation(each, vehicle, plan) for each in (own, scenario)]
    assert off[0] < 0.02
    assert off[1] > 0.05
    assert open_loop.path_length(vehicle, plan) > 5.0


def test_random_arenas_can_be_driven_and_are_the_same_every_time() -> None:
    for kind, gap in arenas.KINDS.values():
        one, other = (random_arenas.random_arena(3, kind, gap) for _ in range(2))
        assert one.obstacles == other.obstacles
        assert random_arenas.can_be_driven(one)


def test_a_drive_in_a_random_arena_is_counted() -> None:
    drive = arenas.drive(1, "kraft")
    counts = {each.quantity.split(",")[0]: each.median for each in arenas.rows_of([drive])[:3]}
    assert counts == {name: float(name == drive.outcome) for name in ("success", "collision", "timeout")}
    assert len(drive.planning) > drive.compared >= drive.regressions


def test_headings_lie_all_round_and_later_ones_between_them() -> None:
    first, second = ({headings.heading(k) for k in numbers} for numbers in (range(30), range(30, 60)))
    assert len(first) == len(second) == 30
    assert not first & second
    assert max(first) - min(first) == 348.0
    outcomes = ("success", "success", "collision", "timeout")
    drives = [headings.Drive("slip", 12.0 * k, k, outcome, 10.0 + k, k, (1.0,)) for k, outcome in enumerate(outcomes)]
    rows = {each.quantity.split(",")[0]: each for each in headings.rows_of(drives)}
    assert (rows["success"].median, rows["success"].met, rows["collision"].median) == (50.0, False, 25.0)
    assert headings.line("slip", drives) == ["slip", "4", "2", "1", "1", "10.5", "1.5"]


def test_worlds_take_turns_with_their_kinds_and_vehicles_and_their_times_are_over_the_bound() -> None:
    found = [worlds.world(k)[:2] for k in range(4, 13)]
    assert {kind for kind, _ in found} == {"posts", "track"}
    tracks = [name for kind, name in found if kind == "track"]
    assert sorted(tracks) == ["f1tenth", "jackal"]
    drives = [
        worlds.Drive("posts", "jackal", "posts-000", outcome, time, 5.0, 0)
        for outcome, time in (("success", 6.0), ("success", 7.0), ("collision", 2.0), ("timeout", 60.0))
    ]
    rows = {each.quantity.split(",")[0]: each.median for each in worlds.rows_of(drives)}
    assert rows["success"] == 50.0
    assert rows["mean time over mean bound"] == 1.3
    assert worlds.line("posts", "jackal", drives) == ["posts, jackal", "4", "2", "1", "1", "6.5", "1.3"]


def test_the_rows_of_the_peers_load_and_their_claims_are_paired_by_entry_and_seed() -> None:
    without = [case.load().planner for case in peers_table.cases() if not case.contingency]
    assert [method_safety(planner).enabled for planner in without] == [False] * 4
    outcomes = {"mppi": ("success", "collision"), "kraft-mppi": ("success", "success")}
    drives = [
        peers_table.Drive(name, "turns", seed, outcome, 9.0, None, 1, 0)
        for name, ended in outcomes.items()
        for seed, outcome in enumerate(ended)
    ]
    assert peers_table.table_of(drives)[1][:5] == ["mppi", "2", f"1 ({interval(1, 2)})", "1", "0"]
    (compared,) = peers_table.comparisons(drives[::-1])
    assert (compared.success.pairs, compared.success.gained, compared.success.lost) == (2, 1, 0)
    (found,) = peers_table.rows_of([compared])
    assert found.quantity.startswith("long horizons, kraft-mppi against mppi: +50.0 points more successes")
    assert (found.median, found.met) == (compared.success.p, False)
    (found,) = peers_table.rows_of([replace(compared, success=replace(compared.success, p=0.01))])
    assert (found.median, found.met) == (0.01, True)
    (found,) = peers_table.rows_of([replace(compared, success=replace(compared.success, p=0.01, difference=-0.5))])
    assert (found.median, found.met) == (1.0, False)


def test_the_time_of_a_command_and_of_all_rows_is_that_of_the_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = []

    def drive(method: Method, entry: str, seed: int) -> Any:
        driven.append((method.name, entry, seed))
        return SimpleNamespace(command_ms=[1.0, 3.0, 8.0])

    monkeypatch.setattr(commands, "drive", drive)
    monkeypatch.setattr(peers_table, "compile_all", lambda: None)
    clock = itertools.count()
    monkeypatch.setattr("time.process_time", lambda: float(next(clock)))
    report = commands.run(SMOKE)
    assert {name for name, _, _ in driven} == set(commands.ROWS)
    assert min(seed for _, _, seed in driven) == commands.SEED - 1
    found = quantities(report)
    assert found["mppi: processor time of a trial"] == 1.0
    assert found["nmpc: one command"] == 3.0
    assert report.rows[0].met is False
    assert report.notes[-1] == "480 trials of each of the 9 rows: 36 min on two cores."


def test_predictions_are_compared_in_pairs_that_differ_in_their_updates_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = []

    def drive(method: Method, entry: Entry, seed: int, name: str) -> peers_table.Drive:
        driven.append((method, entry.name, seed))
        assert isinstance(method.controller, Predictive)
        fewer = method.controller.predicted_hz < method.controller.rate_hz
        outcome = "collision" if fewer and entry.name == "boxes" else "success"
        return peers_table.Drive(name, entry.name, seed, outcome, 9.0 if fewer else 10.0, None, 1, 0)

    monkeypatch.setattr(peers_table, "drive_method", drive)
    monkeypatch.setattr(peers_table, "compile_all", lambda: None)
    report = predictions.run(SMOKE)
    assert len(driven) == 2 * len(predictions.ROWS) * len(peers_table.entries())
    for (with_all, *place), (fewer, *other) in zip(driven[::2], driven[1::2], strict=True):
        assert place == other
        changes = {"controller": {"predicted_hz": fewer.controller.predicted_hz}}
        assert tuning.changed(with_all, changes).model_dump() == fewer.model_dump()
    assert quantities(report)["mppi: time with fewer updates, as a share of that with all"] == pytest.approx(0.9)
    lines = report.tables["pairs"]
    assert lines[1] == ["mppi", "36", "36 / 35", "0 / 1", "1 / 1", "10 / 9", "0.9 to 0.9"]


def test_peers_are_tuned_with_as_many_settings_each_and_ranked_by_successes_collisions_and_time() -> None:
    assert set(tuning.CANDIDATES) == set(peers_table.METHODS)
    assert {len(found) for found in tuning.CANDIDATES.values()} == {8}
    for name, candidates in tuning.CANDIDATES.items():
        methods = [tuning.changed(load_method(name), changes).model_dump_json() for changes in candidates]
        assert len(set(methods)) == len(methods), "every setting is another one"
    outcomes = {0: ("success", "timeout"), 1: ("success", "success"), 2: ("success", "collision")}
    driven = [tuning.Driven("sst", k, outcome, 9.0 + k) for k, ended in outcomes.items() for outcome in ended]
    driven += [tuning.Driven("sst", k, "success", 9.0 + k) for k in range(3, 8) for _ in range(2)]
    order = tuning.ranking("sst", driven)
    assert order == [1, 3, 4, 5, 6, 7, 0, 2]
    assert tuning.table({"sst": order}, driven)[-1] == ["sst", "k_along 5.0", "1", "1", "0", "11"]
