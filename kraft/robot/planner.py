"""The planner of a drive: the replanner with a mirror of the controller's estimator, which answers requests.

With the mirror, the identification, which takes tens of milliseconds, does not hold up the controller.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from time import perf_counter
from typing import Any

from kraft.driving.car_model import model_of
from kraft.driving.control import make_controller
from kraft.driving.control_settings import UserCode
from kraft.driving.estimation import make_estimator
from kraft.driving.estimation.adaptive import AdaptiveEstimator
from kraft.driving.estimator_settings import Oracle
from kraft.driving.messages import Commitment, Estimate, ReferenceKind
from kraft.driving.replanner import Replanner
from kraft.driving.solvers import Solvers
from kraft.planning.feasibility import geodesic_time, goal_hit
from kraft.robot.maps import has_news_of, map_of, with_map
from kraft.robot.protocol import (
    BeginOrder,
    DecisionRequest,
    DriveSpec,
    NewGoal,
    Planned,
    TaskChange,
    TaskTaken,
)
from kraft.scenario import OccupancyMap, Task
from ompl_ext.arrays import Floats
from ompl_ext.poses import pose_of


class Planner:
    """The replanner with a mirror of the controller's estimator."""

    def __init__(self, spec: DriveSpec, keep_trees: bool = False) -> None:
        self._spec, self._keep_trees = spec, keep_trees
        self._task = spec.task
        self._replanner: Replanner | None = None
        self._changing = 0.0  # time that changes of the task have taken since the last search, s

    def begin(self, pose: tuple[float, float, float], grid: OccupancyMap | None = None) -> BeginOrder:
        """Plan the first cycle from where the vehicle stands, around the robot's map too."""
        spec = self._spec
        self._task = changed(self._task, None, grid)
        method, vehicle = spec.method, spec.vehicle
        assert not isinstance(method.estimator, Oracle), "it was checked"
        state = self._state = spec.at_rest(pose)
        self._model = model_of(vehicle)
        self._estimator = make_estimator(method.estimator, self._model, state, spec.camera)
        self._solvers = Solvers.of(self._task, vehicle, method.planner)
        self._replanner = self._new_replanner(self._solvers)
        self._warm_up(state)
        return BeginOrder(state, self._replanner.begin(state, self._estimator.uncertainty(0.0)))

    def command_seconds(self, commitment: Commitment) -> float:
        """Median time that a command of the user's own controller takes (s), 0 of another one."""
        if not isinstance(self._spec.method.controller, UserCode):
            return 0.0
        controller, taken = make_controller(self._spec.controller, self._model), []
        plan = replace(commitment.reference, kind=ReferenceKind.PLAN)
        for _ in range(3):
            began = perf_counter()
            controller.command(Estimate(0.0, self._state.copy(), 0.0), plan)
            taken.append(perf_counter() - began)
        return sorted(taken)[1]

    def _warm_up(self, state: Floats) -> None:
        """Decide and plan once in vain: the first time takes longer, because compiled functions are loaded.

        Where the vehicle stands with less clearance than the method asks for, that lowers what its solvers ask for.
        """
        assert self._replanner is not None, "it is there"
        for goal in self._spec.other_goals:  # for which it plans by other functions
            solvers = Solvers.of(replace(self._task, goal=goal), self._model.vehicle, self._spec.method.planner)
            self._new_replanner(solvers).begin(state)
        asked = self._solvers.checking.safety
        commitment, moving = self._replanner.begin(state), state.copy()
        moving[self._model.v] = 0.5 * self._model.vehicle.top_speed
        self._replanner.decide(Estimate(0.0, moving, 0.0), commitment)
        shape = asked.delta_per_speed, asked.delta_per_time, asked.delta_horizon
        self._solvers.checking.set_bound(asked.delta, *shape)
        self._replanner = self._new_replanner(self._solvers)

    def _new_replanner(self, solvers: Solvers) -> Replanner:
        spec = self._spec
        method = spec.method
        return Replanner(
            solvers, method.planner, make_controller(spec.controller, self._model), spec.seed,
            period=spec.period, delay=self._estimator.horizon, realtime=True, keep_trees=self._keep_trees,
            command_timeout=spec.robot.command.timeout,
        )  # fmt: skip

    def decide(self, request: DecisionRequest) -> tuple[Planned, Any]:
        """Answer a request, without the tree; and the tree."""
        assert self._replanner is not None, "it has begun"
        estimator, sense = self._estimator, request.sense
        observations = deque(sense.observations)
        for time, command, _ in sense.ticks:
            while observations and observations[0].arrival <= time:
                estimator.observe(observations.popleft())
            estimator.commanded(time, command)
        for observation in observations:
            estimator.observe(observation)
        self._replanner.skip_to(request.number)
        estimate = estimator.replanning_estimate(request.time)
        self._replanner.set_delay(estimator.horizon)
        cycle = self._replanner.decide(estimate, request.current)
        if cycle.held is not None:
            estimator.leave_out(*cycle.held)
        self._state = estimate.state
        learned = estimator.learned if isinstance(estimator, AdaptiveEstimator) else None
        return Planned(replace(cycle, tree=None), learned), cycle.tree

    def prepare(self) -> None:
        """Plan for the next cycle, in less time if the task has changed: maps that arrive often go on doing so."""
        assert self._replanner is not None, "it has begun"
        taken, self._changing = self._changing, 0.0
        self._replanner.prepare(taken)

    def change(self, change: TaskChange) -> TaskTaken:
        """Decide and plan for a new goal or map from now on.

        What was planned for the next cycle stays; it is checked against the new map before it is committed.  A new goal
        that cannot be reached is not taken: the last one stays.
        """
        assert self._replanner is not None, "it has begun"
        began = perf_counter()
        task, goal, refused = changed(self._task, change.goal, change.map), change.goal, ""
        problem = self._goal_problem(task)
        if problem and goal is not None:
            x, y = self._task.goal.center
            goal, refused = None, f"{problem}: the last one, ({x:g}, {y:g}), stays"
            task = changed(self._task, None, change.map)
            problem = self._goal_problem(task)
        before, self._task = map_of(self._task), task
        blocked = self._replanner.blocked
        if (grid := change.map) is not None:  # where it has news, what blocked the vehicle is part of it, or is gone
            blocked = tuple(each for each in blocked if not has_news_of(each, before, grid))
        self._solvers = Solvers.of(self._task, self._spec.vehicle, self._spec.method.planner, blocked)
        self._solvers.load(self._state)
        self._replanner.set_solvers(self._solvers, blocked)
        taken = perf_counter() - began
        self._changing += taken
        return TaskTaken(goal, problem, refused, taken)

    def _goal_problem(self, task: Task) -> str:
        """Why the vehicle cannot get to the goal of a task; empty if nothing is known against it."""
        vehicle, (x, y) = self._spec.vehicle, task.goal.center
        if hit := goal_hit(task, vehicle):
            return f"the goal ({x:g}, {y:g}) {hit}"
        here, there, _ = pose_of(self._state, vehicle)
        moved = replace(task, start=replace(task.start, x=here, y=there))
        if math.isinf(geodesic_time(moved, vehicle)):
            return f"the goal ({x:g}, {y:g}) is unreachable: no path to it is wide enough for the vehicle"
        return ""


def changed(task: Task, goal: NewGoal | None, grid: OccupancyMap | None) -> Task:
    """Task with a new goal, and with a new map instead of the last one of the same name."""
    if goal is not None:
        task = replace(task, goal=goal.moved(task.goal))
    return with_map(task, grid)
