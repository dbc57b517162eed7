"""DIRT keeps OMPL's planner contract, compiled and over callbacks."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ompl import base as ob
from ompl import control as oc
from ompl import tools
from ompl import util as ou
from support.kernels import GOAL, NO_SAFETY, TURNS
from support.kernels import START as TURNS_START
from support.ompl_setup import START, arena, planned, solved
from support.paths import ROOT, TESTS

from kraft.vehicles.benchmark import BENCHMARK
from kraft.vehicles.unicycle2 import UNICYCLE2
from ompl_ext.callback import CallbackSearch
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.tree_memory import prune, set_costs_to_go
from ompl_ext.obstacles import Workspace, box
from ompl_ext.peers import plan_with_ompl
from ompl_ext.planner import DIRT
from ompl_ext.problem import pose_cost_to_go_of
from ompl_ext.query import Goal, Safety, Settings
from ompl_ext.solver import DirtSolver
from ompl_ext.system import SimpleSetup, sampling_range, simple_setup
from ompl_ext.validity import SafetyValidityChecker

ou.setLogLevel(ou.LOG_NONE)
STATUS = ob.PlannerStatus


@pytest.mark.parametrize("callbacks", [False, True])
def test_the_solution_path_is_what_ompl_itself_propagates(callbacks: bool) -> None:
    setup = arena()
    planner = solved(setup, use_callbacks=callbacks)
    assert planner.compiled is not callbacks
    assert setup.haveExactSolutionPath()
    assert setup.getSolutionPath().check()


@pytest.mark.parametrize("callbacks", [False, True])
def test_solve_again_continues_and_never_gets_worse(callbacks: bool) -> None:
    setup = arena()
    planner = solved(setup, use_callbacks=callbacks)
    edges, cost = planner.edges, setup.getSolutionPath().length()
    assert setup.solve(0.5 if callbacks else 0.05) == STATUS.EXACT_SOLUTION
    assert planner.edges > edges
    assert setup.getSolutionPath().length() <= cost


def test_clear_forgets_the_tree_and_takes_the_next_seed() -> None:
    setup = arena()
    planner = planned(setup, 500)
    first = planner.tree().controls[1:50]
    setup.clear()
    while planner.iterations < 500:
        setup.solve(0.01)
    assert planner.tree().costs[0] == 0.0
    assert not np.array_equal(planner.tree().controls[1:50], first)


@pytest.mark.parametrize("callbacks", [False, True])
@pytest.mark.parametrize("cleared", ["setup", "planner"])
def test_after_clear_the_tree_is_empty_until_the_next_solve(cleared: str, callbacks: bool) -> None:
    setup = arena()
    planner = planned(setup, 300, use_callbacks=callbacks)
    (setup if cleared == "setup" else planner).clear()
    data = ob.PlannerData(setup.getSpaceInformation())
    setup.getPlannerData(data)
    assert (data.numVertices(), data.numEdges()) == (0, 0)
    assert planner.tree().states.shape == (0, 4)
    assert (planner.edges, planner.iterations) == (0, 0)
    setup.solve(0.2)
    setup.getPlannerData(data)
    assert data.numVertices() == len(planner.tree().parents) > 0


def test_equal_seeds_give_equal_trees_whenever_the_clock_is_looked_at() -> None:
    trees = []
    for _ in range(2):
        setup = arena()
        planner = DIRT(setup.getSpaceInformation(), seed=5)
        setup.setPlanner(planner)
        setup.setup()
        while planner.iterations < 2000:
            setup.solve(0.001)
        trees.append(planner.tree())
    assert np.array_equal(trees[0].states[:1000], trees[1].states[:1000])


def test_a_goal_behind_closed_walls_is_infeasible_at_once() -> None:
    setup = arena(box((3.0, 3.0), (2.0, 0.1)), box((2.0, 3.0), (0.1, 2.0)))
    setup.setPlanner(DIRT(setup.getSpaceInformation()))
    assert setup.solve(5.0) == STATUS.INFEASIBLE
    assert setup.getLastPlanComputationTime() < 2.0


@pytest.mark.parametrize("callbacks", [False, True])
def test_planner_data_is_the_tree(callbacks: bool) -> None:
    setup = arena()
    planner = solved(setup, use_callbacks=callbacks)
    data, tree = ob.PlannerData(setup.getSpaceInformation()), planner.tree()
    setup.getPlannerData(data)
    assert data.numVertices() == len(tree.parents)
    assert data.numEdges() == len(tree.parents) - 1
    assert (data.numStartVertices(), data.numGoalVertices()) == (1, 1)
    node = len(tree.parents) // 2
    assert data.edgeExists(int(tree.parents[node]), node)
    assert data.getVertex(node).getTag() == node
    assert [data.getVertex(node).getState()[k] for k in range(4)] == tree.states[node].tolist()
    assert tree.controls.shape[1] == 2
    assert np.allclose(tree.costs[1:], tree.costs[tree.parents[1:]] + tree.durations[1:])
    setup.getPlanner().getPlannerData(data)  # adds to what is there, as OMPL's planners do
    count = len(tree.parents)
    assert (data.numVertices(), data.numEdges()) == (2 * count, 2 * (count - 1))
    assert data.edgeExists(count + int(tree.parents[node]), count + node)


def test_the_plan_of_a_cycle_has_a_contingency_and_the_tree_asks_for_safety() -> None:
    plan = planned(arena(), cycle=1.0).plan()
    assert plan is not None
    assert plan.contingency is not None
    assert plan.contingency.times[0] == 1.0
    assert abs(plan.contingency.states[-1][3]) <= 0.01


@pytest.mark.parametrize("callbacks", [False, True])
def test_a_path_can_be_retained_from_a_later_state(callbacks: bool) -> None:
    setup = arena()
    planner = solved(setup, use_callbacks=callbacks)
    path = oc.PathControl(setup.getSolutionPath())
    later = path.getState(1)
    elapsed = path.getControlDuration(0)
    setup.clear()
    setup.setStartState(later)
    planner.retain(path, elapsed)
    planner.solve(ob.plannerAlwaysTerminatingCondition())
    assert setup.haveExactSolutionPath()
    assert setup.getSolutionPath().length() == pytest.approx(path.length() - elapsed)


@pytest.mark.parametrize("callbacks", [False, True])
@pytest.mark.parametrize("what", ["path", "tree"])
def test_retained_edges_longer_than_the_longest_become_several_on_the_same_way(what: str, callbacks: bool) -> None:
    before = arena()
    before.getSpaceInformation().setMinMaxControlDuration(25, 40)  # twice the steps of the next arena
    first = solved(before, use_callbacks=callbacks)
    path, setup = before.getSolutionPath(), arena()
    planner = DIRT(setup.getSpaceInformation(), use_callbacks=callbacks)
    setup.setPlanner(planner)
    planner.retain(path) if what == "path" else planner.retain_tree(first.tree())
    setup.solve(ob.plannerAlwaysTerminatingCondition())
    assert planner.tree().durations.max() <= 1.0 + 1e-9
    assert setup.haveExactSolutionPath()
    assert setup.getSolutionPath().length() <= path.length() + 1e-9  # less if an edge is divided within the goal
    assert setup.getSolutionPath().check()


@pytest.mark.parametrize("callbacks", [False, True])
def test_an_edge_of_a_path_with_a_control_beyond_the_bounds_is_not_retained(callbacks: bool) -> None:
    setup = arena()
    planner = solved(setup, use_callbacks=callbacks)
    path = oc.PathControl(setup.getSolutionPath())
    path.getControl(1)[0] = 2.0 * BENCHMARK.controls["throttle"][1]
    setup.clear()
    planner.retain(path)
    planner.solve(ob.plannerAlwaysTerminatingCondition())
    assert len(planner.tree().parents) == 2  # the root and the first edge
    assert planner.retained == 1


def test_a_tree_can_be_retained_from_a_moved_root() -> None:
    setup = arena()
    planner = planned(setup, 500)
    tree = planner.tree()
    setup.clear()
    planner.retain_tree(tree)
    planner.solve(ob.plannerAlwaysTerminatingCondition())
    assert len(planner.tree().parents) == len(tree.parents)
    assert planner.retained == len(tree.parents) - 1


def test_parameters_have_ranges_refuse_what_is_outside_and_suggest_names() -> None:
    params = DIRT(arena().getSpaceInformation()).params()
    assert params.getRangeSuggestion("goal_bias") == "0.:.05:1."
    assert params.setParam("goal_bias", "0.2")
    assert params["goal_bias"] == 0.2
    assert not params.setParam("goal_bias", "2")
    with pytest.raises(ValueError, match="goal_bias is nan"):
        params["goal_bias"] = math.nan
    with pytest.raises(ValueError, match=r"blossom is 3\.5"):
        params["blossom"] = 3.5
    with pytest.raises(KeyError, match="did you mean goal_bias"):
        params["goalbias"] = 1


def test_other_planners_use_the_safety_checker() -> None:
    setup = arena()
    setup.setPlanner(oc.KPIECE1(setup.getSpaceInformation()))
    assert setup.solve(20.0) == STATUS.EXACT_SOLUTION
    assert setup.getSolutionPath().check()
    checker, state = setup.getStateValidityChecker(), setup.getSolutionPath().getState(0)
    assert checker.isValid(state)
    assert checker.clearance(state) == pytest.approx(1.9 - 0.5 - 0.14, abs=1e-6)  # to the wall at its right


@pytest.mark.parametrize("name", ["rrt", "est", "kpiece1"])
def test_ompls_planners_get_through_two_turns_with_few_steps(name: str) -> None:
    for seed in range(3):
        found = plan_with_ompl(
            name, BENCHMARK, TURNS, TURNS_START, GOAL, safety=NO_SAFETY, settings=Settings(), iterations=4000, seed=seed
        )
        assert found.plan is not None
        assert found.plan.reaches_goal
        assert found.steps < 40_000


@pytest.mark.parametrize("level", [ou.LOG_INFO, ou.LOG_NONE])
def test_ompls_planners_log_no_steps_and_leave_the_log_level_as_it_was(
    level: ou.LogLevel, capfd: pytest.CaptureFixture[str]
) -> None:
    ou.setLogLevel(level)
    try:
        plan_with_ompl("rrt", BENCHMARK, TURNS, TURNS_START, GOAL, safety=NO_SAFETY, settings=Settings(), iterations=10)
        assert ou.getLogLevel() == level
    finally:
        ou.setLogLevel(ou.LOG_NONE)
    assert "Info" not in "".join(capfd.readouterr())


def test_states_are_sampled_where_states_can_be() -> None:
    workspace = Workspace(((0.0, 4.0), (1.0, 3.0)), ())
    free = sampling_range(UNICYCLE2, workspace)
    assert free.tolist() == [[0, 4], [1, 3], [-math.pi, math.pi], [-0.6, 0.6], [-math.pi, math.pi]]
    limited = sampling_range(replace(UNICYCLE2, limits={"v": (0.0, 0.3), "omega": (5.0, math.inf)}), workspace)
    assert limited[3:].tolist() == [[0.0, 0.3], [5.0, 5.0 + math.pi]]


def test_safety_names_the_manoeuvre_or_says_that_there_is_none() -> None:
    safety = Safety(delta=0.05, delta_per_speed=0.25)
    workspace = Workspace(((0.0, 4.0), (0.0, 4.0)), (box((2.0, 3.0), (4.0, 0.2)),))
    setup = simple_setup(BENCHMARK, workspace, START, Goal((3.5, 0.5), 0.25), safety)
    checker, state = setup.getStateValidityChecker(), setup.getSpaceInformation().allocState()
    answers = []
    for y in (1.5, 2.55):
        for k, value in enumerate((2.0, y, math.pi / 2, 0.6)):
            state[k] = value
        answers.append(checker.safety(state))
    assert answers[0] is not None
    assert answers[0].manoeuvre == "straight"
    assert answers[0].slack >= 0.0
    assert answers[1] is None
    assert checker.delta(state) == pytest.approx(0.05 + 0.25 * 0.6)


class Disc(ob.GoalRegion):
    """A goal that only OMPL's callbacks know."""

    def __init__(self, si: oc.SpaceInformation) -> None:
        super().__init__(si)
        self.setThreshold(0.3)

    def distanceGoal(self, state: ob.State) -> float:  # noqa: N802
        return math.hypot(state[0].getX() - 3.0, state[0].getY() - 3.0)


