"""Turn the end of an optimisation into plain data."""

from __future__ import annotations

import numpy as np

from kraft.sysid.axle import ahead_of_axle
from kraft.sysid.checks import Case, at_bound, unidentified
from kraft.sysid.result import Estimated, Identification, LogFit, PartFit
from ompl_ext.arrays import Floats


def identification(case: Case, warnings: tuple[str, ...], notes: tuple[str, ...]) -> Identification:
    """The result."""
    p, noise = case.problem.parameters, case.problem.noise
    vehicle, rho = p.vehicle, case.optimum.point.rho
    axle = ahead_of_axle(p, case.problem.dynamics.motion, rho)
    lever = float(rho[k]) if (k := p.extra("lever")) >= 0 else 0.0
    return Identification(
        model=vehicle.name,
        parameters=_estimated(case),
        extras=p.extras,
        names=tuple(case.names),
        covariance=case.uncertain.covariance,
        interval=case.uncertain.kind,
        graph_covariance=case.uncertain.graph,
        unidentified=unidentified(case),
        converged=case.optimum.converged,
        iterations=case.iterations,
        cost=case.optimum.cost,
        noise=noise.noise,
        noise_measured=case.noise_measured,
        process={name: float(value) for name, value in zip(vehicle.state, noise.process, strict=True)},
        warnings=warnings,
        notes=notes,
        logs=_log_fits(case),
        rear_axle=None if axle is None else axle + lever,
    )


def _estimated(case: Case) -> dict[str, Estimated]:
    p, rho = case.problem.parameters, case.optimum.point.rho
    std: Floats = np.zeros(len(rho))
    std[p.free] = case.uncertain.std
    half, bounds = case.uncertain.quantile * std, at_bound(case)
    return {
        number.name: Estimated(
            value=float(rho[k]),
            std=float(std[k]),
            ci95=(max(float(rho[k] - half[k]), number.min), min(float(rho[k] + half[k]), number.max)),
            unit=number.unit,
            description=number.description,
            initial=number.value,
            min=number.min,
            max=number.max,
            frozen=not p.free[k],
            at_bound=number.name in bounds,
        )
        for k, number in enumerate(p.numbers)
    }


def _log_fits(case: Case) -> tuple[LogFit, ...]:
    problem, point, chains = case.problem, case.optimum.point, case.problem.chains
    fitted = problem.observation.predict(problem.between(point.states), point.rho)
    weights = problem.noise.weights(problem.pose_residuals(point))
    parts: list[list[PartFit]] = [[] for _ in case.logs]
    step, pose = 0, 0
    for c, stretch in enumerate(chains.stretches):
        count = len(stretch.part.pose_times[stretch.poses])
        parts[stretch.log].append(
            PartFit(
                times=stretch.times,
                states=point.states[chains.first[c] : chains.first[c + 1]],
                controls=point.controls[step : step + stretch.steps],
                pose_times=stretch.part.pose_times[stretch.poses],
                poses=stretch.part.poses[stretch.poses],
                fitted=fitted[pose : pose + count],
                weights=weights[pose : pose + count],
            )
        )
        step, pose = step + stretch.steps, pose + count
    return tuple(LogFit(name, tuple(found)) for name, found in zip(case.logs, parts, strict=True))
