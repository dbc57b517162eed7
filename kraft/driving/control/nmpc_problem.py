"""The nonlinear program of the controller `nmpc`, written with CasADi, and the two solvers that find its optimum.

`sqp` makes Gauss-Newton steps from the first values; PIQP solves their quadratic programs.  `ipopt` is the package of
that name.

Andersson, Gillis, Horn, Rawlings, Diehl: CasADi, 2019.  Waechter, Biegler: On the implementation of an interior-point
filter line-search algorithm for large-scale nonlinear programming, 2006.
Schwan, Jiang, Kuhn, Jones: PIQP, a proximal interior-point quadratic programming solver, 2023.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from kraft.driving.control_settings import Nmpc
from kraft.driving.vehicle_model import VehicleModel
from kraft.errors import Code, InputError, MissingDependency
from kraft.provenance import install_command
from kraft.vehicles.load import problem_of
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.symbolic import NotSymbolicError, symbolic_derivative
from ompl_ext.vehicle import Vehicle

TOLERANCE: Final = 1e-3
"""Relative tolerance of the optimum."""
LEAST_SHARE: Final = 1e-3
"""Least share of a step of `sqp`."""
Optimum = Callable[[Floats, Floats], tuple[Floats, float, bool]]
"""Function of first values and parameters: values and cost of the optimum, and whether it is one."""
Solver = Callable[[], Optimum]
"""Function that makes an optimum function with memory of its own."""
SOLVERS: Final = 8
"""Largest number of solvers that are kept."""
_SOLVERS: Final[dict[Hashable, Solver]] = {}
SOLVED: Final = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
"""IPOPT's words for an optimum."""


@dataclass(frozen=True)
class Solution:
    """States (steps + 1, nx), the first of which is the estimate, and controls (steps, nu) between them.

    `cost` is that of the problem.  If it is not `solved`, the states still follow the model: it is the last solution,
    moved to the time of the estimate (without one, the controls at rest), with the improvements of `sqp` so far.
    """

    states: Matrix
    controls: Matrix
    cost: float
    solved: bool