def test_any_space_of_compounds_is_planned_over_callbacks() -> None:
    plane, speed = ob.SE2StateSpace(), ob.RealVectorStateSpace(1)
    for space, size, low, high in ((plane, 2, 0.0, 4.0), (speed, 1, -1.0, 1.0)):
        bounds = ob.RealVectorBounds(size)
        bounds.setLow(low)
        bounds.setHigh(high)
        space.setBounds(bounds)
    space = ob.CompoundStateSpace()
    space.addSubspace(plane, 1.0)
    space.addSubspace(speed, 0.3)
    controls = oc.CompoundControlSpace(space)
    for _ in range(2):
        part = oc.RealVectorControlSpace(space, 1)
        unit = ob.RealVectorBounds(1)
        unit.setLow(-1.0)
        unit.setHigh(1.0)
        part.setBounds(unit)
        controls.addSubspace(part)
    si = oc.SpaceInformation(space, controls)
    si.setPropagationStepSize(0.1)
    si.setMinMaxControlDuration(3, 10)

    def propagate(state: ob.State, control: oc.Control, duration: float, result: ob.State) -> None:
        pose, v = state[0], state[1][0]
        result[0].setXY(
            pose.getX() + duration * v * math.cos(pose.getYaw()), pose.getY() + duration * v * math.sin(pose.getYaw())
        )
        result[0].setYaw(pose.getYaw() + duration * control[1][0])
        result[1][0] = v + duration * control[0][0]

    si.setStatePropagator(propagate)
    si.setStateValidityChecker(lambda state: bool((space.satisfiesBounds(state) and abs(state[0].getX() - 2) > 0.1)
                                                  or state[0].getY() > 2.5))  # fmt: skip
    setup = SimpleSetup(si, propagate)  # type: ignore[arg-type]
    start = si.allocState()
    start[0].setXY(1.0, 1.0)
    start[0].setYaw(0.0)
    start[1][0] = 0.0
    setup.setStartState(start)
    setup.setGoal(Disc(si))
    planner = solved(setup)
    assert not planner.compiled
    assert setup.haveExactSolutionPath()
    assert planner.tree().states.shape[1] == 4


