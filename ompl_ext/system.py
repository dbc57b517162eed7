"""A compiled vehicle as an OMPL control space, for any OMPL planner.

OMPL's planners use the propagator and the validity checker as callbacks; `DIRT` recognises the checker and uses the
compiled search.
"""

from __future__ import annotations

import math
import threading

import numpy as np
from ompl import base as ob
from ompl import control as oc

from ompl_ext.arrays import Floats
from ompl_ext.kernels.specialise import kernels
from ompl_ext.obstacles import Workspace
from ompl_ext.query import Goal, Safety
from ompl_ext.validity import SafetyValidityChecker
from ompl_ext.vehicle import Vehicle

DEFAULT_BOUND = math.pi  # of components without a limit or a known range: a turning rate, an angle (SI)


class _Memory(threading.local):
    """State, control and following state of one step, which every thread has for itself."""

    def __init__(self, nx: int, nu: int) -> None:
        x, u, y = np.zeros(nx), np.zeros(nu), np.zeros(nx)
        self.vectors = x, u, y, x.data, u.data, y.data  # the last ones are faster than numpy for single numbers


class Propagator:
    """State propagator for OMPL: one RK4 step of the vehicle's compiled derivative; counts its calls."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._advance, self._parameters = kernels(vehicle).advance, vehicle.parameter_array
        nx, nu = len(vehicle.state), len(vehicle.controls)
        self._memory = _Memory(nx, nu)
        self._states, self._controls = range(nx), range(nu)
        self.calls = 0

    def __call__(self, state: ob.State, control: oc.Control, duration: float, result: ob.State) -> None:
        """Write the state `duration` s after `state` under `control` into `result`."""
        self.calls += 1
        x, u, y, x_now, u_now, y_now = self._memory.vectors
        for k in self._states:
            x_now[k] = state[k]
        for k in self._controls:
            u_now[k] = control[k]
        self._advance(x, u, self._parameters, duration, y)
        for k in self._states:
            result[k] = y_now[k]


class SimpleSetup(oc.SimpleSetup):
    """OMPL's `SimpleSetup` whose `getPlannerData` also supports planners written in Python.

    `propagator` is the callback of the space information; it counts its calls.
    """

    def __init__(self, si: oc.SpaceInformation, propagator: Propagator) -> None:
        super().__init__(si)
        self.propagator = propagator

    @property
    def steps(self) -> int:
        """Propagation steps that planners have made through the callback."""
        return self.propagator.calls

    def setStartState(self, state: ob.State) -> None:  # noqa: N802 (OMPL's name)
        """Set the start state, which may lie outside the range in which states are sampled."""
        self._widen_bounds(state)
        super().setStartState(state)

    def addStartState(self, state: ob.State) -> None:  # noqa: N802
        """Add a start state, which may lie outside the range in which states are sampled."""
        self._widen_bounds(state)
        super().addStartState(state)

    def _widen_bounds(self, state: ob.State) -> None:
        """Widen the sampling range to a start, such as a heading above pi; the checker decides what is valid."""
        space = self.getStateSpace()
        if isinstance(space, ob.RealVectorStateSpace) and not space.satisfiesBounds(state):
            bounds = space.getBounds()
            values = [state[k] for k in range(space.getDimension())]
            if not all(map(math.isfinite, values)):
                return
            lows, highs = map(min, bounds.low, values), map(max, bounds.high, values)
            space.setBounds(_bounds(np.array([*zip(lows, highs, strict=True)])))

    def getPlannerData(self, data: ob.PlannerData) -> None:  # noqa: N802 (OMPL's name)
        """Fill `data` with the planner's tree."""
        data.clear()
        self.getPlanner().getPlannerData(data)


class PlanarGoal(ob.GoalRegion):
    """Goal region of `ompl_ext.query.Goal`: a disc and, optionally, a heading and limits of other components.

    Raises:
        ValueError: the goal bounds a component that the vehicle does not have.
    """

    def __init__(self, si: oc.SpaceInformation, vehicle: Vehicle, goal: Goal) -> None:
        goal.check(vehicle)
        super().__init__(si)
        self.goal, self._vehicle = goal, vehicle
        self.setThreshold(goal.radius)

    def distanceGoal(self, state: ob.State) -> float:  # noqa: N802
        """Distance to the centre (m); above the radius if the heading or a component is outside its limits."""
        distance = self.goal.distance(self._vehicle, state)
        within = self.goal.is_within_limits(self._vehicle, state)
        return distance if within else max(distance, 1.001 * self.getThreshold())


