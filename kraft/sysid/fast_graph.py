"""The factor graph of the paper in its fast form: steps linearised together, elimination in compiled code."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from kraft.logs.log import Part
from kraft.sysid.chains import whole_segment
from kraft.sysid.elimination import Eliminated, Graph, allocate, back_substitute, eliminate, is_cached
from kraft.sysid.initial_values import smooth_chains
from kraft.sysid.observation import noise_model
from kraft.sysid.optimiser import RhoFactors
from kraft.sysid.parameters import parameters_of
from kraft.sysid.problem import Point, Problem, assemble, starting_point
from kraft.sysid.settings import Noise, Settings
from ompl_ext.arrays import Floats
from ompl_ext.jit import cache_root
from ompl_ext.kernels.specialise import are_steps_cached
from ompl_ext.vehicle import Vehicle


class FastGraph:
    """Linearises a problem at a point, reduces it to rho, and moves the point by a change of rho."""

    def __init__(self, problem: Problem) -> None:
        """Allocate the arrays of the elimination."""
        self.problem = problem
        self._out: Eliminated = allocate(problem.chains, problem.dynamics.nx, len(problem.parameters.names))

    def cost(self, point: Point) -> float:
        """Cost of a point."""
        return self.problem.cost(point)

    def linearise(self, point: Point) -> None:
        """Linearise all factors at a point."""
        p, chains, noise = self.problem, self.problem.chains, self.problem.noise
        x = point.states[chains.state]
        led, jacobian = p.dynamics.linearise(x, point.controls, point.rho, chains.h)
        mean, slopes = p.actuators.mean(point.rho)
        seen = p.at_poses(point.states)
        by_state, by_rho = p.observation.linearise(seen, point.rho)
        residuals = p.observation.residual(seen, point.rho, chains.poses)
        self._point = point
        self._graph = Graph(
            first=chains.first,
            log=chains.log,
            h=chains.h,
            seen=chains.seen,
            share=chains.share,
            dynamics=point.states[chains.state + 1] - led,
            jacobian=jacobian,
            control=point.controls - mean,
            command=slopes,
            pose=residuals,
            pose_state=by_state,
            pose_rho=by_rho,
            weight=noise.weights(residuals),
            pose_information=noise.pose_sigmas**-2.0,
            process=noise.process**2,
            control_variance=noise.control**2,
        )

    def reduce(self, damping: float) -> RhoFactors:
        """Eliminate controls and states; `damping` raises the information of the states by that share."""
        eliminate(self._graph, damping, self._out)
        information, gradient = self._out.information.copy(), self._out.gradient.copy()
        return RhoFactors.with_priors(information, gradient, self.problem, self._point.rho)

    def information_with(self, effects: Floats) -> Floats:
        """Information (logs, np + m, np + m) on rho and on m errors of the controls.

        `effects` (N, nu, m) are those of the errors on the controls of each step.
        """
        size, m = len(self._point.rho), effects.shape[2]
        none = np.zeros((len(self._graph.pose), 3, m))
        graph = self._graph._replace(
            command=np.concatenate([self._graph.command, effects], axis=2),
            pose_rho=np.concatenate([self._graph.pose_rho, none], axis=2),
        )
        out = allocate(self.problem.chains, self.problem.dynamics.nx, size + m)
        eliminate(graph, 0.0, out)
        return out.information

    def moved(self, change: Floats) -> Point:
        """The point that minimises the linearised problem among those whose rho changes by `change`.

        The deviations of controls from commands are kept, not the controls: commands are not linear in a delay.
        """
        states, deviations = np.empty_like(self._point.states), np.empty_like(self._point.controls)
        back_substitute(self._graph, self._out, change, states, deviations)
        rho = self.problem.parameters.within_bounds(self._point.rho + change)
        controls = self.problem.actuators.mean(rho)[0] + self._graph.control + deviations
        return Point(self._point.states + states, controls, rho)


def ensure_compiled(vehicle: Vehicle, reference: str, info: Callable[[str], None]) -> None:
    """Compile the steps of the model and the elimination of the graph, unless their machine code is cached.

    Args:
        vehicle: the vehicle with the model.
        reference: name or file of the vehicle as the user gave it.
        info: receives a message before and after the compilation.
    """
    if are_steps_cached(vehicle) and is_cached():
        return
    info(f"compiling the model of {reference} for identification on this machine: once, about 8 s ...")
    began = time.perf_counter()
    compile_identification(vehicle)
    info(f"compiled in {time.perf_counter() - began:.0f} s; kept in {cache_root()}")


def compile_identification(vehicle: Vehicle) -> None:
    """Make one step of the graph of a short drive: the kernels of identification compile at their first call."""
    settings = Settings()
    times = np.array([0.0, 0.1])
    part = Part(times[:1], np.zeros((1, len(vehicle.controls))), times, np.zeros((2, 3)))
    parameters = parameters_of(vehicle, settings, ())
    noise = noise_model(vehicle, settings, Noise(0.01, 0.01))
    problem = assemble([whole_segment(part, 0, settings.step)], 1, parameters, noise)
    graph = FastGraph(problem)
    graph.linearise(starting_point(problem, smooth_chains(problem.chains), parameters.nominal))
    graph.reduce(0.0)
    graph.moved(np.zeros(len(parameters.names)))
