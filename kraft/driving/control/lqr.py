"""Tracking of any vehicle: a time-varying linear-quadratic regulator along the reference, with its control fed forward.

The gains follow from the vehicle's own compiled model, linearised along the reference (Anderson and Moore: Optimal
Control, Linear Quadratic Methods, 1989, ch. 3), so that no law has to be written for a vehicle.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from kraft.driving.control_settings import Lqr
from kraft.driving.messages import Estimate, Reference, ReferenceKind
from kraft.driving.vehicle_model import VehicleModel
from kraft.errors import Code, InputError
from kraft.vehicles.load import problem_of
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.times import SAME_TIME

KEPT: Final = 32
"""Number of references whose gains are kept: a decision predicts that many motions at most."""
BELOW: Final = 0.95
"""Share of the planned velocities at which a model is linearised: where it saturates, no control would seem to help."""
SHARES: Final = (0.0, 0.5, -0.5)
"""Controls, as shares of their bounds, at which controllability is tested after a motion has begun."""
BEGINNING: Final = 20
TESTED: Final = 20
STEP: Final = 0.05
"""Numbers of steps of `STEP` s in which the tested motion begins, and along which it is tested.

A second each: after the first one lags have passed, and along the second one every controlled component has moved.
"""
REACH: Final = 1e-4
"""Least change of a pose or velocity (m, rad, m/s, rad/s) within the tested motion by which it counts as controlled."""


class LqrController:
    """Regulates the state to that of the reference; once a reference is over, the vehicle's own manoeuvre stops it."""

    def __init__(self, settings: Lqr, model: VehicleModel) -> None:
        """Set the weights: an error or a correction as large as its setting costs 1."""
        self._model = model
        vehicle = model.vehicle
        tolerated = np.full(len(vehicle.state), math.inf)
        tolerated[[model.x, model.y]], tolerated[model.theta] = settings.position, math.radians(settings.heading_deg)
        tolerated[model.velocities] = 2.0 * settings.speed / vehicle.footprint.width
        tolerated[model.v] = settings.speed
        self._state_cost = np.diag(tolerated**-2.0)
        self._control_cost = np.diag((settings.control_share * (model.high - model.low)) ** -2.0)
        self._settling = settings.settling
        self._gains: list[tuple[Reference, Floats, Floats]] = []

    def __deepcopy__(self, memo: object) -> Self:
        """Return the controller itself, which has no state but gains that it would compute again."""
        return self

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) at the estimate's time."""
        model, time, state = self._model, estimate.time, estimate.state
        if time >= reference.end - SAME_TIME or len(reference.controls) == 0:  # one that stands is a single pose
            number = 0 if reference.stop is None else reference.stop.manoeuvre
            return model.stop_control(state, number)
        planned = reference.state_at(time)
        error: Floats = planned - state
        error[model.theta] = math.remainder(float(error[model.theta]), math.tau)
        if reference.kind is ReferenceKind.CONTINGENCY:
            self._drop_lag(error, planned)
        k = max(int(reference.times.searchsorted(time, side="right")) - 1, 0)
        return model.clamped(reference.control_at(time) + self._gains_of(reference)[k] @ error)

    def _drop_lag(self, error: Floats, planned: Floats) -> None:
        """Remove what would accelerate: a contingency never drives faster than planned to make up for a lag."""
        model = self._model
        speed, theta = float(planned[model.v]), float(planned[model.theta])
        sense = math.copysign(1.0, speed)
        ahead = sense * math.cos(theta), sense * math.sin(theta)
        behind = max(float(error[model.x]) * ahead[0] + float(error[model.y]) * ahead[1], 0.0)
        error[model.x] -= behind * ahead[0]
        error[model.y] -= behind * ahead[1]
        error[model.v] = sense * min(sense * float(error[model.v]), 0.0)

    def _gains_of(self, reference: Reference) -> Floats:
        """Gains (m - 1, nu, nx) of a reference, one for each of its intervals."""
        parameters = self._model.parameters
        for known, learned, gains in self._gains:
            if known is reference and np.array_equal(learned, parameters):
                return gains
        gains = self._computed(reference)
        self._gains = [*self._gains[-KEPT + 1 :], (reference, parameters.copy(), gains)]
        return gains

    def _computed(self, reference: Reference) -> Floats:
        """Solve the Riccati difference equation backwards along the reference."""
        durations, states = np.diff(reference.times), reference.states[:-1].copy()
        states[:, self._model.velocities] *= BELOW
        _, by_state, by_control = self._model.linearised(states, reference.controls, durations)
        gains = np.empty((len(durations), *by_control.shape[:0:-1]))
        to_go = self._state_cost * self._settling
        for k in range(len(durations) - 1, -1, -1):
            a, b, h = by_state[k], by_control[k], float(durations[k])
            coupled = b.T @ to_go
            gains[k] = np.linalg.solve(self._control_cost * h + coupled @ b, coupled @ a)
            to_go = self._state_cost * h + a.T @ to_go @ (a - b @ gains[k])
            to_go = 0.5 * (to_go + to_go.T)
        return gains


@dataclass(frozen=True)
class _Reached:
    """How far controls move the pose and the velocities: the least change, and the component that changes least."""

    least: float
    component: str


def check_controllable(model: VehicleModel) -> None:
    """Check that feedback can correct the pose and the velocities of a vehicle that moves.

    The vehicle begins to move from rest with each combination of its controls at their bounds; the linearised model
    has to be controllable along one of the motions that follow.

    Raises:
        InputError: if it is not controllable along any of them.
    """
    best = max((_reached(model, motion) for motion in _motions(model)), key=lambda each: each.least)
    if best.least < REACH:
        problem = f"cannot be controlled along a motion: no control changes {best.component}"
        expected = "expected a model whose controls, in time, change the pose and every velocity"
        raise InputError([problem_of(model.vehicle, "model", problem, expected, Code.MISMATCH)])


def _motions(model: VehicleModel) -> list[tuple[Matrix, Matrix]]:
    """States (`TESTED`, nx) and controls (`TESTED`, nu) of motions that have begun at the bounds of the controls."""
    found = []
    for corner in itertools.product(*zip(model.low, model.high, strict=True)):
        begun, control = np.zeros(len(model.vehicle.state)), np.array(corner)
        for _ in range(BEGINNING):
            begun = model.advance(begun, control, STEP)
        for share in SHARES:
            held, states = model.clamped(share * np.maximum(np.abs(model.low), np.abs(model.high))), [begun]
            for _ in range(TESTED - 1):
                states.append(model.advance(states[-1], held, STEP))
            found.append((np.array(states), np.tile(held, (TESTED, 1))))
    return found


def _reached(model: VehicleModel, motion: tuple[Matrix, Matrix]) -> _Reached:
    """Controllability of a motion, by its Gramian with controls in shares of their ranges."""
    _, by_state, by_control = model.linearised(*motion, np.full(TESTED, STEP))
    kept = [*model.pose, *model.velocities]
    gramian = np.zeros((len(model.vehicle.state),) * 2)
    for a, b in zip(by_state, by_control * (model.high - model.low), strict=True):
        gramian = a @ gramian @ a.T + b @ b.T
    values, vectors = np.linalg.eigh(gramian[np.ix_(kept, kept)])
    weakest = int(np.abs(vectors[:, 0]).argmax())
    return _Reached(math.sqrt(max(float(values[0]), 0.0)), model.vehicle.state[kept[weakest]])
