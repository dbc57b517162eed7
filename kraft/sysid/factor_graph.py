"""The factor graph of the paper (Sec. IV-A) in two forms: fast, and with every factor explicit for comparison.

The fast form linearises all steps together and eliminates states and controls in compiled code.

The explicit form has the variables of the paper: states x_k, applied controls u_k, and the parameters rho.  Its factors
are a prior on each control at the command of its step, dynamics between neighbouring states, and an observation between
the two states before and after a pose; and, unlike the paper's, a prior on rho.  The dynamics are RK4 steps instead of
the Euler steps of Eq. 1b.  GTSAM linearises and eliminates; there is one graph per log, because the
sandwich covariance needs the information of each log on rho.  A CustomFactor must fill every H it is given, with the
right shape, and must never return a NaN: GTSAM does not check.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from kraft.elapsed import elapsed_time
from kraft.errors import Defect
from kraft.logs.log import Part
from kraft.sysid.chains import whole_segment
from kraft.sysid.elimination import Eliminated, Graph, allocate, back_substitute, eliminate, is_cached
from kraft.sysid.initial_values import smooth_chains
from kraft.sysid.interface import Noise, Settings
from kraft.sysid.optimiser import RHO, RhoFactors
from kraft.sysid.parameters import parameters_of
from kraft.sysid.problem import NoiseModel, Point, Problem, assemble, noise_model, starting_point
from kraft.text import MessageSink
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.kernel_cache import where_kept
from ompl_ext.kernels.specialise import are_steps_cached
from ompl_ext.vehicle import Vehicle


@dataclass(frozen=True, eq=False)
class MotionFactor:
    """Quadratic cost of a part of the motion: number of its poses, gradient (np,) and information (np, np) by rho."""

    poses: int
    gradient: Floats
    information: Matrix


class FastGraph:
    """Linearises a problem at a point, reduces it to rho, and moves the point by a change of rho."""

    def __init__(self, problem: Problem) -> None:
        """Allocate the arrays of the elimination."""
        self.problem = problem
        self._out = self._allocated(len(problem.parameters.names))

    def _allocated(self, size: int) -> Eliminated:
        """Arrays for the elimination onto `size` parameters."""
        chains = self.problem.chains
        return allocate(len(chains.h), chains.states, chains.logs, self.problem.dynamics.nx, size)

    @property
    def pose_residuals(self) -> Matrix:
        """Those of the problem (n, 3) at the point of the last linearisation."""
        return self._graph.pose

    def cost(self, point: Point) -> float:
        """Cost of a point."""
        return self.problem.cost(point)

    def linearise(self, point: Point) -> float:
        """Linearise all factors at a point; returns its cost."""
        p, chains, noise = self.problem, self.problem.chains, self.problem.noise
        x = point.states[chains.state]
        led, jacobian = p.dynamics.linearise(x, point.controls, point.rho, chains.h)
        mean, slopes = p.actuators.mean(point.rho)
        residuals, by_state, by_rho = p.linearised_poses(point)
        distance = noise.distance(residuals)
        self.point = point
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
            weight=noise.weights(distance),
            pose_information=noise.pose_sigmas**-2.0,
            process=noise.process**2,
            control_variance=noise.control**2,
            start=np.zeros(len(noise.process)),
        )
        return p.cost_of(self._graph.dynamics, self._graph.control, distance, point.rho)

    def reduce(self, damping: float) -> RhoFactors:
        """Eliminate controls and states; `damping` raises the information of the states by that share."""
        eliminate(self._graph, damping, self._out)
        information, gradient = self._out.information.copy(), self._out.gradient.copy()
        return RhoFactors.with_priors(information, gradient, self.problem, self.point.rho)

    def information_with(self, effects: Floats, start: Floats) -> Floats:
        """Information (logs, np + m, np + m) on rho and on m errors of the controls.

        `effects` (N, nu, m) are those of the errors on the controls of each step, `start` (nx,) is the information on
        the first state of each chain.
        """
        size, m = len(self.point.rho), effects.shape[2]
        none = np.zeros((len(self._graph.pose), 3, m))
        graph = self._graph._replace(
            command=np.concatenate([self._graph.command, effects], axis=2),
            pose_rho=np.concatenate([self._graph.pose_rho, none], axis=2),
            start=start,
        )
        out = self._allocated(size + m)
        eliminate(graph, 0.0, out)
        return out.information

    def since(self, begin: float, noise: NoiseModel) -> MotionFactor:
        """What the motion since `begin` (s) alone tells about rho at the point of the last linearisation.

        The state in which it begins is free; poses have another `noise`.
        """
        chains, graph = self.problem.chains, self._graph
        times = [segment.times for segment in chains.segments]
        c = sum(float(each[-2]) < begin for each in times)  # chains that end before
        if c == len(times):
            return MotionFactor(0, np.zeros_like(self.point.rho), np.zeros(2 * self.point.rho.shape))
        state = int(chains.first[c] + np.searchsorted(times[c], begin))
        step = state - c  # each chain before has one state more than steps
        pose = int(chains.seen[step])
        residuals = graph.pose[pose:]
        newest = graph._replace(
            first=np.maximum(chains.first[c:] - state, 0), log=np.zeros(len(times) - c, dtype=np.int64),
            h=graph.h[step:], seen=graph.seen[step:] - pose, share=graph.share[pose:],
            dynamics=graph.dynamics[step:], jacobian=graph.jacobian[step:],
            control=graph.control[step:], command=graph.command[step:],
            pose=residuals, pose_state=graph.pose_state[pose:], pose_rho=graph.pose_rho[pose:],
            weight=noise.weights(noise.distance(residuals)), pose_information=noise.pose_sigmas**-2.0,
        )  # fmt: skip
        out = allocate(len(newest.h), int(newest.first[-1]), 1, self.problem.dynamics.nx, len(self.point.rho))
        eliminate(newest, 0.0, out)
        return MotionFactor(len(residuals), out.gradient[0], out.information[0])

    def moved(self, change: Floats) -> Point:
        """The point that minimises the linearised problem among those whose rho changes by `change`.

        The deviations of controls from commands are kept, not the controls: commands are not linear in a delay.
        """
        states, deviations = np.empty_like(self.point.states), np.empty_like(self.point.controls)
        back_substitute(self._graph, self._out, change, states, deviations)
        rho = self.problem.parameters.within_bounds(self.point.rho + change)
        controls = self.problem.actuators.mean(rho)[0] + self._graph.control + deviations
        return Point(self.point.states + states, controls, rho)


def ensure_identification_compiled(vehicle: Vehicle, reference: str, info: MessageSink) -> None:
    """Compile the steps of the model and the elimination of the graph, unless their machine code is cached.

    Args:
        vehicle: the vehicle with the model.
        reference: name or file of the vehicle as the user gave it.
        info: receives messages before, during and after the compilation.
    """
    if are_steps_cached(vehicle) and is_cached():
        return
    info(f"compiling the model of {reference} for identification on this machine, once ...")
    began = time.perf_counter()
    with elapsed_time(info, f"compiling the model of {reference}"):
        compile_identification(vehicle)
    info(f"compiled in {time.perf_counter() - began:.0f} s; kept in {where_kept()}")


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


Jacobians = list[Matrix] | None
Evaluate = Callable[[list[Floats]], tuple[Floats, list[Matrix]]]


class PaperGraph:
    """Linearises a problem, reduces it to rho, and moves the point by a change of rho, as `FastGraph` does."""

    def __init__(self, problem: Problem) -> None:
        """Make all nonlinear factors."""
        self.problem = problem
        chains = problem.chains
        self._graphs = [gtsam.NonlinearFactorGraph() for _ in range(chains.logs)]
        self._orderings = [gtsam.Ordering() for _ in range(chains.logs)]
        for c, log in enumerate(chains.log):
            for s in range(int(chains.first[c]), int(chains.first[c + 1])):
                if s < chains.first[c + 1] - 1:
                    self._add_step(self._graphs[log], s - c, s)
                    self._orderings[log].push_back(_u(s - c))
                self._orderings[log].push_back(_x(s))

    def cost(self, point: Point) -> float:
        """Cost of a point: all factors of GTSAM, and the priors on rho."""
        values = self._values(point)
        priors = 0.5 * float(np.sum(self.problem.prior_residuals(point.rho) ** 2))
        return priors + sum(graph.error(values) for graph in self._graphs)

    def linearise(self, point: Point) -> float:
        """Linearise all factors at a point; returns its cost."""
        self.point = point
        values = self._values(point)
        self._linear = [graph.linearize(values) for graph in self._graphs]
        return self.cost(point)

    def reduce(self, damping: float) -> RhoFactors:
        """Eliminate controls and states of each log; `damping` is not used, only rho is damped later."""
        del damping
        size = len(self.problem.parameters.names)
        information, gradient = np.zeros((len(self._linear), size, size)), np.zeros((len(self._linear), size))
        self._nets = []
        for log, (linear, ordering) in enumerate(zip(self._linear, self._orderings, strict=True)):
            net, rest = linear.eliminatePartialSequential(ordering)
            matrix, vector = rest.hessian()
            information[log], gradient[log] = matrix, -vector
            self._nets.append(net)
        return RhoFactors.with_priors(information, gradient, self.problem, self.point.rho)

    def moved(self, change: Floats) -> Point:
        """The point that minimises the linearised problem among those whose rho changes by `change`."""
        given = gtsam.VectorValues()
        given.insert(RHO, change)
        states, controls = self.point.states.copy(), self.point.controls.copy()
        chains = self.problem.chains
        solutions = [net.optimize(given) for net in self._nets]
        for c, log in enumerate(chains.log):
            for s in range(int(chains.first[c]), int(chains.first[c + 1])):
                states[s] += solutions[log].at(_x(s))
                if s < chains.first[c + 1] - 1:
                    controls[s - c] += solutions[log].at(_u(s - c))
        rho = self.problem.parameters.within_bounds(self.point.rho + change)
        mean = self.problem.actuators.mean
        before, slopes = mean(self.point.rho)
        bend = mean(rho)[0] - before - slopes @ change  # commands are not linear in a delay
        return Point(states, controls + bend, rho)

    def _add_step(self, graph: gtsam.NonlinearFactorGraph, i: int, s: int) -> None:
        """Add the control's prior, the dynamics, and the poses of step i, from state s."""
        noise, chains = self.problem.noise, self.problem.chains
        diagonal = gtsam.noiseModel.Diagonal.Sigmas
        _add(graph, diagonal(noise.control), [_u(i), RHO], self._control(i))
        sigmas = noise.process * np.sqrt(chains.h[i])
        _add(graph, diagonal(sigmas), [_x(s), _u(i), _x(s + 1), RHO], self._dynamics(i))
        seen: gtsam.noiseModel.Base = diagonal(noise.pose_sigmas)
        if noise.robust:
            huber = gtsam.noiseModel.mEstimator.Huber.Create(noise.threshold)
            seen = gtsam.noiseModel.Robust.Create(huber, seen)
        for j in range(int(chains.seen[i]), int(chains.seen[i + 1])):
            _add(graph, seen, [_x(s), _x(s + 1), RHO], self._pose(j))

    def _control(self, i: int) -> Evaluate:
        def evaluate(given: list[Floats]) -> tuple[Floats, list[Matrix]]:
            control, rho = given
            means, slopes = self.problem.actuators.mean(rho)
            return control - means[i], [np.eye(len(control)), -slopes[i]]

        return evaluate

    def _dynamics(self, i: int) -> Evaluate:
        dynamics, h = self.problem.dynamics, self.problem.chains.h[i : i + 1]

        def evaluate(given: list[Floats]) -> tuple[Floats, list[Matrix]]:
            x, u, after, rho = given
            led, jacobian = dynamics.linearise(x[None].copy(), u[None].copy(), rho, h)
            by_x, by_u, by_rho = np.split(jacobian[0], [dynamics.nx, dynamics.nx + dynamics.nu], axis=1)
            return after - led[0], [-by_x, -by_u, np.eye(dynamics.nx), -by_rho]

        return evaluate

    def _pose(self, j: int) -> Evaluate:
        observation, share = self.problem.observation, float(self.problem.chains.share[j])
        pose, frames = self.problem.chains.poses[j], self.problem.frames
        frame = np.eye(len(pose)) if frames is None else frames[j]

        def evaluate(given: list[Floats]) -> tuple[Floats, list[Matrix]]:
            before, after, rho = given
            state = ((1.0 - share) * before + share * after)[None]
            predicted, by_state, by_rho = observation.linearise(state, rho)
            residual = observation.residual(predicted, pose[None])[0]
            slope = frame @ by_state[0]
            return frame @ residual, [(1.0 - share) * slope, share * slope, frame @ by_rho[0]]

        return evaluate

    def _values(self, point: Point) -> gtsam.Values:
        values = gtsam.Values()
        for s, state in enumerate(point.states):
            values.insert(_x(s), state)
        for i, control in enumerate(point.controls):
            values.insert(_u(i), control)
        values.insert(RHO, point.rho)
        return values


def _x(s: int) -> int:
    key: int = gtsam.symbol("x", s)
    return key


def _u(i: int) -> int:
    key: int = gtsam.symbol("u", i)
    return key


def _add(graph: gtsam.NonlinearFactorGraph, noise: gtsam.noiseModel.Base, keys: list[int], evaluate: Evaluate) -> None:
    """Add a factor whose residual and derivatives `evaluate` gives for the values of its keys."""

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: Jacobians) -> Floats:
        del factor
        residual, derivatives = evaluate([values.atVector(key) for key in keys])
        if not np.isfinite(residual).all() or len(derivatives) != len(keys):
            raise Defect("a factor's residual is not finite, or lacks a derivative")
        if jacobians is not None:
            for k, derivative in enumerate(derivatives):
                jacobians[k] = np.asfortranarray(derivative)
        return residual

    graph.add(gtsam.CustomFactor(noise, keys, error))
