"""Edges along a path of poses: controls and durations with which a vehicle's model follows it.

The path is cut into pieces that end where the motion is reversed, and there the vehicle is to stop.  Each piece begins
in the state where the one before it ended; Gauss-Newton on its controls and durations makes it end at the pose of the
path, so that errors do not add up.  The result is a guess like edges of an earlier plan: the tree adds it with all of
its checks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ompl_ext.arrays import Bools, Floats, Ints, Matrix
from ompl_ext.kernels.arcs import cross_track
from ompl_ext.kernels.posepath import PosePath
from ompl_ext.kernels.specialise import kernels
from ompl_ext.motion import motion_of
from ompl_ext.moves import Arc, Moves, arcs_of
from ompl_ext.vehicle import Vehicle

PIECE = 0.4  # duration of the pieces that are fitted one after the other (s)
BIN, BRIEF = 0.15, 0.03  # time over which motions of the path are averaged, and the least one where they change (s)
REVERSED = 0.1  # cosine between two velocities of the body below which it stops in between
LONGEST = 0.1  # longest edge (s): short ones need less clearance for the motion between two samples
STEPS = 10  # integration steps for each control
BRAKING, BRAKING_STEPS = 0.02, 60  # step (s) and number of steps of the simulated braking at the end of a piece
ACCURATE = 5e-4  # largest error of a piece below which its fit ends (m)
REST_TIME = 0.1  # factor from a speed at the end of a piece, or one beyond a limit, to an error in m (s)
ITERATIONS, LARGEST_STEP = 12, 0.7  # most iterations of a fit; largest step of a control, as a share of its range
SHORTEST, LONGEST_HELD = 0.01, 2.0  # bounds of the duration of a control in a fit (s)
TIME_RANGE = 0.2  # change of a duration that counts as much as one of a control by its range (s)
TOLERABLE = 0.2  # error at the end of a piece beyond which a path is given up, as a share of the footprint's reach
NEAR = 0.01  # error at the end of a section with which it is taken at speed, as a share of the footprint's reach
DAMPING, MOST_DAMPING = 1e-6, 1.0  # first and least damping of a fit, and the largest (m^2)
PROGRESS = 0.9  # squared errors after a step, over those before it, above which a fit ends
CHANGE = 1e-4  # change of an input in a numeric derivative, as a share of its range
STRAY = 0.01  # allowed deviation of an arc from the path, as a share of the footprint's width, ...
SPARED = 0.2  # ... or of the clearance there, if that is more
ASIDE = 0.3  # weight of errors to the side of an arc on the way, over those of the pose at its end


IsFree = Callable[[Floats, Matrix, Floats, float], bool]
"""Whether edges with controls (n, nu) and durations (n,) from a state are free; they begin at a time (s)."""


class _Piece(NamedTuple):
    """Controls (m, nu) held for `durations` (m,) towards a pose, where the vehicle `stops` with the control `brake`."""

    controls: Matrix
    durations: Floats
    pose: Floats
    stops: bool
    brake: Floats | None
    arc: Arc | None = None  # that it keeps to, if there is one


class _Section(NamedTuple):
    """Motions `first` to `last` of a path between two stops, and the control that brakes at the end."""

    first: int
    last: int
    brake: Floats | None


class PathFollower:
    """Follows paths of poses with a vehicle's model."""

    def __init__(
        self, vehicle: Vehicle, parameters: Floats, is_free: IsFree, clearance: Callable[[float, float, float], float]
    ) -> None:
        """Prepare for a vehicle with `parameters`; `clearance` is at most that of a pose, m."""
        self._is_free, self._clearance = is_free, clearance
        self._kernels, self._motion, self._parameters = kernels(vehicle), motion_of(vehicle), parameters.copy()
        self._twists = self._motion.extreme_twists(vehicle.footprint.reach)[1]
        self._pose = [vehicle.index(name) for name in ("x", "y", "theta")]
        self._rest, self._reach = list(vehicle.rest_indices), vehicle.footprint.reach
        self._width = vehicle.footprint.width
        self._moves = Moves(vehicle, self._motion, self._twists, self._parameters)
        self._limits = [k for k, name in enumerate(vehicle.state) if name in vehicle.limits]
        self._low, self._high = vehicle.state_limits[self._limits].T
        bounds = vehicle.control_bounds
        self._bounds = np.vstack([bounds, (SHORTEST, LONGEST_HELD)])
        self._range = np.append(bounds[:, 1] - bounds[:, 0], TIME_RANGE)

    def has_parameters(self, parameters: Floats) -> bool:
        """Whether it was made with these parameters of the vehicle."""
        return bool(np.array_equal(parameters, self._parameters))

    def edges_along(self, path: PosePath, start: Floats) -> tuple[Matrix, Floats]:
        """Controls (n, nu) and durations (n,) of edges from a state (nx,) along a path, as far as they are free.

        Between two stops the path is followed at speed or, where that is not possible, in moves from standstill to
        standstill.
        """
        state, controls, durations = start, np.zeros((0, len(self._bounds) - 1)), np.zeros(0)
        for section in self._sections(path):
            found = self._section(path, section, state, float(durations.sum()))
            if found is None:
                break
            controls, durations = np.vstack([controls, found[0]]), np.append(durations, found[1])
            state = self._ends(state, np.column_stack(found)[None])[0, -1]
        return controls, durations

    def _section(self, path: PosePath, section: _Section, state: Floats, begin: float) -> tuple[Matrix, Floats] | None:
        """Controls and durations of free edges along a section from a state at `begin` s, None if none were found.

        Those at speed are preferred, unless only moves end near the path's pose.
        """
        end, found, least = _Piece(np.zeros((0, 0)), np.zeros(0), path.poses[section.last], True, None), None, math.inf
        for follow in (self._at_speed, self._in_moves):
            inputs = follow(path, section, state)
            edges = _edges(inputs)
            if len(inputs) == 0 or not self._is_free(state, *edges, begin):
                continue
            error = float(np.abs(self._errors(self._ends(state, inputs[None])[:, -1:], end)).max())
            if error < least:
                found, least = edges, error
            if error <= NEAR * self._reach:
                break
        return found

    def _at_speed(self, path: PosePath, section: _Section, state: Floats) -> Matrix:
        """Controls and durations (m, nu + 1) along a section without a stop before its end, none if it fails."""
        found = []
        for piece in self._pieces(path, section):
            inputs = self._fitted(state, self._with_brake(state, piece))
            states = self._ends(state, inputs[None])
            if np.abs(self._errors(states, piece)).max() > TOLERABLE * self._reach:
                return inputs[:0]
            found.append(inputs)
            state = states[0, -1]
        return np.vstack(found)

    def _in_moves(self, path: PosePath, section: _Section, state: Floats) -> Matrix:
        """Controls and durations (m, nu + 1) along a section with stops where the curvature changes, or none."""
        found = []
        first, last = section.first, section.last
        clearance = np.array([self._clearance(*pose) for pose in path.poses[first : last + 1].tolist()])
        stray = np.maximum(STRAY * self._width, SPARED * clearance)
        for arc in arcs_of(path, first, last, stray, self._reach, len(self._twists)):
            control, seconds = self._moves.settling(state, arc)
            if seconds > 0.0:
                found.append(np.append(control, seconds)[None])
                state = self._ends(state, found[-1][None])[0, -1]
            inputs = self._moves.inputs_for(arc)
            piece = _Piece(inputs[:, :-1], inputs[:, -1], arc.end, True, None, arc)
            inputs = self._fitted(state, piece)
            states = self._ends(state, inputs[None])
            if np.abs(self._errors(states, piece)).max() > TOLERABLE * self._reach:
                return inputs[:0]
            found.append(inputs)
            state = states[0, -1]
        return np.vstack(found)

    def _ends(self, state: Floats, inputs: Floats) -> Floats:
        """States (k, m, nx) after each of the m controls of k motions, `inputs` (k, m, nu + 1), from a state."""
        count, m, _ = inputs.shape
        samples = np.empty((count, STEPS + 1, len(state)))
        samples[:, -1] = state
        found = np.empty((count, m, len(state)))
        for j in range(m):
            samples[:, 0] = samples[:, -1]
            controls = np.ascontiguousarray(inputs[:, j, :-1])
            self._kernels.roll_out(samples, controls, self._parameters, inputs[:, j, -1] / STEPS)
            found[:, j] = samples[:, -1]
        return found

    def _with_brake(self, state: Floats, piece: _Piece) -> _Piece:
        """Piece with the control that brakes at its end, for as long as that slows down."""
        if not piece.stops or piece.brake is None or not self._rest:
            return piece
        inputs = np.column_stack([piece.controls, piece.durations])
        samples = np.empty((1, BRAKING_STEPS + 1, len(state)))
        samples[0, 0] = self._ends(state, inputs[None])[0, -1]
        self._kernels.roll_out(samples, piece.brake[None].copy(), self._parameters, np.array([BRAKING]))
        slowest = 1 + int(np.argmin(np.linalg.norm(samples[0, 1:, self._rest], axis=0)))
        controls, durations = np.vstack([piece.controls, piece.brake]), np.append(piece.durations, BRAKING * slowest)
        return piece._replace(controls=controls, durations=durations)

    def _errors(self, states: Floats, piece: _Piece) -> Matrix:
        """Errors (k, r) of k motions of a piece, m, from the states (k, m, nx) after each control."""
        last = states[:, -1]
        error = last[:, self._pose] - piece.pose
        error[:, 2] = self._reach * (np.mod(error[:, 2] + math.pi, math.tau) - math.pi)
        speed = REST_TIME * last[:, self._rest] if piece.stops else np.zeros((len(last), 0))
        inside = np.clip(states[:, :, self._limits], self._low, self._high)
        beyond = REST_TIME * (states[:, :, self._limits] - inside).reshape(len(last), -1)
        aside = np.zeros((len(last), 0))
        if piece.arc is not None:
            between = np.ascontiguousarray(states[:, :-1, self._pose])
            aside = ASIDE * cross_track(between, piece.arc.begin, piece.arc.screw, self._reach).reshape(len(last), -1)
        return np.hstack([error, speed, beyond, aside])

    def _fitted(self, state: Floats, piece: _Piece) -> Matrix:
        """Controls and durations (m, nu + 1) with which a piece ends as near to its pose as was found."""
        inputs = np.column_stack([piece.controls, piece.durations])
        m, width = inputs.shape
        low, high, span = (np.tile(row, m) for row in (*self._bounds.T, self._range))
        current, damping = np.clip(inputs.ravel(), low, high), DAMPING
        best, errors = current, self._errors(self._ends(state, current.reshape(1, m, width)), piece)[0]
        least = float(np.abs(errors).max())
        for _ in range(ITERATIONS):
            if least < ACCURATE or damping > MOST_DAMPING:
                break
            change = np.where(current + CHANGE * span > high, -CHANGE, CHANGE)
            varied = (current + np.diag(change * span)).reshape(-1, m, width)
            slope = ((self._errors(self._ends(state, varied), piece) - errors) / change[:, None]).T
            while damping <= MOST_DAMPING:
                step = _step(slope, errors, current <= low, current >= high, damping)
                tried = np.clip(current + span * step, low, high)
                found = self._errors(self._ends(state, tried.reshape(1, m, width)), piece)[0]
                if found @ found < errors @ errors:
                    break
                damping *= 10.0
            else:
                break
            slow = found @ found > PROGRESS * (errors @ errors)
            current, errors, damping = tried, found, max(0.1 * damping, DAMPING)
            if float(np.abs(errors).max()) < least:
                best, least = current, float(np.abs(errors).max())
            if slow:
                break
        return best.reshape(m, width)

    def _sections(self, path: PosePath) -> Iterator[_Section]:
        """Sections of a path between the stops where its motion is reversed."""
        velocity = self._motion.twists[self._twists] * (1.0, 1.0, self._reach)
        speed = np.linalg.norm(velocity, axis=1)
        across = velocity @ velocity.T < REVERSED * np.outer(speed, speed)
        turns = [k for k in range(1, len(path.twist)) if across[path.twist[k - 1], path.twist[k]]]
        for first, last in pairwise([0, *turns, len(path.twist)]):
            opposite = int(np.argmin(velocity @ velocity[path.twist[last - 1]]))
            brakes = velocity[opposite] @ velocity[path.twist[last - 1]] < 0.0
            yield _Section(first, last, self._motion.controls[self._twists[opposite]] if brakes else None)

    def _pieces(self, path: PosePath, section: _Section) -> Iterator[_Piece]:
        """Pieces of a section, each of about PIECE s."""
        first, last, brake = section
        for begin, end in pairwise(_cuts(path.times[first:last]) + first):
            numbers, times = path.twist[begin:end], path.times[begin:end]
            held = _averaged(numbers, self._motion.controls[self._twists[numbers]], times)
            yield _Piece(*held, path.poses[end], bool(end == last), brake)


