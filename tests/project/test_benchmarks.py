"""Every benchmark runs, in the smallest size; what it measures is of no interest here."""

from __future__ import annotations

import json
import math
import sqlite3
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest

from benchmarks import callbacks, goals, peers, planner, safety, scaling, startup, sysid, world
from benchmarks.__main__ import main
from benchmarks.effort import SMOKE
from benchmarks.exact import Body, Disc, Rectangle, Star
from benchmarks.judge import judge
from benchmarks.ompl_log import DATABASE
from benchmarks.random_scenes import RandomScene, random_scene
from benchmarks.report import Report, Target, row
from benchmarks.scenes import endless, scene
from benchmarks.synthetic_logs import synthetic_logs
from ompl_ext.plan import Plan
from ompl_ext.query import Safety
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Footprint


def quantities(report: Report) -> dict[str, float]:
    return {each.quantity: each.median for each in report.rows}


def test_planner_finds_solutions_and_judges_them_by_targets() -> None:
    report = planner.run(SMOKE)
    assert quantities(report)["turns: cost after 100 ms"] < 12
    assert {each.met for each in report.rows if each.target is None} == {None}
    assert "turns: checked edges" in report.text()


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
    assert report["turning round: set-up"] > 0
    assert "parking, 1.3 lengths: first solution" in report
    assert report["turning round: plans that hold after 0.2 s"] in (0.0, 100.0)


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
    rates = callbacks.one_round(endless(scene("turns")), SMOKE.seconds, seed=0)
    assert rates["compiled"].edges > rates["callbacks"].edges > 0
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