def test_what_a_callback_raises_ends_solve_and_the_planner_can_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    setup = arena()
    planner = planned(setup, 200, use_callbacks=True)
    answers = iter([False, False])
    with pytest.raises(StopIteration):
        planner.solve(lambda: next(answers))

    def fails(checker: SafetyValidityChecker, state: ob.State) -> bool:
        raise ZeroDivisionError

    with monkeypatch.context() as patch:
        patch.setattr(SafetyValidityChecker, "isValid", fails)
        with pytest.raises(ZeroDivisionError):
            planner.solve(5.0)
    edges, nodes = planner.edges, len(planner.tree().parents)
    assert planner.solve(0.2) == STATUS.EXACT_SOLUTION
    assert planner.edges > edges
    assert len(planner.tree().parents) > nodes


def test_equal_seeds_give_equal_trees_over_callbacks() -> None:
    trees = []
    for _ in range(2):
        setup = arena()
        planner = DIRT(setup.getSpaceInformation(), seed=5, use_callbacks=True)
        setup.setPlanner(planner)
        setup.setup()
        while planner.iterations < 600:
            planner.solve(0.01)
        trees.append(planner.tree())
    size = min(len(tree.parents) for tree in trees)  # the clock decides how far each search went on
    assert size > 400
    assert np.array_equal(trees[0].states[:size], trees[1].states[:size])
    assert np.array_equal(trees[0].parents[:size], trees[1].parents[:size])