def _edges(inputs: Matrix) -> tuple[Matrix, Floats]:
    """Controls (n, nu) and durations (n,) of edges of at most LONGEST s, from those (m, nu + 1) of longer ones."""
    counts = np.ceil(inputs[:, -1] / LONGEST).astype(int)
    return np.repeat(inputs[:, :-1], counts, axis=0), np.repeat(inputs[:, -1] / counts, counts)


def _step(slope: Matrix, error: Floats, at_low: Bools, at_high: Bools, damping: float) -> Floats:
    """Least change of the inputs, as shares of their ranges, that removes an error; none leaves a bound."""
    step, free = np.zeros(slope.shape[1]), np.ones(slope.shape[1], dtype=bool)
    for _ in range(3):
        part = slope[:, free]
        step[:] = 0.0
        step[free] = -part.T @ np.linalg.solve(part @ part.T + damping * np.eye(len(error)), error)
        leaves = (at_low & (step < 0.0)) | (at_high & (step > 0.0))
        if not leaves.any():
            break
        free &= ~leaves
    return np.clip(step * free, -LARGEST_STEP, LARGEST_STEP)


def _cuts(times: Floats) -> Ints:
    """Indices at which motions between two stops are cut into pieces of equal duration, about PIECE s."""
    ends = np.cumsum(times)
    count = max(1, round(float(ends[-1]) / PIECE))
    inner = np.searchsorted(ends, ends[-1] * np.arange(1, count) / count) + 1
    return np.unique(np.concatenate([[0], inner, [len(times)]]))


def _averaged(numbers: Ints, controls: Matrix, times: Floats) -> tuple[Matrix, Floats]:
    """Controls and durations of fewer motions: averages over equal motions, and over the briefest ones."""
    bins, began = [0], 0.0
    for k in range(1, len(times)):
        lasts = float(times[:k].sum()) - began
        if lasts >= BIN or (lasts >= BRIEF and numbers[k] != numbers[k - 1]):
            bins.append(k)
            began += lasts
    durations = np.add.reduceat(times, bins)
    weighted: Matrix = np.add.reduceat(controls * times[:, None], bins, axis=0)
    return weighted / durations[:, None], durations
