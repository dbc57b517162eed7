"""What an OMPL program may pass wrongly, or as OMPL's planners never see it, over callbacks."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from ompl import base as ob
from ompl import control as oc
from ompl import util as ou
from support.kernels import NO_SAFETY
from support.ompl_setup import BOUNDS, START, arena, planned

from kraft.vehicles.benchmark import BENCHMARK
from kraft.vehicles.mushr import MUSHR
from ompl_ext import planner as module
from ompl_ext.callback import CallbackSearch
from ompl_ext.configuration import default_configuration, state_reader
from ompl_ext.kernels import kernel_types as at
from ompl_ext.obstacles import Circle, OccupancyGrid, Polygon, Workspace, box
from ompl_ext.plan import TreeView
from ompl_ext.planner import DIRT
from ompl_ext.problem import _options
from ompl_ext.query import Goal, Settings
from ompl_ext.retainment import edges_to_retain
from ompl_ext.solver import DirtSolver
from ompl_ext.system import simple_setup
from ompl_ext.vehicle import ParameterRange

ou.setLogLevel(ou.LOG_NONE)
STATUS = ob.PlannerStatus
Distance = Callable[[ob.State], float]


@pytest.fixture
def grown() -> DirtSolver:
    solver = DirtSolver(BENCHMARK, Workspace(BOUNDS), Goal((3.5, 3.5), 0.25), NO_SAFETY)
    solver.start(np.asarray(START))
    solver.grow(iterations=200)
    return solver


class Region(ob.GoalRegion):
    """Goal by a function of the distance."""

    def __init__(self, si: oc.SpaceInformation, distance: Distance) -> None:
        super().__init__(si)
        self._distance = distance
        self.setThreshold(0.2)

    def distanceGoal(self, state: ob.State) -> float:  # noqa: N802
        return self._distance(state)


class UpperHalf(Region):
    """Of a region the part with y above 2."""

    def isSatisfied(self, state: ob.State) -> bool:  # noqa: N802
        return bool(self._distance(state) < 0.2 and state[1] > 2.0)


def to_the_right(state: ob.State) -> float:
    return max(0.0, 3.5 - state[0])


def pairs(*values: tuple[float, float]) -> ob.RealVectorBounds:
    bounds = ob.RealVectorBounds(len(values))
    for k, (low, high) in enumerate(values):
        bounds.setLow(k, low)
        bounds.setHigh(k, high)
    return bounds


def point(valid: Any = None, controls: tuple[float, float] = (-1.0, 1.0), broken: bool = False) -> oc.SpaceInformation:
    """A point that moves in the square of 4 x 4 m with up to 1 m/s; a broken one has no x at high speeds."""
    space = ob.RealVectorStateSpace(2)
    space.setBounds(pairs((0.0, 4.0), (0.0, 4.0)))
    velocity = oc.RealVectorControlSpace(space, 2)
    velocity.setBounds(pairs(controls, (-1.0, 1.0)))
    si = oc.SpaceInformation(space, velocity)
    si.setPropagationStepSize(0.1)
    si.setMinMaxControlDuration(1, 10)

    def propagate(state: ob.State, control: oc.Control, duration: float, result: ob.State) -> None:
        for k in range(2):
            result[k] = state[k] + duration * control[k]
        if broken and control[0] > 0.5:
            result[0] = math.nan

    si.setStatePropagator(propagate)
    si.setStateValidityChecker(valid or space.satisfiesBounds)
    return si


def planner_for(si: oc.SpaceInformation, goal: ob.Goal, start: tuple[float, float] = (0.5, 0.5), **kw: Any) -> DIRT:
    definition, state = ob.ProblemDefinition(si), si.allocState()
    state[0], state[1] = start
    definition.addStartState(state)
    definition.setGoal(goal)
    planner = DIRT(si, **kw)
    planner.setProblemDefinition(definition)
    return planner


def after(planner: DIRT, iterations: int) -> ob.PlannerStatus:
    return planner.solve(lambda: planner.iterations >= iterations)


def test_a_goal_whose_class_says_what_satisfies_it_is_asked() -> None:
    si = point()
    planner = planner_for(si, UpperHalf(si, to_the_right))
    assert after(planner, 500) == STATUS.EXACT_SOLUTION
    definition = planner.getProblemDefinition()
    path = definition.getSolutionPath()
    assert definition.getGoal().isSatisfied(path.getState(path.getStateCount() - 1))


@pytest.mark.parametrize("kind", [np.float32, np.float64, int])
def test_a_distance_and_an_answer_may_be_of_any_numeric_type(kind: Callable[[float], float]) -> None:
    class Answers(Region):
        def isSatisfied(self, state: ob.State) -> bool:  # noqa: N802
            return np.less(self._distance(state), 0.2)  # type: ignore[no-any-return]

    si = point()
    for goal in (Region(si, lambda state: kind(to_the_right(state))), Answers(si, to_the_right)):
        assert after(planner_for(si, goal), 500) == STATUS.EXACT_SOLUTION


@pytest.mark.parametrize("wrong", [None, "3", np.array([1.0])])
def test_a_distance_that_is_no_number_is_refused_by_the_name_of_the_goal(wrong: Any) -> None:
    si = point()
    with pytest.raises(TypeError, match=r"Region\.distanceGoal\(\) returned .*; expected a number"):
        after(planner_for(si, Region(si, lambda state: wrong)), 1)


def test_a_space_information_that_is_not_set_up_is_set_up() -> None:
    space = ob.RealVectorStateSpace(2)
    space.setBounds(0.0, 4.0)
    velocity = oc.RealVectorControlSpace(space, 2)
    velocity.setBounds(pairs((-1.0, 1.0), (-1.0, 1.0)))
    si = oc.SpaceInformation(space, velocity)  # its propagation step and its durations are not stated

    def propagate(state: ob.State, control: oc.Control, duration: float, result: ob.State) -> None:
        for k in range(2):
            result[k] = state[k] + duration * control[k]

    si.setStatePropagator(propagate)
    si.setStateValidityChecker(space.satisfiesBounds)
    assert after(planner_for(si, Region(si, to_the_right)), 500) == STATUS.EXACT_SOLUTION
    assert si.isSetup()


def test_an_infinite_distance_says_nothing_and_hides_no_goal() -> None:
    si = point()
    planner = planner_for(si, Region(si, lambda state: math.inf if state[0] < 1.0 else to_the_right(state)))
    assert after(planner, 500) == STATUS.EXACT_SOLUTION
    search = planner._search
    assert isinstance(search, CallbackSearch)
    assert search._top_speed <= 1.02
    assert np.isfinite(planner.tree().costs_to_go).all()


def test_a_state_without_numbers_is_no_node_and_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr("ompl_ext.callback.ou.OMPL_WARN", said.append)
    si = point(valid=lambda state: True, broken=True)
    planner = planner_for(si, Region(si, to_the_right))
    after(planner, 200)
    assert np.isfinite(planner.tree().states).all()
    assert len(planner.tree().parents) > 100
    assert len(said) == 1
    assert "is not a number" in said[0]


@pytest.mark.parametrize("where", ["start", "distance", "configuration"])
def test_a_start_without_numbers_is_an_invalid_start(where: str) -> None:
    si = point(valid=lambda state: True)
    goal = Region(si, (lambda state: math.nan) if where == "distance" else to_the_right)
    plane: dict[str, Any] = {"configuration": lambda state: (math.nan, 0.0), "bounds": BOUNDS}
    start = (math.nan if where == "start" else 0.5, 0.5)
    planner = planner_for(si, goal, start, **(plane if where == "configuration" else {}))
    assert after(planner, 10) == STATUS.INVALID_START


@pytest.mark.parametrize("call", ["clear", "solve", "setup"])
@pytest.mark.parametrize("callbacks", [False, True])
def test_a_call_from_a_callback_of_solve_is_refused(call: str, callbacks: bool) -> None:
    planner = planned(arena(), 50, use_callbacks=callbacks)
    asked: list[int] = []

    def condition() -> bool:
        asked.append(1)
        if len(asked) == 2:
            getattr(planner, call)()
        return len(asked) > 100

    with pytest.raises(RuntimeError, match=rf"{call}\(\) was called while another call"):
        planner.solve(condition)
    planner.clear()  # and the planner is free again
    assert planner.edges == 0


def test_a_call_from_another_thread_is_refused_while_solve_runs() -> None:
    planner = planned(arena(), 50, use_callbacks=True)
    errors: list[BaseException] = []

    def clears() -> None:
        try:
            planner.clear()
        except RuntimeError as error:
            errors.append(error)

    def condition() -> bool:
        other = threading.Thread(target=clears)
        other.start()
        other.join()
        return True

    planner.solve(condition)
    assert len(errors) == 1
    assert planner.edges > 0


def test_bounds_without_a_range_are_refused() -> None:
    for low, high in ((-1.0, math.inf), (math.nan, 1.0)):
        si = point(controls=(low, high))
        with pytest.raises(ValueError, match="bounds of control 0"):
            after(planner_for(si, Region(si, to_the_right)), 1)
    for bounds in (((4, 0), (0, 4)), ((0, math.nan), (0, 4)), ((0, 4),)):
        with pytest.raises(ValueError, match="finite with low < high"):
            DIRT(point(), configuration=lambda state: (state[0], state[1]), bounds=bounds)  # type: ignore[arg-type]


def test_an_information_without_controls_and_a_condition_that_is_none_are_refused() -> None:
    with pytest.raises(TypeError, match=r"ompl\.control\.SpaceInformation"):
        DIRT(ob.SpaceInformation(point().getStateSpace()))
    planner = planned(arena(), 1)
    with pytest.raises(TypeError, match="seconds, a function or a termination condition"):
        planner.solve("1")
    assert planner.solve(np.float32(0.001)) != STATUS.INVALID_START
    assert planner.solve(np.int64(0)) != STATUS.INVALID_START


def test_settings_and_objectives_without_effect_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(module.ou, "OMPL_WARN", said.append)
    si = point()
    planner = planner_for(si, Region(si, to_the_right), cycle=1.0, threads=2)
    planner.getProblemDefinition().setOptimizationObjective(ob.PathLengthOptimizationObjective(si))
    after(planner, 10)
    assert len(said) == 3
    assert [any(word in each for each in said) for word in ("safety(state)", "threads", "objective")] == 3 * [True]
    after(planner, 20)
    assert len(said) == 3


def test_what_is_no_path_and_no_tree_is_not_retained() -> None:
    planner = DIRT(point())
    for given in ("x", None):
        with pytest.raises(TypeError, match=r"expected an ompl\.control\.PathControl"):
            planner.retain(given, 1.0)
        with pytest.raises(TypeError, match=r"expected what tree\(\) of a planner returns"):
            planner.retain_tree(given)


def test_a_body_in_space_has_the_plane_of_its_position() -> None:
    space = ob.SE3StateSpace()
    space.setBounds(pairs((0.0, 4.0), (-1.0, 1.0), (0.0, 2.0)))
    state = space.allocState()
    state.setXYZ(0.5, 0.25, 1.0)
    state.rotation().setAxisAngle(0.0, 0.0, 1.0, math.pi)
    configuration, bounds = default_configuration(space)
    assert (configuration(state), bounds) == ((0.5, 0.25), ((0.0, 4.0), (-1.0, 1.0)))
    assert state_reader(space)(state) == pytest.approx([0.5, 0.25, 1.0, 0.0, 0.0, 1.0, 0.0])


def test_a_truth_value_is_no_number() -> None:
    params = DIRT(point(), pruning="true").params()
    assert params["pruning"] is True
    assert not params.setParam("goal_bias", "true")
    with pytest.raises(ValueError, match="goal_bias is 'True'; expected a number"):
        params["goal_bias"] = True
    assert params["goal_bias"] == 0.05


@pytest.mark.parametrize(("longest", "steps"), [(0.05, 1), (0.25, 3), (1.0, 10)])
def test_the_longest_edge_has_the_steps_that_are_checked(longest: float, steps: int) -> None:
    settings = Settings(shortest=0.05, longest=longest, quantum=0.1)
    assert _options(BENCHMARK, NO_SAFETY, settings)[at.STEPS] == steps


def test_a_longest_edge_without_end_is_refused_with_a_quantum_too() -> None:
    for longest in (math.inf, math.nan):
        with pytest.raises(ValueError, match="not 0 < shortest <= longest"):
            Settings(longest=longest, quantum=0.1)


def test_edges_with_another_number_of_controls_are_not_retained() -> None:
    none, tree = np.zeros(2), TreeView(np.zeros((2, 2)), np.array([-1, 0]), np.zeros((2, 1)), *(np.zeros(2),) * 3)
    with pytest.raises(ValueError, match="1 controls an edge; expected 2"):
        DIRT(point()).retain_tree(tree)
    with pytest.raises(ValueError, match="have 1 controls; expected 2"):
        edges_to_retain([-1, 0], np.zeros((2, 1)), none, bounds=np.array([[-1.0, 1.0], [-1.0, 1.0]]))
    assert len(edges_to_retain([], np.zeros((0, 0)), none[:0], bounds=np.array([[-1.0, 1.0]])).parent) == 0


def test_an_empty_path_retains_nothing_and_a_time_before_it_is_refused() -> None:
    si = point()
    planner = planner_for(si, Region(si, to_the_right))
    planner.retain(oc.PathControl(si))
    assert planner.solve(lambda: True) == STATUS.TIMEOUT
    for elapsed in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="elapsed"):
            planner.retain(oc.PathControl(si), elapsed)


@pytest.mark.parametrize("duration", [math.nan, math.inf, -1.0])
def test_a_path_with_durations_that_are_none_is_not_retained(duration: float) -> None:
    si = point()
    path = oc.PathControl(si)
    path.append(si.allocState(), si.allocControl(), duration)
    path.append(si.allocState())
    with pytest.raises(ValueError, match="durations of the path"):
        DIRT(si).retain(path)


def test_a_path_of_more_edges_than_the_tree_may_have_is_not_retained() -> None:
    si = point()
    path = oc.PathControl(si)
    path.append(si.allocState(), si.allocControl(), 1e9)
    path.append(si.allocState())
    planner = planner_for(si, Region(si, to_the_right))
    planner.retain(path)
    with pytest.raises(ValueError, match="more than max_nodes"):
        planner.solve(lambda: True)
    assert planner.solve(lambda: True) == STATUS.TIMEOUT  # and the planner goes on without it


def test_a_setup_checks_what_it_is_given() -> None:
    workspace, goal = Workspace(BOUNDS), Goal((3.5, 3.5), 0.25)
    for count in (3, 5):  # one value too few would be what the memory held, one too many would overwrite it
        with pytest.raises(ValueError, match=f"start has {count} values; expected 4: x, y, theta, v"):
            simple_setup(BENCHMARK, workspace, np.zeros(count), goal)
        with pytest.raises(ValueError, match=f"state has {count} values"):
            DirtSolver(BENCHMARK, workspace, goal, NO_SAFETY).start(np.zeros(count))
    for step in (0.0, -0.1, math.nan):
        with pytest.raises(ValueError, match="step is"):
            simple_setup(BENCHMARK, workspace, START, goal, step=step)
    for duration in ((1.0, 0.5), (0.0, 0.0), (0.5, math.inf)):
        with pytest.raises(ValueError, match="duration is"):
            simple_setup(BENCHMARK, workspace, START, goal, duration=duration)


@pytest.mark.parametrize(
    "obstacle",
    [
        box((1.0, 1.0), (1.0, 1.0), math.nan),
        box((math.inf, 1.0), (1.0, 1.0)),
        Polygon(np.zeros((2, 2))),
        Polygon(np.zeros((3, 3))),
        Polygon(np.array([[3.0, 0.0], [4.0, 1.0], [4.0, 0.0], [3.0, 1.0]])),  # crosses itself
        box((1.0, 1.0), (0.0, 1.0)),
        Circle(np.array([1.0, 1.0]), math.nan),
        Circle(np.array([1.0, 1.0]), -0.3),
        Circle(np.array([1.0, 1.0, 0.0]), 0.3),
        OccupancyGrid(np.full((3, 3), 100, np.int8), 0.1, (0.0, 0.0, 0.0)),  # of ROS
        OccupancyGrid(np.ones(3, bool), 0.1, (0.0, 0.0, 0.0)),
        OccupancyGrid(np.ones((3, 3), bool), 0.0, (0.0, 0.0, 0.0)),
        OccupancyGrid(np.ones((3, 3), bool), 0.1, (0.0, math.nan, 0.0)),
        "box",
    ],
)
def test_an_obstacle_that_would_be_nowhere_is_refused_by_its_number(obstacle: Any) -> None:
    with pytest.raises(ValueError, match=r"^workspace obstacles\[1\]: "):
        Workspace(BOUNDS, (box((1.0, 1.0), (1.0, 1.0)), obstacle))


def test_what_is_wrong_with_a_workspace_is_told_together() -> None:
    with pytest.raises(ValueError, match=r"workspace bounds: .*obstacles\[0\].*obstacles\[2\]"):
        Workspace((0, 5), (3, box((1.0, 1.0), (1.0, 1.0)), None))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="expected a tuple of obstacles"):
        Workspace(BOUNDS, box((1.0, 1.0), (1.0, 1.0)))  # type: ignore[arg-type]


def test_a_goal_has_a_place_and_a_size_and_takes_any_sequence() -> None:
    for wrong in ({"radius": -1.0}, {"radius": math.nan}, {"tolerance": -0.1}, {"heading": math.nan}):
        with pytest.raises(ValueError, match="goal"):
            Goal((1.0, 1.0), **{"radius": 0.2, **wrong})
    for center in ((math.nan, 1.0), (1.0,), (1.0, 2.0, 3.0)):
        with pytest.raises(ValueError, match="goal"):
            Goal(center, 0.2)  # type: ignore[arg-type]
    assert Goal(np.array([1.0, 2.0]), 0.2) == Goal([1.0, 2.0], 0.2) == Goal((1.0, 2.0), 0.2)  # type: ignore[arg-type]


def test_budgets_and_times_of_a_search_are_numbers_that_it_can_count(grown: DirtSolver) -> None:
    with pytest.raises(TypeError):
        grown.grow(iterations=1.5)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="seconds is NaN"):
        grown.grow(seconds=math.nan)
    plan = grown.plan()
    for elapsed in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="elapsed is"):
            grown.retain(plan, elapsed)
    assert grown.retain(plan, np.float64(0.5)) > 0


@pytest.mark.parametrize("name", ["blossom", "insertions", "steps", "discs"])
def test_settings_that_count_are_whole_numbers(name: str) -> None:
    with pytest.raises(ValueError, match=f"settings: {name} must be whole numbers"):
        Settings(**{name: 1.5})
    assert getattr(Settings(**{name: np.int64(2)}), name) == 2


@pytest.mark.parametrize(
    "wrong",
    [
        {"radius": math.inf},
        {"limits": "v"},
        {"limits": {"v": ("0", "1")}},
        {"limits": {"v": 1}},
        {"limits": {"v": "01"}},
    ],
)
def test_a_goal_without_a_border_or_with_limits_that_are_no_numbers_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"^goal: "):
        Goal(**{"center": (1.0, 1.0), "radius": 0.25, **wrong})


@pytest.mark.parametrize("bounds", [(-math.inf, 1.0), (0.1, math.inf), ("0", "1")])
def test_the_range_of_a_parameter_has_finite_bounds(bounds: tuple[Any, Any]) -> None:
    with pytest.raises(ValueError, match="finite low < high"):
        replace(MUSHR, ranges={"L": ParameterRange(*bounds, std=0.1)})
