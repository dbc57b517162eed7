"""OMPL's control planners on the same query, over the callbacks of `ompl_ext.system`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from ompl import base as ob
from ompl import control as oc
from ompl import util as ou

from ompl_ext.arrays import Floats, Matrix
from ompl_ext.kernels.specialise import kernels
from ompl_ext.obstacles import Workspace
from ompl_ext.plan import Contingency, Plan
from ompl_ext.query import Goal, Safety, Settings
from ompl_ext.system import SimpleSetup, simple_setup
from ompl_ext.times import SAME_TIME
from ompl_ext.validity import SafetyValidityChecker
from ompl_ext.vehicle import Vehicle

PEERS = {"rrt": oc.RRT, "est": oc.EST, "kpiece1": oc.KPIECE1}
STEP = 0.05  # propagation and validity checking (s)


@dataclass(frozen=True)
class PeerResult:
    """Plan of an OMPL planner, None without one, and its effort; OMPL's planners stop at their first solution.

    `nodes` is the number of vertices of the planner data, 0 where OMPL's wheel returns none.
    """

    plan: Plan | None
    seconds: float
    iterations: int
    steps: int
    nodes: int


@contextmanager
def _logging_from(least: ou.LogLevel) -> Iterator[None]:
    """Let OMPL log nothing below a level; the level of the process is restored at the end."""
    before = ou.getLogLevel()
    ou.setLogLevel(max(before, least, key=lambda level: level.value))
    try:
        yield
    finally:
        ou.setLogLevel(before)


@_logging_from(ou.LOG_WARN)
def plan_with_ompl(
    name: str,
    vehicle: Vehicle,
    workspace: Workspace,
    start: Floats,
    goal: Goal,
    *,
    safety: Safety,
    settings: Settings,
    iterations: int | None = None,
    seconds: float | None = None,
    seed: int = 1,
) -> PeerResult:
    """Plan with OMPL's `rrt`, `est` or `kpiece1`; they evaluate the termination condition once an iteration.

    Raises:
        KeyError: the planner is not in `PEERS`.
        ValueError: neither iterations nor seconds are given.
    """
    if iterations is None and seconds is None:
        raise ValueError("a planner needs a budget: iterations or seconds")
    planner_class = PEERS[name]
    with _logging_from(ou.LOG_NONE):  # OMPL logs an error when it is seeded again, although it takes the seed
        ou.RNG.setSeed(seed % 2**31 + 1)  # 0 would mean a seed from the clock
    setup = simple_setup(vehicle, workspace, start, goal, safety, STEP, (settings.shortest, settings.longest))
    si = setup.getSpaceInformation()
    planner = planner_class(si)
    if name == "rrt":
        planner.setIntermediateStates(goal.is_exact)  # a small goal lies within edges, too
    setup.setPlanner(planner)
    setup.setup()
    checks, began = [0], time.perf_counter()

    def is_finished() -> bool:
        checks[0] += 1
        late = seconds is not None and time.perf_counter() - began >= seconds
        return late or (iterations is not None and checks[0] > iterations)

    setup.solve(ob.PlannerTerminationCondition(is_finished))
    seconds_used = time.perf_counter() - began
    plan = _plan_of(setup, vehicle, safety) if setup.haveSolutionPath() else None
    data = ob.PlannerData(si)
    ob.Planner.getPlannerData(planner, data)
    return PeerResult(plan, seconds_used, min(checks[0], iterations or checks[0]), setup.steps, data.numVertices())


def _plan_of(setup: SimpleSetup, vehicle: Vehicle, safety: Safety) -> Plan | None:
    path = setup.getSolutionPath()
    count = path.getControlCount()
    if count == 0:
        return None
    nx, nu = len(vehicle.state), len(vehicle.controls)
    root = np.array([path.getState(0)[k] for k in range(nx)])
    controls = np.array([[path.getControl(i)[k] for k in range(nu)] for i in range(count)])
    durations = np.array([path.getControlDuration(i) for i in range(count)])
    times, trajectory, states = _roll_out(vehicle, root, controls, durations)
    goal, reaches = setup.getGoal(), setup.haveExactSolutionPath()
    distance = float(goal.distanceGoal(path.getState(count)))
    return Plan(
        states=states,
        controls=controls,
        durations=durations,
        times=times,
        trajectory=trajectory,
        cost=float(durations.sum()),
        cost_to_go=0.0 if reaches else max(0.0, distance - goal.getThreshold()) / vehicle.top_speed,
        reaches_goal=reaches,
        contingency=_contingency(setup, times, trajectory, safety) if safety.enabled else None,
    )


def _roll_out(vehicle: Vehicle, root: Floats, controls: Matrix, durations: Floats) -> tuple[Floats, Matrix, Matrix]:
    """Times and states of every step, and the states where controls change."""
    advance, parameters = kernels(vehicle).advance, vehicle.parameter_array
    times, samples, nodes, clock = [0.0], [root], [root], 0.0
    for control, duration in zip(controls, durations, strict=True):
        steps = round(duration / STEP)
        for k in range(1, steps + 1):
            state = np.empty_like(root)
            advance(samples[-1], control, parameters, STEP, state)
            samples.append(state)
            times.append(clock + k * STEP)
        clock += steps * STEP
        nodes.append(samples[-1])
    return np.array(times), np.array(samples), np.array(nodes)


def _contingency(setup: SimpleSetup, times: Floats, trajectory: Matrix, safety: Safety) -> Contingency | None:
    """Contingency at the end of the cycle; None is possible because OMPL's planners do not use SAFETY."""
    checker = setup.getStateValidityChecker()
    assert isinstance(checker, SafetyValidityChecker)
    k = min(int(np.searchsorted(times, safety.cycle - SAME_TIME)), len(times) - 1)
    return checker.safety_from(trajectory[k], float(times[k]))
