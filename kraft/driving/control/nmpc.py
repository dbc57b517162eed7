"""Nonlinear model predictive control with CasADi: follows the path of least cost-to-go, or tracks a plan.

Every command solves an optimal control problem by multiple shooting with the vehicle's own derivative.  Each disc of
the footprint has to stay in a half-plane of free space at each step: the distance to obstacles, linearised along the
last solution.  A contingency is tracked by the law of the other methods.

The problem starts from the last solution, moved to the present.  With the solver `sqp` one Gauss-Newton step is enough
for most commands, which is the real-time iteration.

Diehl, Bock, Schloeder: A real-time iteration scheme for nonlinear optimization in optimal feedback control, 2005.
"""

from __future__ import annotations

import copy
import itertools
import math
from typing import Any, Final, Self

import numpy as np

from kraft.driving.control.nmpc_problem import NmpcProblem, Solution
from kraft.driving.control.sampling import Updates, moved
from kraft.driving.control_settings import Nmpc
from kraft.driving.messages import Controller, Estimate, Reference, ReferenceKind
from kraft.driving.vehicle_model import VehicleModel
from ompl_ext.arrays import Cube, Floats, Matrix
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.clearance import cover
from ompl_ext.kernels.half_planes import half_planes
from ompl_ext.kernels.specialise import step_kernels
from ompl_ext.solver import DirtSolver

FAR: Final = 3.0
"""Distance beyond which obstacles are not looked for, m."""


