"""Controllers that choose a control by rollouts of the vehicle's model in the map: MPPI and the dynamic window.

They drive while the reference is a plan; a contingency is tracked by the law of the other methods, so that all methods
have the same one.  Model, clearance and cost-to-go are those of the planner.

Williams, Drews, Goldfain, Rehg, Theodorou: Information-theoretic model predictive control, T-RO 2018.
Fox, Burgard, Thrun: The dynamic window approach to collision avoidance, 1997.
"""

from __future__ import annotations

import copy
import itertools
import math
from typing import Any, Final, Self

import numpy as np

from kraft.driving.control_settings import Dwa, Mppi, RolloutCost
from kraft.driving.messages import Controller, Estimate, Reference, ReferenceKind
from kraft.driving.vehicle_model import VehicleModel
from ompl_ext.arrays import Floats, Floats32Cube, Matrix
from ompl_ext.interpolation import interpolated_rows
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.costtogo import UNREACHABLE
from ompl_ext.kernels.specialise import optional_module
from ompl_ext.solver import DirtSolver
from ompl_ext.times import SAME_TIME

NEGLIGIBLE: Final = 10.0
"""Costs beyond the least one, as a multiple of the temperature, from which on a rollout does not count: its weight is
below 5e-5 of that of the best one."""
_ANY_SEED: Final = np.random.SeedSequence(0)
"""Seed of a generator whose state is set at once."""


class Rollouts:
    """Costs of rollouts of a vehicle's model in the map of a solver."""

    def __init__(
        self,
        dirt: DirtSolver,
        model: VehicleModel,
        cost: RolloutCost,
        precision: Floats,
        steps: int,
        cutoff: float = math.inf,
    ) -> None:
        """Prepare rollouts of some steps.

        `precision` (nu,) is one over the variance of the noise on each control.  Costs that exceed the least one by
        more than `cutoff` need not be known.
        """
        module = optional_module(model.vehicle, "rollouts")
        self._costs, self._memory = module.roll_out_costs, module.memory(steps)
        self._model, self._precision = model, precision
        self._follows, self._step, self._collision = cost.objective == "plan", cost.step, cost.collision
        self._weights = np.zeros(at.ROLLOUT_WEIGHTS)
        self._weights[at.ROLLOUT_STEP] = cost.step
        self._weights[[at.ROLLOUT_NEAR, at.ROLLOUT_MARGIN]] = cost.near, cost.margin
        self._weights[at.ROLLOUT_CUTOFF] = cutoff
        self._path: tuple[Reference, tuple[Floats, ...]] | None = None
        if self._follows:
            errors = cost.position, math.radians(cost.heading_deg), cost.speed
            self._weights[[at.ROLLOUT_POSITION, at.ROLLOUT_HEADING, at.ROLLOUT_SPEED]] = np.array(errors) ** -2.0
        else:
            self._weights[at.ROLLOUT_GOAL] = cost.goal
        self.set_map(dirt)

    def set_map(self, dirt: DirtSolver) -> None:
        """Roll out in the map of another solver from now on, with its clearance and its goal.

        A collision costs more than the way to the goal from the farthest place.
        """
        self._dirt, togo = dirt, dirt.problem.togo
        self.approaches = self._follows and dirt.goal is not None and dirt.goal.is_exact
        """whether plans to an exact goal are followed: their last moves are too short for the costs to tell"""
        farthest = float(np.max(togo, where=togo < UNREACHABLE, initial=0.0))
        self._weights[at.ROLLOUT_COLLISION] = self._collision + self._weights[at.ROLLOUT_GOAL] * farthest

    @property
    def collision(self) -> float:
        """Least cost of a rollout that collides."""
        return float(self._weights[at.ROLLOUT_COLLISION])

    def costs(
        self,
        estimate: Estimate,
        reference: Reference,
        nominal: Matrix,
        drawn: Floats32Cube,
        noise: Floats32Cube,
        hold: int = 1,
        gamma: float = 0.0,
    ) -> Floats:
        """Costs (n,) of the controls `nominal` (steps, nu) + `drawn` (holds, nu, n), each held for `hold` steps.

        `noise` (steps, nu, n) receives what is left of the latter when the controls are kept within their bounds.
        Costs that need not be known are infinite.
        """
        self._weights[at.ROLLOUT_GAMMA] = gamma
        found = np.empty(drawn.shape[2])
        problem, parameters = self._dirt.problem, self._model.parameters
        followed = self._followed(estimate.time, reference, len(nominal)) if self._follows else np.zeros((0, 5))
        self._costs(
            np.ascontiguousarray(estimate.state, dtype=np.float64), nominal, drawn, hold, followed, self._weights,
            self._precision, problem._replace(parameters=parameters), self._memory, noise, found,
        )  # fmt: skip
        return found

    def _followed(self, time: float, reference: Reference, steps: int) -> Matrix:
        """Reference (steps, 5) after each step: x, y, cosine and sine of the heading, speed."""
        times = time + self._step * np.arange(1, steps + 1)
        x, y, theta, v = (np.interp(times, reference.times, each) for each in self._path_of(reference))
        v[times > reference.end] = 0.0
        return np.column_stack([x, y, np.cos(theta), np.sin(theta), v])

    def _path_of(self, reference: Reference) -> tuple[Floats, ...]:
        """Samples (n,) of x, y, continuous heading and speed of a reference; kept while it is the same."""
        if self._path is None or self._path[0] is not reference:
            model, states = self._model, reference.states
            x, y, v = (np.ascontiguousarray(states[:, k]) for k in (model.x, model.y, model.v))
            self._path = reference, (x, y, np.unwrap(states[:, model.theta]), v)
        return self._path[1]