class NmpcProblem:
    """Nonlinear program of one vehicle, with everything that changes between commands as its parameters."""

    def __init__(self, settings: Nmpc, model: VehicleModel, centres: Matrix) -> None:
        """`centres` (discs, 2) of the discs, in the frame of the body (m).

        The functions of CasADi are made once for the controllers of a process that are alike, as those of its trials
        are: that takes as long as a hundred commands.
        """
        ca, vehicle = casadi_of(), model.vehicle
        self._sizes = len(vehicle.state), len(model.low), settings.steps
        key = (
            settings, vehicle.derivative, vehicle.actuation, vehicle.state, vehicle.rest_indices, model.low.tobytes(),
            model.high.tobytes(), len(model.parameters), centres.tobytes(),
        )  # fmt: skip
        solver = _SOLVERS.get(key)
        if solver is None:
            if len(_SOLVERS) >= SOLVERS:
                _SOLVERS.clear()
            solver = _SOLVERS[key] = self._solver(ca, settings, model, centres)
        self._optimum = solver()

    def _solver(self, ca: Any, settings: Nmpc, model: VehicleModel, centres: Matrix) -> Solver:
        nx, nu, n = self._sizes
        np_ = len(model.parameters)
        step = _runge_kutta(ca, symbolic_derivative_of(model.vehicle), nx, nu, np_, settings.step)
        states, controls, lack = ca.SX.sym("x", nx, n), ca.SX.sym("u", nu, n), ca.SX.sym("s", n)
        start, parameters = ca.SX.sym("x0", nx), ca.SX.sym("p", np_)
        targets, planes, last = ca.SX.sym("r", 4, n), ca.SX.sym("h", 3 * len(centres), n), ca.SX.sym("v", nu)
        planned = ca.SX.sym("c", nu, n)
        weights = np.array([settings.position, math.radians(settings.heading_deg), settings.speed]) ** -2.0
        change = (settings.change * (model.high - model.low)) ** -2.0
        cost, curved, motion, free = 0.0, 0.0, [], []
        for k in range(n):
            after, control = states[:, k], controls[:, k]
            motion.append(after - step(start if k == 0 else states[:, k - 1], control, parameters))
            turned = after[model.theta] - targets[2, k]
            squares = settings.step * weights[0] * ca.sumsqr(after[[model.x, model.y]] - targets[:2, k])
            squares += settings.step * weights[2] * (after[model.v] - targets[3, k]) ** 2
            squares += ca.sum1(change * (control - (last if k == 0 else controls[:, k - 1]) - planned[:, k]) ** 2)
            squares += settings.penalty * (lack[k] + 10.0 * lack[k] ** 2)
            cost += squares + settings.step * weights[1] * (2.0 - 2.0 * ca.cos(turned))
            curved += squares + settings.step * weights[1] * turned**2
            c, s = ca.cos(after[model.theta]), ca.sin(after[model.theta])
            for d, (ahead, aside) in enumerate(centres.tolist()):
                x, y = after[model.x] + ahead * c - aside * s, after[model.y] + ahead * s + aside * c
                free.append(planes[3 * d, k] * x + planes[3 * d + 1, k] * y - planes[3 * d + 2, k] + lack[k])
        variables = ca.vertcat(ca.vec(states), ca.vec(controls), lack)
        given = ca.vertcat(start, parameters, ca.vec(targets), ca.vec(planes), last, ca.vec(planned))
        driven = [start]
        for k in range(n):
            driven.append(step(driven[-1], controls[:, k], parameters))
        moving = ca.vertcat(*driven[1:], ca.vec(controls), ca.DM.zeros(n))
        (clear,) = ca.substitute([ca.vertcat(*free)], [variables], [moving])
        missing = [ca.fmax(0.0, ca.mmax(-each)) for each in ca.vertsplit(clear, len(centres))]
        program = _Program(
            variables, given, cost, curved, ca.vertcat(*motion, *free),
            ca.vertcat(moving[: (nx + nu) * n], *missing),
            np.concatenate([np.full(nx * n, -np.inf), np.tile(model.low, n), np.zeros(n)]),
            np.concatenate([np.full(nx * n, np.inf), np.tile(model.high, n), np.full(n, np.inf)]),
            np.concatenate([np.zeros(nx * n), np.full(len(free), np.inf)]),
        )  # fmt: skip
        return (_ipopt if settings.solver == "ipopt" else _sequential)(ca, program, settings.iterations)

    def solve(
        self, guess: Solution, parameters: Floats, targets: Matrix, planes: Floats, last: Floats, planned: Matrix
    ) -> Solution:
        """Optimum near `guess`, whose states follow the model; `last` (nu,) is the control before.

        `planned` (steps, nu) are the changes of the controls that have no cost.
        """
        nx, nu, n = self._sizes
        values, cost, solved = self._optimum(
            np.concatenate([guess.states[1:].ravel(), guess.controls.ravel(), np.zeros(n)]),
            np.concatenate([guess.states[0], parameters, targets.ravel(), planes.ravel(), last, planned.ravel()]),
        )
        states = np.concatenate([guess.states[0], values[: nx * n]]).reshape(n + 1, nx)
        return Solution(states, values[nx * n : (nx + nu) * n].reshape(n, nu), cost, solved)


@dataclass(frozen=True)
class _Program:
    """Nonlinear program: least `cost` over `variables` within `low` and `high`, `rows` from 0 to `most`.

    `given` are the parameters.  `curved` is quadratic and has the second derivatives of `cost`, or larger ones.
    `driven` are the variables whose states follow the model under the controls, with the least lack of clearance.
    """

    variables: Any
    given: Any
    cost: Any
    curved: Any
    rows: Any
    driven: Any
    low: Floats
    high: Floats
    most: Floats


def _ipopt(ca: Any, program: _Program, iterations: int) -> Solver:
    options = {
        "ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes", "ipopt.tol": TOLERANCE,
        "ipopt.max_iter": iterations, "ipopt.mu_init": 1e-2, "ipopt.acceptable_tol": 10.0 * TOLERANCE,
        "ipopt.acceptable_iter": 3,
    }  # fmt: skip
    content = {"x": program.variables, "f": program.cost, "g": program.rows, "p": program.given}
    bounds = {"lbx": program.low, "ubx": program.high, "lbg": np.zeros(len(program.most)), "ubg": program.most}

    def make() -> Optimum:
        solver = ca.nlpsol("nmpc", "ipopt", content, options)

        def optimum(first: Floats, given: Floats) -> tuple[Floats, float, bool]:
            found = solver(x0=first, p=given, **bounds)
            if solver.stats()["return_status"] not in SOLVED:
                return first, math.inf, False
            return np.asarray(found["x"]).ravel(), float(found["f"]), True

        return optimum

    return make