class NmpcController:
    """Solves a problem for each command and sends its first control.  `unsolved` counts those that were not solved."""

    def __init__(self, settings: Nmpc, model: VehicleModel, dirt: DirtSolver, law: Controller) -> None:
        """Make the solver once; `law` tracks contingencies.

        Raises:
            MissingDependency: if CasADi is missing.
            InputError: if the vehicle's derivative cannot be written as an expression.
        """
        self._settings, self._model, self._dirt, self.law = settings, model, dirt, law
        self._discs = cover(model.vehicle.footprint, settings.discs).discs
        self._problem = NmpcProblem(settings, model, self._discs[:, :2])
        self._kernels = step_kernels(model.vehicle)
        self._block = np.empty(self._kernels.block)  # working memory
        self._solution: Solution | None = None
        half_planes()  # loaded here, before the vehicle drives
        self._path: tuple[Reference, tuple[Floats, ...]] | None = None
        self._last = model.rest
        self._time = 0.0
        self._updates = Updates(settings.predicted_hz)
        self.unsolved = 0

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Copy the last solution and the law; share the solver, the model and the map."""
        result = copy.copy(self)
        result.law, result._updates = copy.deepcopy(self.law, memo), copy.deepcopy(self._updates, memo)
        return result

    def set_map(self, dirt: DirtSolver) -> None:
        """Stay clear of the obstacles of another solver from the next command on, with its clearance."""
        self._dirt = dirt

    @property
    def _approaches(self) -> bool:
        """Whether plans to an exact goal are tracked."""
        goal = self._dirt.goal
        return self._settings.objective == "plan" and goal is not None and goal.is_exact

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) at the estimate's time."""
        if reference.kind is ReferenceKind.CONTINGENCY:
            self._solution, self._last = None, self.law.command(estimate, reference)
            return self._last
        is_due = self._updates.are_due(estimate.time)
        if is_due or self._solution is None:
            return self._model.clamped(self.solve(estimate, reference).controls[0])
        self._last = moved(self._solution.controls, (estimate.time - self._time) / self._settings.step)[0]
        return self._model.clamped(self._last)

    def solve(self, estimate: Estimate, reference: Reference) -> Solution:
        """The optimum from the estimate on."""
        targets = self._targets(estimate, reference)
        guess = self._guess(estimate, reference, targets)
        planes = self._planes(guess.states[1:])
        if self._approaches:  # such a plan may have to be nearer to obstacles, and is verified with the exact footprint
            planes[:, :, 2] -= self._lack(targets)
        planned = self._planned_changes(estimate.time, reference)
        self._solution = self._problem.solve(guess, self._model.parameters, targets, planes, self._last, planned)
        self._last, self._time = self._solution.controls[0], estimate.time
        self.unsolved += not self._solution.solved
        return self._solution

    def _guess(self, estimate: Estimate, reference: Reference, targets: Matrix) -> Solution:
        """The last solution, moved to the time of the estimate and driven from there by the model.

        Without one it is the best of the controls that are held: an optimiser that begins at rest may turn a fast
        vehicle the wrong way round.  The controls of a plan that is tracked replace it if they come nearer to the
        targets, since a new plan may lead round an obstacle on the other side.
        """
        settings, model = self._settings, self._model
        if self._solution is None or not self._time <= estimate.time < self._time + 1.0:
            held = itertools.product(*zip(model.rest, model.low, model.high, strict=True))
            candidates = [np.tile(control, (settings.steps, 1)) for control in held]
        else:
            candidates = [moved(self._solution.controls, (estimate.time - self._time) / settings.step)]
        if settings.objective == "plan":
            candidates.append(self._planned(estimate.time, reference))
        count, starts = len(candidates), np.array([estimate.state] * len(candidates), dtype=float)
        controls = np.empty((settings.steps, count, len(model.low)))
        for k, candidate in enumerate(candidates):
            controls[:, k] = candidate
        states = np.empty((settings.steps + 1, *starts.shape))
        self._kernels.simulate(
            starts, controls, np.array([model.parameters] * count),
            np.full((settings.steps, count), settings.step), False, self._block, states,
        )  # fmt: skip
        away = ((states[1:, :, [model.x, model.y]] - targets[:, None, :2]) ** 2).sum(axis=(0, 2))
        best = int(away.argmin())
        return Solution(states[:, best].copy(), candidates[best], math.inf, solved=False)

    def _planned(self, time: float, reference: Reference) -> Matrix:
        """Controls (steps, nu) of a plan from `time` (s) on."""
        settings = self._settings
        begins = time + settings.step * np.arange(settings.steps, dtype=np.float64)
        return self._model.clamped(reference.controls_at(begins))

    def _planned_changes(self, time: float, reference: Reference) -> Matrix:
        """Changes (steps, nu) of the controls, from the last ones on, that cost nothing: a plan's to an exact goal.

        The last moves to such a goal are short and often reverse: their changes would cost more than to stand beside
        the plan.
        """
        changes = np.zeros((self._settings.steps, len(self._last)))
        if self._approaches:
            planned = self._planned(time, reference)
            changes[0], changes[1:] = planned[0] - self._last, np.diff(planned, axis=0)
        return changes

    def _targets(self, estimate: Estimate, reference: Reference) -> Matrix:
        """Targets (steps, 4) after each step: x, y, heading, speed.

        A plan is tracked in time.  A path is followed from the point that is nearest to the vehicle on.
        """
        settings, model = self._settings, self._model
        ahead = settings.step * np.arange(1, settings.steps + 1)
        along, x, y, theta, v = self._path_of(reference)
        if settings.objective == "plan":
            wanted = estimate.time + ahead
            speeds = np.where(wanted <= reference.end, np.interp(wanted, along, v), 0.0)
        else:
            away = np.hypot(x - estimate.state[model.x], y - estimate.state[model.y])
            cruise = settings.cruise * model.vehicle.top_speed
            wanted = along[int(away.argmin())] + cruise * ahead
            speeds = np.full(len(ahead), cruise)
        targets = np.empty((settings.steps, 4))
        for k, each in enumerate((x, y, theta)):
            targets[:, k] = np.interp(wanted, along, each)
        targets[:, 3] = speeds
        return targets

    def _path_of(self, reference: Reference) -> tuple[Floats, ...]:
        """Times of a plan or lengths along a path (m,), x, y, heading and speed there; kept while it is the same."""
        if self._path is None or self._path[0] is not reference:
            model, states = self._model, reference.states
            x, y, v = (np.ascontiguousarray(states[:, k]) for k in (model.x, model.y, model.v))
            along = reference.times
            if self._settings.objective == "goal":
                along = np.concatenate([[0.0], np.hypot(np.diff(x), np.diff(y)).cumsum()])
            self._path = reference, (along, x, y, np.unwrap(states[:, model.theta]), v)
        return self._path[1]

    def _lack(self, targets: Matrix) -> Matrix:
        """What discs (steps, discs) lack of their distance to obstacles in the poses of the targets, m."""
        x, y = self._centres(targets[:, :3])
        planes = self._half_planes(x, y)
        lack: Matrix = np.maximum(planes[:, :, 2] - planes[:, :, 0] * x - planes[:, :, 1] * y, 0.0)
        return lack

    def _planes(self, states: Matrix) -> Cube:
        """Half-planes (steps, discs, 3) that the discs' centres stay in: normal and least distance along it."""
        model = self._model
        return self._half_planes(*self._centres(states[:, [model.x, model.y, model.theta]]))

    def _centres(self, poses: Matrix) -> tuple[Matrix, Matrix]:
        """Coordinates x and y (steps, discs) of the discs' centres in some poses (steps, 3), m."""
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        ahead, aside = self._discs[:, 0], self._discs[:, 1]
        x = poses[:, 0, None] + ahead * c[:, None] - aside * s[:, None]
        y = poses[:, 1, None] + ahead * s[:, None] + aside * c[:, None]
        return x, y

    def _half_planes(self, x: Matrix, y: Matrix) -> Cube:
        """Half-planes (steps, discs, 3) of free space at the discs' centres."""
        problem, radius = self._dirt.problem, self._discs[:, 2]
        required, planes = radius + self._settings.margin + float(problem.scalar[at.DELTA]), np.empty((*x.shape, 3))
        half_planes()(problem.field, problem.scalar, x, y, required, FAR, planes)
        return planes
