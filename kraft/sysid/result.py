"""Result of an identification from its solved problem."""

from __future__ import annotations

import numpy as np

from kraft.sysid.checks import SolvedProblem, at_bound, notes_of, unidentified
from kraft.sysid.dynamics import DiscreteModel
from kraft.sysid.interface import Identification, LogFit, ParameterEstimate, PartFit
from kraft.sysid.parameters import Parameters
from ompl_ext.arrays import Floats

TURN_SECONDS, TURN_STEP = 3.0, 0.02
"""Duration of a simulated turn, and its steps, s."""
TURN_STEERING_SHARE = 0.1
"""Steering of the simulated turn, as a share of the full steering."""


def tracked_ahead_of_axle(parameters: Parameters, discrete_model: DiscreteModel, rho: Floats) -> float | None:
    """Distance of the tracked point ahead of the rear axle, m; None for a vehicle without steering."""
    lever = float(rho[k]) if (k := parameters.index("lever")) >= 0 else 0.0
    if "lever" in parameters.vehicle.parameters:  # of the models with terms; that of a car is from its rear axle
        return lever if "steering" in parameters.vehicle.controls else None
    axle = ahead_of_axle(parameters, discrete_model, rho)
    return None if axle is None else axle + lever


def ahead_of_axle(parameters: Parameters, discrete_model: DiscreteModel, rho: Floats) -> float | None:
    """Distance of the model's point ahead of its rear axle, m; None for a vehicle without steering.

    In a steady turn a point b ahead of the axle moves sideways with b times the turning rate.
    """
    vehicle = parameters.vehicle
    controls = list(vehicle.controls)
    if "steering" not in controls or vehicle.index("theta") < 0:
        return None
    control = np.maximum(vehicle.control_bounds[:, 1], 0.0)
    control[controls.index("steering")] *= TURN_STEERING_SHARE
    steps = round(TURN_SECONDS / TURN_STEP)
    states = discrete_model.simulate(
        np.zeros((1, discrete_model.nx)),
        np.tile(control, (steps, 1, 1)),
        parameters.model_values(rho)[None],
        np.array([TURN_STEP]),
    )[-2:, 0]
    dx, dy, turn = np.diff(states, axis=0)[0][[vehicle.index(name) for name in ("x", "y", "theta")]]
    middle = states[0, vehicle.index("theta")] + 0.5 * turn
    sideways = dy * np.cos(middle) - dx * np.sin(middle)
    return float(sideways / turn) if abs(turn) > 1e-6 else None


def assemble_identification(
    solution: SolvedProblem, warnings: tuple[str, ...], notes: tuple[str, ...]
) -> Identification:
    """The result of an identification."""
    p, noise = solution.problem.parameters, solution.problem.noise
    vehicle, rho = p.vehicle, solution.optimum.point.rho
    return Identification(
        model=vehicle.name,
        parameters=_estimated(solution),
        auxiliary=p.auxiliary,
        names=solution.names,
        covariance=solution.uncertainty.covariance,
        interval=solution.uncertainty.kind,
        graph_covariance=solution.uncertainty.graph,
        unidentified=unidentified(solution),
        converged=solution.optimum.converged,
        iterations=solution.iterations,
        cost=solution.optimum.cost,
        noise=noise.noise,
        noise_measured=solution.noise_measured,
        process={name: float(value) for name, value in zip(vehicle.state, noise.process, strict=True)},
        warnings=warnings,
        notes=(*notes, *notes_of(solution)),
        logs=_log_fits(solution),
        rear_axle=tracked_ahead_of_axle(p, solution.problem.dynamics.discrete_model, rho),
        without_log=_without_log(solution),
    )


def _without_log(solution: SolvedProblem) -> tuple[dict[str, float], ...]:
    p, shifts = solution.problem.parameters, solution.uncertainty.shifts
    if len(shifts) != len(solution.logs) or len(shifts) < 2:
        return ()
    rhos = np.tile(solution.optimum.point.rho, (len(shifts), 1))
    rhos[:, p.free] += shifts
    return tuple(dict(zip(p.names, map(float, p.within_bounds(rho)), strict=True)) for rho in rhos)


def _estimated(solution: SolvedProblem) -> dict[str, ParameterEstimate]:
    p, rho = solution.problem.parameters, solution.optimum.point.rho
    std: Floats = np.zeros(len(rho))
    std[p.free] = solution.uncertainty.std
    half, bounds = solution.uncertainty.quantile * std, at_bound(solution)
    return {
        spec.name: ParameterEstimate(
            value=float(rho[k]),
            std=float(std[k]),
            ci95=(max(float(rho[k] - half[k]), spec.min), min(float(rho[k] + half[k]), spec.max)),
            unit=spec.unit,
            description=spec.description,
            initial=spec.value,
            min=spec.min,
            max=spec.max,
            frozen=not p.free[k],
            at_bound=spec.name in bounds,
        )
        for k, spec in enumerate(p.specs)
    }


def _log_fits(solution: SolvedProblem) -> tuple[LogFit, ...]:
    problem, point, chains = solution.problem, solution.optimum.point, solution.problem.chains
    fitted = problem.observation.predict(problem.at_poses(point.states), point.rho)
    weights = problem.noise.weights(problem.noise.distance(problem.pose_residuals(point)))
    parts: list[list[PartFit]] = [[] for _ in solution.logs]
    step, pose = 0, 0
    for c, segment in enumerate(chains.segments):
        count = len(segment.part.pose_times[segment.poses])
        parts[segment.log].append(
            PartFit(
                times=segment.times,
                states=point.states[chains.first[c] : chains.first[c + 1]],
                controls=point.controls[step : step + segment.steps],
                pose_times=segment.part.pose_times[segment.poses],
                poses=segment.part.poses[segment.poses],
                fitted=fitted[pose : pose + count],
                weights=weights[pose : pose + count],
            )
        )
        step, pose = step + segment.steps, pose + count
    return tuple(LogFit(name, tuple(found)) for name, found in zip(solution.logs, parts, strict=True))