def _sequential(ca: Any, program: _Program, iterations: int) -> Solver:
    """Gauss-Newton steps, each halved until the cost of what the vehicle then drives is lower.

    The optimum is found if no step promises a lower cost, or a full one lowers it as the quadratic program predicts.
    """
    x, p, low, high = program.variables, program.given, program.low, program.high
    (cost,) = ca.substitute([program.cost], [x], [program.driven])
    shared = {"cse": True}  # what occurs several times is computed once, with the same result
    driving = ca.Function("drive", [x, p], [program.driven, cost], shared)
    curvature = ca.DM(ca.hessian(program.curved, x)[0])
    slopes = [program.rows, ca.gradient(program.cost, x), ca.jacobian(program.rows, x)]
    linear = ca.Function("linear", [x, p], slopes, shared)
    matrices = {"h": curvature.sparsity(), "a": linear.sparsity_out(2)}
    quadratic = ca.conic("quadratic", "piqp", matrices, {"error_on_fail": False})
    now, given = ca.MX.sym("x", x.numel()), ca.MX.sym("p", p.numel())
    rows, gradient, jacobian = linear(now, given)
    bounds = {"lbx": low - now, "ubx": high - now, "lba": -rows, "uba": program.most - rows}
    step = quadratic(h=curvature, g=gradient, a=jacobian, **bounds)
    descending = ca.Function("descent", [now, given], [step["x"], step["cost"]])
    return lambda: _sequence(_Buffered(driving), _Buffered(descending), iterations)


def _sequence(drive: _Buffered, descent: _Buffered, iterations: int) -> Optimum:
    def optimum(first: Floats, given: Floats) -> tuple[Floats, float, bool]:
        values, cost = drive(first, given)
        for _ in range(iterations):
            change, predicted = descent(values, given)
            if not descent.succeeded:
                break
            if -predicted <= TOLERANCE * (1.0 + cost):
                return values, cost, True
            share = 1.0
            following, lower = drive(values + change, given)
            while not lower <= cost and share > LEAST_SHARE:
                share *= 0.5
                following, lower = drive(values + share * change, given)
            if not lower <= cost:
                break
            error = abs(cost + predicted - lower)
            values, cost = following, lower
            if share == 1.0 and error <= TOLERANCE * (1.0 + cost):
                return values, cost, True
        return values, cost, False

    return optimum


class _Buffered:
    """CasADi function of two vectors with two results, a vector and a number, called without conversions."""

    def __init__(self, function: Any) -> None:
        self._buffer, self._run = function.buffer()
        self._arguments: list[Floats] = [np.empty(function.numel_in(k)) for k in range(2)]
        self._results: list[Floats] = [np.empty(function.numel_out(k)) for k in range(2)]
        for k, array in enumerate(self._arguments):
            self._buffer.set_arg(k, array.data)
        for k, array in enumerate(self._results):
            self._buffer.set_res(k, array.data)

    def __call__(self, values: Floats, given: Floats) -> tuple[Floats, float]:
        self._arguments[0][:], self._arguments[1][:] = values, given
        self._run()
        return self._results[0].copy(), float(self._results[1][0])

    @property
    def succeeded(self) -> bool:
        """Whether the solver in the function was successful the last time."""
        return bool(self._buffer.stats()["success"])


def _runge_kutta(ca: Any, derivative: Any, nx: int, nu: int, np_: int, h: float) -> Any:
    """CasADi function of state, control and parameters: state after a step of `h` s."""
    x, u, p = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("p", np_)

    def rate(state: Any) -> Any:
        return derivative(state, u, p)

    one = rate(x)
    two = rate(x + 0.5 * h * one)
    three = rate(x + 0.5 * h * two)
    four = rate(x + h * three)
    after = x + h / 6.0 * (one + 2.0 * two + 2.0 * three + four)
    return ca.Function("step", [x, u, p], [after])


def casadi_of() -> Any:
    """The package CasADi.

    Raises:
        MissingDependency: if it is not installed, or has no PIQP, which came with version 3.8.
    """
    try:
        import casadi
    except ImportError as error:
        raise MissingDependency(f"controller: nmpc needs casadi: {install_command('mpc')}") from error
    if not casadi.has_conic("piqp"):
        raise MissingDependency(f"controller: nmpc needs casadi with PIQP: {install_command('mpc')}")
    return casadi


def symbolic_derivative_of(vehicle: Vehicle) -> Callable[[Any, Any, Any], Any]:
    """Function of state (nx), control (nu) and parameters (np), all CasADi symbols, that returns dx/dt.

    Raises:
        MissingDependency: if CasADi is missing.
        InputError: if a function of the vehicle has no source, or branches by statements.
    """
    try:
        return symbolic_derivative(vehicle, casadi_of())
    except NotSymbolicError as error:
        problem = f"cannot be written as an expression, which nmpc needs: {str(error).splitlines()[0]}"
        expected = "expected a derivative in a file, without `if` and `while` statements on its arguments"
        raise InputError([problem_of(vehicle, "model", problem, expected, Code.MISMATCH)]) from None