def test_a_learned_top_speed_updates_the_costs_to_go_of_the_whole_tree() -> None:
    planner = planned(arena(), 1000, use_callbacks=True)
    search = planner._search
    assert isinstance(search, CallbackSearch)
    tree = search._tree
    size, speed = int(tree.count[at.SIZE]), search._top_speed
    value, parent = tree.value[:size], tree.link[:size, at.PARENT]
    distance = np.array([search._distance[int(slot)] for slot in tree.state[:size, 0]])
    covered = distance[parent[1:]] - distance[1:]
    assert (covered / tree.edge[1:size, -1]).max() <= speed <= 0.63  # of the benchmark's vehicle, with 1 %
    assert np.allclose(value[:, at.TOGO], np.maximum(distance, 0.0) / speed, rtol=1e-12)
    assert np.array_equal(value[:, at.F], value[:, at.COST] + value[:, at.TOGO])
    assert value[1:, at.TOGO].min() == tree.best[1] == value[tree.count[at.CLOSEST], at.TOGO]


def test_pruning_keeps_what_a_higher_learned_top_speed_could_still_make_better() -> None:
    planner = planned(arena(), 1000, use_callbacks=True)
    search = planner._search
    assert isinstance(search, CallbackSearch)
    tree = search._tree
    size = int(tree.count[at.SIZE])
    distance = np.array([search._distance[int(slot)] for slot in tree.state[:size, 0]])
    set_costs_to_go(tree, np.maximum(distance, 0.0) / (0.5 * search._top_speed), 0.01, 0.0)  # as learned until now
    open_nodes = tree.value[:size, at.RADIUS] > 0.0
    promising = open_nodes & (tree.value[:size, at.COST] < tree.best[0])
    assert (tree.value[:size, at.F][promising] >= tree.best[0]).any()
    kept = tree.state[:size, 0][promising].tolist()
    prune(tree, at.COST)
    assert set(kept) <= set(tree.state[: tree.count[at.SIZE], 0].tolist())