def sampling_range(vehicle: Vehicle, workspace: Workspace) -> Floats:
    """Range in which OMPL's planners sample each state component, shape (nx, 2): low and high.

    It is the workspace for x and y and otherwise the vehicle's limits.  Components without limits have these ranges:
    +-pi for the heading, the top speed for the speed, +-`DEFAULT_BOUND` for the rest.  In wider ranges most samples
    would be far from every state that the vehicle can reach, and RRT's nearest neighbours would be meaningless.
    Propagated states may leave the range: a heading may exceed pi.
    """
    free = np.full(len(vehicle.state), DEFAULT_BOUND)
    if vehicle.rest_indices:
        free[vehicle.rest_indices[0]] = vehicle.top_speed
    if vehicle.index("theta") >= 0:
        free[vehicle.index("theta")] = math.pi
    limits = vehicle.state_limits
    limits[:, 0] = np.where(np.isinf(limits[:, 0]), np.minimum(-free, limits[:, 1] - free), limits[:, 0])
    limits[:, 1] = np.where(np.isinf(limits[:, 1]), np.maximum(free, limits[:, 0] + free), limits[:, 1])
    for name, bounds in zip(("x", "y"), workspace.bounds, strict=True):
        limits[vehicle.index(name)] = bounds
    return limits


def space_information(
    vehicle: Vehicle,
    workspace: Workspace,
    safety: Safety | None = None,
    step: float = 0.05,
    duration: tuple[float, float] = (0.5, 1.0),
    propagator: Propagator | None = None,
) -> oc.SpaceInformation:
    """Space information for `vehicle` in `workspace`: bounds, propagator (RK4), validity with clearance and SAFETY.

    `step` is the propagation step and `duration` the shortest and longest edge (s), multiples of the step.  The bounds
    are `sampling_range`; OMPL rejects a start outside them, and `SimpleSetup` widens them for its starts.

    Raises:
        ValueError: the step is not positive, or the durations are not one step or more with shortest <= longest.
    """
    if not 0.0 < step < math.inf:
        raise ValueError(f"step is {step}; expected a positive number of seconds")
    if not 0.5 * step < duration[0] <= duration[1] < math.inf:
        raise ValueError(f"duration is {duration}; expected (shortest, longest), multiples of the step of {step} s")
    space = ob.RealVectorStateSpace(len(vehicle.state))
    space.setBounds(_bounds(sampling_range(vehicle, workspace)))
    plane = [vehicle.index("x"), vehicle.index("y")]
    cells = [(high - low) / 20 for low, high in workspace.bounds]
    space.registerDefaultProjection(ob.RealVectorOrthogonalProjectionEvaluator(space, cells, plane))
    controls = oc.RealVectorControlSpace(space, len(vehicle.controls))
    controls.setBounds(_bounds(vehicle.control_bounds))
    si = oc.SpaceInformation(space, controls)
    si.setPropagationStepSize(step)
    si.setMinMaxControlDuration(round(duration[0] / step), round(duration[1] / step))
    si.setStatePropagator(propagator or Propagator(vehicle))
    si.setStateValidityChecker(SafetyValidityChecker(si, vehicle, workspace, safety))
    return si


def simple_setup(
    vehicle: Vehicle,
    workspace: Workspace,
    start: Floats,
    goal: Goal,
    safety: Safety | None = None,
    step: float = 0.05,
    duration: tuple[float, float] = (0.5, 1.0),
) -> SimpleSetup:
    """`SimpleSetup` for a query: `setup.setPlanner(DIRT(setup.getSpaceInformation()))`, then `setup.solve(seconds)`.

    `start` (nx,) in the vehicle's components; the other arguments as in `space_information`.

    Raises:
        ValueError: the start has another number of components, or another argument is invalid.
    """
    if len(start) != len(vehicle.state):
        raise ValueError(f"start has {len(start)} values; expected {len(vehicle.state)}: {', '.join(vehicle.state)}")
    propagator = Propagator(vehicle)
    si = space_information(vehicle, workspace, safety, step, duration, propagator)
    setup = SimpleSetup(si, propagator)
    state = si.allocState()
    for k, value in enumerate(start):
        state[k] = float(value)
    setup.setStartState(state)
    setup.setGoal(PlanarGoal(si, vehicle, goal))
    return setup


def _bounds(pairs: Floats) -> ob.RealVectorBounds:
    bounds = ob.RealVectorBounds(len(pairs))
    for k, (low, high) in enumerate(pairs):
        bounds.setLow(k, float(low))
        bounds.setHigh(k, float(high))
    return bounds