class Updates:
    """Whether a command needs new controls: every command does, but of those of a copy only some in a second.

    A copy predicts the closed loop.  Between two updates it sends the controls that the last one has chosen for that
    time, as the controller itself would almost do.
    """

    def __init__(self, predicted_hz: float) -> None:
        """`predicted_hz` is the number of updates of a copy in a second."""
        self._predicted, self._period = 1.0 / predicted_hz, 0.0
        self._last: float | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Those of a prediction, which begins with an update."""
        result = copy.copy(self)
        result._period, result._last = self._predicted, None
        return result

    def are_due(self, time: float) -> bool:
        """Whether the command at `time` (s) needs new controls; then it counts as the last one that had them."""
        if self._last is not None and self._last <= time < self._last + self._period - SAME_TIME:
            return False
        self._last = time
        return True

    def restart(self) -> None:
        """Let the next command have new controls."""
        self._last = None


class MppiController:
    """Model predictive path integral control: the mean of sampled controls, weighted by the costs of their rollouts."""

    def __init__(self, settings: Mppi, model: VehicleModel, dirt: DirtSolver, law: Controller, seed: int) -> None:
        """`law` tracks contingencies; the samples depend on `seed` alone."""
        self._settings, self._model, self.law = settings, model, law
        self._deviation = settings.spread * (model.high - model.low)
        cutoff = NEGLIGIBLE * settings.temperature
        self._rollouts = Rollouts(dirt, model, settings, self._deviation**-2.0, settings.steps, cutoff)
        self._random = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, 0x3991])))
        self._nominal = self._at_rest()
        self._noise = np.empty((settings.steps, len(self._deviation), settings.rollouts), np.float32)  # working memory
        self._updates = Updates(settings.predicted_hz)
        self._time: float | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Copy the plan of controls, the random generator and the law; share model, map and working memory."""
        result = copy.copy(self)
        result._nominal, result._random = self._nominal.copy(), _copied(self._random)
        result.law, result._updates = copy.deepcopy(self.law, memo), copy.deepcopy(self._updates, memo)
        return result

    def set_map(self, dirt: DirtSolver) -> None:
        """Drive in the map of another solver from the next command on, with its clearance and its goal."""
        self._rollouts.set_map(dirt)

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) at the estimate's time."""
        if reference.kind is ReferenceKind.CONTINGENCY:
            self._time = None
            return self.law.command(estimate, reference)
        settings = self._settings
        self._shift(estimate.time)
        updates = settings.iterations if self._updates.are_due(estimate.time) else 0
        if updates and self._rollouts.approaches:
            times = estimate.time + settings.step * np.arange(settings.steps, dtype=np.float64)
            self._nominal = self._model.clamped(reference.controls_at(times))
        for _ in range(updates):
            costs = self._rollouts.costs(
                estimate, reference, self._nominal, self._drawn(), self._noise, settings.hold, settings.gamma
            )
            self._nominal = self._model.clamped(updated(self._nominal, self._noise, costs, settings.temperature))
        first: Floats = self._nominal[0].copy()
        return first

    def _drawn(self) -> Floats32Cube:
        """Samples (holds, nu, rollouts) of what is added to the controls, each for some steps."""
        settings = self._settings
        size = (-(-settings.steps // settings.hold), len(self._deviation), settings.rollouts)
        drawn: Floats32Cube = self._random.standard_normal(size, dtype=np.float32)
        drawn *= self._deviation.astype(np.float32)[None, :, None]
        return drawn

    def _at_rest(self) -> Matrix:
        return np.tile(self._model.rest, (self._settings.steps, 1))

    def _shift(self, time: float) -> None:
        """Move the controls to `time` (s), with the last one held; begin with those at rest after a contingency."""
        if self._time is None or time < self._time - SAME_TIME:
            self._nominal = self._at_rest()
            self._updates.restart()
        else:
            self._nominal = moved(self._nominal, (time - self._time) / self._settings.step)
        self._time = time


def _copied(random: np.random.Generator) -> np.random.Generator:
    """Copy of a generator, in a fifth of the time of `copy.deepcopy`."""
    result = np.random.Generator(np.random.PCG64(_ANY_SEED))
    result.bit_generator.state = random.bit_generator.state
    return result


def moved(controls: Matrix, steps: float) -> Matrix:
    """Controls (n, nu) after some steps, between samples interpolated; the last one is held."""
    rows: Floats = np.arange(len(controls), dtype=float)
    return interpolated_rows(rows + steps, rows, controls)


def updated(nominal: Matrix, noise: Floats32Cube, costs: Floats, temperature: float) -> Matrix:
    """Controls (steps, nu) plus the mean of `noise` (steps, nu, n), weighted by the costs (n,) of its rollouts."""
    weights = np.exp((costs.min() - costs) / temperature)
    result: Matrix = nominal + noise @ (weights / weights.sum()).astype(np.float32)
    return result


class DwaController:
    """Dynamic window: the best of the controls that are held over the whole horizon, each checked for collisions."""

    def __init__(self, settings: Dwa, model: VehicleModel, dirt: DirtSolver, law: Controller) -> None:
        """`law` tracks contingencies."""
        self._model, self.law = model, law
        samples = [np.linspace(low, high, settings.samples) for low, high in zip(model.low, model.high, strict=True)]
        self._controls = np.array(list(itertools.product(*samples)))
        steps = max(1, round(settings.horizon / settings.step))
        self._nominal = np.zeros((steps, len(model.low)))
        self._rollouts = Rollouts(dirt, model, settings, np.ones(len(model.low)), steps, cutoff=0.0)
        self._arcs = np.ascontiguousarray(self._controls.T[None], dtype=np.float32)
        self._noise = np.empty((steps, *self._arcs.shape[1:]), np.float32)  # working memory
        self._updates = Updates(settings.predicted_hz)
        self._chosen = model.rest

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Copy the law; the arcs never change."""
        result = copy.copy(self)
        result.law, result._updates = copy.deepcopy(self.law, memo), copy.deepcopy(self._updates, memo)
        return result

    def set_map(self, dirt: DirtSolver) -> None:
        """Drive in the map of another solver from the next command on, with its clearance and its goal."""
        self._rollouts.set_map(dirt)

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) at the estimate's time; if every arc collides, that of the first stopping manoeuvre."""
        if reference.kind is ReferenceKind.CONTINGENCY:
            self._updates.restart()
            return self.law.command(estimate, reference)
        if self._updates.are_due(estimate.time):
            self._chosen = self._best(estimate, reference)
        return self._chosen.copy()

    def _best(self, estimate: Estimate, reference: Reference) -> Floats:
        costs = self._rollouts.costs(estimate, reference, self._nominal, self._arcs, self._noise, len(self._nominal))
        best = int(costs.argmin())
        if costs[best] >= self._rollouts.collision:
            return self._model.stop_control(estimate.state, 0)
        chosen: Floats = self._controls[best]
        return chosen