@pytest.mark.parametrize("callbacks", [False, True])
def test_memory_grows_up_to_the_most_nodes(callbacks: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ompl_ext.callback.CAPACITY" if callbacks else "ompl_ext.compiled_search.CAPACITY", 100)
    unlimited = planned(arena(), 500, use_callbacks=callbacks)
    assert len(unlimited.tree().parents) > 200
    began = time.perf_counter()
    setup = arena()
    limited = planned(setup, 0, use_callbacks=callbacks, max_nodes=200)
    setup.solve(30.0)
    assert 100 < len(limited.tree().parents) <= 200
    assert time.perf_counter() - began < 20.0  # memory has ended the search


def test_benchmark_runs_dirt_beside_ompls_planners(tmp_path: Path) -> None:
    setup = arena()
    setup.setup()
    si = setup.getSpaceInformation()
    benchmark = tools.Benchmark(setup, "arena")
    benchmark.addPlanner(DIRT(si))
    benchmark.addPlanner(oc.EST(si))
    request = tools.Request(0.5, 1000.0, 2, 0.05, False, False, False)
    benchmark.benchmark(request)
    assert benchmark.saveResultsToFile(str(tmp_path / "arena.log"))
    planners = benchmark.getRecordedExperimentData().planners
    assert [len(planner.runs) for planner in planners] == [2, 2]
    assert all(run["solved BOOLEAN"] == "1" for run in planners[0].runs)


def test_no_object_is_leaked_at_exit() -> None:
    script = (
        "import sys; sys.path[:0] = sys.argv[1:]\n"
        "from support.ompl_setup import arena, planned\n"
        "planned(arena(), 500)\n"
        "planned(arena(), 200, use_callbacks=True)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(ROOT), str(TESTS)], capture_output=True, text=True, check=True
    )
    assert "leaked" not in done.stderr


def test_limits_of_the_goal_keep_a_state_out_of_the_region() -> None:
    goal = Goal((1.0, 5.0), 0.25, limits={"v": (0.0, 0.2)})
    setup = simple_setup(BENCHMARK, TURNS, TURNS_START, goal)
    region, state = setup.getGoal(), setup.getSpaceInformation().allocState()
    for k, value in enumerate((1.0, 5.0, 0.0, 0.1)):
        state[k] = value
    assert region.isSatisfied(state)
    state[3] = 0.3
    assert not region.isSatisfied(state)
    assert region.distanceGoal(state) > goal.radius
    with pytest.raises(ValueError, match="omega"):
        simple_setup(BENCHMARK, TURNS, TURNS_START, Goal((1.0, 5.0), 0.25, limits={"omega": (0.0, 0.2)}))


@pytest.mark.parametrize("callbacks", [False, True])
def test_a_heading_and_limits_hold_where_the_path_ends(callbacks: bool) -> None:
    goal = Goal((1.0, 0.6), 0.3, math.pi / 2, math.radians(40), {"v": (0.0, 0.5)})
    setup = simple_setup(BENCHMARK, TURNS, TURNS_START, goal)
    planner = DIRT(setup.getSpaceInformation(), use_callbacks=callbacks)
    setup.setPlanner(planner)
    setup.solve(3.0 if callbacks else 0.5)
    assert setup.haveExactSolutionPath()
    path = setup.getSolutionPath()
    end = path.getState(path.getStateCount() - 1)
    assert goal.contains(BENCHMARK, np.array([end[k] for k in range(4)]))


def test_maps_of_vehicles_that_differ_in_their_top_speed_alone_are_not_shared() -> None:
    goal, workspace = Goal((2.0, 2.0), 0.2, heading=1.0, tolerance=0.3), Workspace(((0.0, 4.0), (0.0, 4.0)))
    slow = replace(UNICYCLE2, top_speed=0.5 * UNICYCLE2.top_speed)
    found, again, other = (pose_cost_to_go_of(v, workspace, goal, Settings()) for v in (UNICYCLE2, UNICYCLE2, slow))
    assert found is again is not other


def test_witnesses_of_sst_have_memory_for_all_nodes() -> None:
    workspace = Workspace(((0.0, 20.0), (0.0, 20.0)))
    settings = Settings(planner="sst", pruning_radius=0.02)
    solver = DirtSolver(UNICYCLE2, workspace, Goal((19.5, 19.5), 0.2), NO_SAFETY, settings, 64, 4096)
    solver.start(np.array([0.5, 0.5, 0.0, 0.0, 0.0]))
    for _ in range(20):
        solver.grow(seconds=0.02)
        tree, sparse = solver._trees[0].tree, solver._trees[0]._sparse
        assert sparse is not None
        assert len(sparse._witnesses.state) >= int(sparse._witnesses.count[at.SIZE])
        assert int(sparse._witnesses.count[at.SIZE]) <= len(tree.state)
    assert len(tree.state) > 64
