"""Make the problem of some stretches, and a point to start from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kraft.sysid.chains import Chains, Stretch, chains_of
from kraft.sysid.commands import Commands
from kraft.sysid.dynamics import Dynamics
from kraft.sysid.noise_model import NoiseModel
from kraft.sysid.observation import Observation
from kraft.sysid.parameters import Parameters
from kraft.sysid.problem import Point, Problem
from kraft.sysid.start import Smooth, first_states
from ompl_ext.arrays import Floats, Matrix


def assemble(stretches: Sequence[Stretch], logs: int, parameters: Parameters, noise: NoiseModel) -> Problem:
    """The least-squares problem of stretches of `logs` logs."""
    return Problem(
        parameters,
        chains_of(stretches, logs),
        Commands(stretches, parameters),
        Dynamics(parameters),
        Observation(parameters),
        noise,
    )


def starting_point(problem: Problem, data: Smooth, rho: Floats) -> Point:
    """Poses as smoothed, what poses do not show as simulated with the parameters rho, controls as commanded."""
    controls = problem.commands.mean(rho)[0]
    states = simulated(problem, first_states(problem.parameters.vehicle, problem.chains, data), controls, rho)
    for k, name in enumerate(("x", "y", "theta")):
        if name in problem.parameters.vehicle.state:
            states[:, problem.parameters.vehicle.index(name)] = data.poses[:, k]
    return Point(states, controls, rho.copy())


def simulated(problem: Problem, start: Matrix, controls: Matrix, rho: Floats) -> Matrix:
    """States (S, nx) of all chains, open loop from `start` (chains, nx) with `controls` (N, nu)."""
    chains = problem.chains
    steps = np.diff(chains.first) - 1
    padded = np.zeros((int(steps.max()), len(steps), controls.shape[1]))
    for c, count in enumerate(steps):
        begin = int(chains.first[c]) - c  # of its steps
        padded[:count, c] = controls[begin : begin + count]
    h = np.array([s.h for s in chains.stretches])
    states = problem.dynamics.simulate(start, padded, rho, h)
    return _stacked(states, chains)


def _stacked(states: Floats, chains: Chains) -> Matrix:
    """(S, nx) of states (most steps + 1, chains, nx)."""
    stacked: Matrix = np.concatenate([states[: s.steps + 1, c] for c, s in enumerate(chains.stretches)])
    return stacked
