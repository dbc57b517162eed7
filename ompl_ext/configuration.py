"""Conversion of OMPL's states and controls to numbers: the plane of DIRT's regions, and rows of floats."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from ompl import base as ob
from ompl import control as oc

Configuration = Callable[[ob.State], tuple[float, float]]
Bounds = tuple[tuple[float, float], tuple[float, float]]


def check_plane(bounds: Bounds) -> None:
    """Check the bounds of the plane of the regions.

    Raises:
        ValueError: they are not two pairs of finite numbers with low < high.
    """
    pairs = [tuple(map(float, pair)) for pair in bounds]
    if len(pairs) != 2 or any(len(pair) != 2 or not -math.inf < pair[0] < pair[1] < math.inf for pair in pairs):
        raise ValueError(
            f"bounds of the plane of the regions: {bounds}; expected ((low, high), (low, high)), finite with low < high"
        )


def default_configuration(space: ob.StateSpace) -> tuple[Configuration, Bounds]:
    """First two components of a real-vector space, x and y of SE(2) and SE(3), or of a compound's first such subspace.

    Raises:
        TypeError: there is no such subspace; pass a configuration to the planner.
    """
    if isinstance(space, ob.RealVectorStateSpace):
        box = space.getBounds()
        if space.getDimension() == 1:
            return (lambda state: (state[0], 0.0)), ((box.low[0], box.high[0]), (-1.0, 1.0))
        return (lambda state: (state[0], state[1])), ((box.low[0], box.high[0]), (box.low[1], box.high[1]))
    if isinstance(space, (ob.SE2StateSpace, ob.SE3StateSpace)):
        box = space.getBounds()
        return (lambda state: (state.getX(), state.getY())), (
            (box.low[0], box.high[0]),
            (box.low[1], box.high[1]),
        )
    if isinstance(space, ob.CompoundStateSpace):
        for k in range(space.getSubspaceCount()):
            try:
                inner, bounds = default_configuration(space.getSubspace(k))
            except TypeError:
                continue
            return (lambda state, k=k, inner=inner: inner(state[k])), bounds
    raise TypeError(
        f"{type(space).__name__} has no plane for the regions of DIRT; pass DIRT(si, configuration=..., bounds=...)"
    )


def goal_configuration(goal: ob.Goal, configuration: Configuration) -> tuple[float, float] | None:
    """Configuration of a goal state, centre of a `PlanarGoal`, None for any other goal."""
    if isinstance(goal, ob.GoalState):
        return configuration(goal.getState())
    center = getattr(getattr(goal, "goal", None), "center", None)
    return (float(center[0]), float(center[1])) if center is not None else None


def state_reader(space: ob.StateSpace) -> Callable[[ob.State], list[float]]:
    """Function from a state to its components, for real vectors, SE(2), SE(3), SO(2), SO(3) and compounds of them.

    Those of a rotation in space are x, y, z and w of its quaternion.

    Raises:
        TypeError: the space is of another kind.
    """
    if isinstance(space, ob.RealVectorStateSpace):
        count = space.getDimension()
        return lambda state: [state[k] for k in range(count)]
    if isinstance(space, ob.SE2StateSpace):
        return lambda state: [state.getX(), state.getY(), state.getYaw()]
    if isinstance(space, ob.SO2StateSpace):
        return lambda state: [state.value]
    if isinstance(space, ob.SO3StateSpace):
        return lambda state: [state.x, state.y, state.z, state.w]
    if isinstance(space, ob.SE3StateSpace):
        rotation = state_reader(ob.SO3StateSpace())
        return lambda state: [state.getX(), state.getY(), state.getZ(), *rotation(state.rotation())]
    if isinstance(space, ob.CompoundStateSpace):
        readers = [state_reader(space.getSubspace(k)) for k in range(space.getSubspaceCount())]
        return lambda state: [value for k, read in enumerate(readers) for value in read(state[k])]
    raise TypeError(f"the components of a {type(space).__name__} cannot be read from Python")


class ControlLayout:
    """Layout of the controls of a real-vector space, or of a compound of such spaces, as rows of floats.

    Raises:
        TypeError: the space is of another kind.
        ValueError: its bounds are not finite.
    """

    def __init__(self, space: oc.ControlSpace) -> None:
        self._leaves: list[tuple[tuple[int, ...], int]] = []
        bounds: list[tuple[float, float]] = []
        self._collect(space, (), bounds)
        for k, (low, high) in enumerate(bounds):
            if not -math.inf < low <= high < math.inf:
                raise ValueError(f"bounds of control {k}: {low:g} to {high:g}; expected finite numbers, low <= high")
        self.bounds = np.array(bounds)
        self.dimension = len(bounds)
        self._is_vector = isinstance(space, oc.RealVectorControlSpace)

    def _collect(self, space: oc.ControlSpace, place: tuple[int, ...], bounds: list[tuple[float, float]]) -> None:
        if isinstance(space, oc.CompoundControlSpace):
            for k in range(space.getSubspaceCount()):
                self._collect(space.getSubspace(k), (*place, k), bounds)
        elif isinstance(space, oc.RealVectorControlSpace):
            box = space.getBounds()
            self._leaves.append((place, space.getDimension()))
            bounds += list(zip(box.low, box.high, strict=True))
        else:
            raise TypeError(
                f"DIRT samples real-vector control spaces and compounds of them, not {type(space).__name__}"
            )

    def write(self, values: list[float], control: oc.Control) -> None:
        """Write a row into OMPL's control."""
        if self._is_vector:  # fast path, called once for every edge
            for k, value in enumerate(values):
                control[k] = value
            return
        k = 0
        for place, count in self._leaves:
            leaf = control
            for index in place:
                leaf = leaf[index]
            for component in range(count):
                leaf[component] = values[k]
                k += 1

    def read(self, control: oc.Control) -> list[float]:
        """Row of OMPL's control."""
        row = []
        for place, count in self._leaves:
            leaf = control
            for index in place:
                leaf = leaf[index]
            row += [leaf[component] for component in range(count)]
        return row
