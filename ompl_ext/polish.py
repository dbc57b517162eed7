"""Local optimisation of a plan: controls and durations of short intervals, by Gauss-Newton with multiple shooting.

States, controls and durations are improved together, so that the first guess need not obey the model (Giftthaler et
al., A family of iterative Gauss-Newton shooting methods for nonlinear optimal control, 2018).  The time and the changes
of the controls are minimised; clearance, limits of the state and the goal region are penalised where they are violated;
controls and durations have bounds.  The model is soft at first, and becomes harder from round to round.

Changes of controls count nearly in proportion to their size: squares would spread a turn over its whole length, with a
peak in the middle, where a constant curvature changes the steering least.

Then the edges are followed with the tree's own propagation and checks.  Where they lack clearance, because the checks
allow for the motion between samples and for the cells of the field, more is asked for, and the last round is repeated.
What passes may take a little longer if its controls then change less: their changes cost more as long as the plan takes
less time than that.  The result is added to the tree like the edges of an earlier plan, with all checks once more.

The kernels are in `kernels/gauss_newton.py` and `kernels/riccati.py`; here are the rounds and their steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ompl_ext.arrays import Floats, Matrix
from ompl_ext.interpolation import interpolated_rows
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels import trajectory_types as st
from ompl_ext.kernels.functions import INTERVALS
from ompl_ext.kernels.kernel_types import Problem
from ompl_ext.kernels.penetration import fill_penetration
from ompl_ext.kernels.posepath import PosePath
from ompl_ext.kernels.specialise import polish_kernels
from ompl_ext.motion import motion_of
from ompl_ext.obstacles import Workspace
from ompl_ext.poses import pose_of
from ompl_ext.problem import lanes_of, pose_cost_to_go_of
from ompl_ext.query import Goal, Settings
from ompl_ext.vehicle import Vehicle

INTERVAL = 0.1  # longest interval of a guess (s), ...
STRIDE = 0.35  # ... and longest way in it at the top speed, in lengths of the footprint
MOST_INTERVALS = 300  # most intervals of a guess; longer plans have longer intervals
RANGE = (0.2, 2.0)  # shortest and longest interval after an improvement, as multiples of those of the guess
CAREFULLY = 1.2  # durations of a guess along a path of poses over those at constant speed: it has to accelerate
HARD = 1e6  # last stiffness of the model
INSIDE, NEAR_BORDER = 0.6, 1e-3  # share of the goal's tolerances that is aimed for; least distance from its border (m)
LAST_TRIALS = 20  # most steps of a last round
REPLAYS = 10  # most last rounds, each with more clearance than the one before
CONVERGED = 1e-4  # share of the trajectory's time that a step must save, or else a round ends
ROUNDING = 1e-6  # share of a time step by which a trajectory may exceed a multiple of it
DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-6, 1e8  # Levenberg's damping of the steps: first, and its bounds
TRUST = 3.0  # damping of the states over that of the controls
SMOOTHING_STEPS, SMOOTHING_TRIALS = 8, 14  # steps after which smoothing ends, refused ones not counted, and all of them
ENOUGH_LONGER, MOST_LONGER = 1.3, 3.0  # largest extra time over the wanted one: when smoothing ends, and of its result
SMOOTHER, LEAST_SMOOTHER, MOST_SMOOTHER = 2.0, 1.0, 8.0  # factor on the weight of changes in smoothing: first, bounds
SMOOTHER_STEP = 1.3  # change of that factor from one step to the next


class Smoothness(NamedTuple):
    """What changes of controls may cost, as shares of the plan's time."""

    cost: float  # that they count for at most, in the last rounds
    longer: float  # that the plan may take longer, about, if it changes its controls less


class Weights(NamedTuple):
    """Weights of an optimisation, see `ompl_ext.kernels.gauss_newton`."""

    trials: int  # steps of a round, at most
    trials_again: int  # of a last round that is repeated
    soft: float  # first stiffness of the model
    hardening: float  # factor of the stiffness from round to round
    penalty: tuple[float, float]  # stiffness of the penalties (1/m^2, s): that of the model between these bounds
    smoothness: float  # of changes of controls: times the square of the time for a footprint's length, per interval
    smoothnesses: tuple[Smoothness, Smoothness]  # in turn, until the result costs less than the guess
    small_change: float  # of a control, as a share of its range, beyond which a change counts in proportion
    evenness: float  # of the deviations of the durations from their mean, per interval


CHEAPEST = Smoothness(0.0005, 0.0)
USUAL = Weights(5, 5, 10.0, 30.0, (100.0, 3e3), 80.0, (Smoothness(0.03, 0.0015), CHEAPEST), 5e-4, 10.0)
MANOEUVRE = Weights(10, 20, 30.0, 6.0, (1e4, 1e5), 0.02, (Smoothness(0.004, 0.0), CHEAPEST), math.inf, 0.1)
"""With a heading: many changes of controls in little space."""


def weights_of(goal: Goal) -> Weights:
    """Weights of an optimisation of plans to a goal."""
    return MANOEUVRE if goal.has_heading else USUAL


@dataclass(frozen=True)
class Guess:
    """Trajectory of n intervals: `states` (n + 1, nx), `controls` (n, nu), `durations` (n,) s."""

    states: Matrix
    controls: Matrix
    durations: Floats

    @property
    def time(self) -> float:
        """Duration of all intervals (s)."""
        return float(self.durations.sum())


class Polish:
    """Local optimisation for a problem of the planner; it keeps its memory between trajectories."""

    def __init__(self, vehicle: Vehicle, problem: Problem) -> None:
        self._vehicle, self._problem, self._kernels = vehicle, problem, polish_kernels(vehicle)
        problem.functions[INTERVALS] = self._kernels.intervals
        self._signed = np.empty_like(problem.field)
        fill_penetration(problem.field, 1.0 / problem.scalar[at.GRID_INVERSE], self._signed)
        self._lanes = lanes_of(vehicle, int(problem.option[at.STEPS]))
        self._braking = lanes_of(vehicle, int(problem.option[at.BRAKE_STEPS]))
        self._setting, self._n, self._capacity = np.zeros(st.SETTINGS), 0, 0
        self._weights = USUAL

    def improve(
        self,
        guess: Guess,
        goal: Goal,
        begin: float = 0.0,
        urgency: float = 1.0,
        smoothness: Smoothness | None = None,
    ) -> Guess | None:
        """Trajectory that obeys the model, passes all checks and takes less time, as far as one was found.

        Args:
            guess: trajectory to begin with, which need not obey the model.
            goal: region to end in.
            begin: time of its first state since the start of the query (s).
            urgency: weight of the time; a small one for a guess that has to become feasible first.
            smoothness: what changes of the controls may cost; by default the first one of `weights_of` the goal.
        """
        self._load(guess, goal, begin, urgency)
        damping, setting, stiffness = DAMPING, self._setting, self._weights.soft
        while stiffness < HARD:
            damping = self._round(stiffness, self._weights.trials, damping)
            stiffness *= self._weights.hardening
        smoothness = smoothness or self._weights.smoothnesses[0]
        setting[st.SMOOTHNESS_COST] = smoothness.cost
        quantum, longer, trials = float(self._problem.scalar[at.QUANTUM]), 0, LAST_TRIALS
        for replay in range(REPLAYS):
            damping = self._round(HARD, trials, damping)
            if quantum > 0.0 and (replay == 0 or (replay > 1 and self._lanes.at_goal[0] == 0)):
                self._fix_durations(quantum, longer)
                damping, longer = self._round(HARD, LAST_TRIALS, damping), 1
            failed = self._replay()
            if failed == 0:
                found = self._result()
                return found if smoothness.longer == 0.0 else self._smoothed(found, smoothness.longer, damping)
            if failed >= st.UNSAFE:
                break
            trials = self._weights.trials_again
        return None

    def _smoothed(self, found: Guess, longer: float, damping: float) -> Guess:
        """The current trajectory, which is `found`, with smaller changes of controls: `longer` by a share of its time.

        Their weight rises while the trajectory takes less time than that, and falls while it takes more.  It is `found`
        itself if the other one does not pass the checks or takes far too long.
        """
        self._setting[st.SMOOTHNESS_COST] = math.inf
        damping = self._round(HARD, SMOOTHING_TRIALS, damping, self._weight_for(found.time, longer))
        for _ in range(REPLAYS):
            failed = self._replay()
            if failed == 0:
                result = self._result()
                return result if result.time < (1.0 + MOST_LONGER * longer) * found.time else found
            if failed >= st.UNSAFE:
                break
            damping = self._round(HARD, self._weights.trials_again, damping)
        return found

    def _weight_for(self, time: float, longer: float) -> Callable[[], bool]:
        """Function that sets the weight of the changes for a step, and tells whether it is to be made."""
        setting, least = self._setting, float(self._setting[st.SMOOTHNESS])
        most, enough = (1.0 + longer) * time, (1.0 + ENOUGH_LONGER * longer) * time
        factor, steps = SMOOTHER, 0

        def set_weight() -> bool:
            nonlocal factor, steps
            takes = float(self._work.inputs[: self._n, -1].sum())
            if steps > 0:
                factor *= SMOOTHER_STEP if takes < most else 1.0 / SMOOTHER_STEP
                factor = min(max(factor, LEAST_SMOOTHER), MOST_SMOOTHER)
            setting[st.SMOOTHNESS] = factor * least
            steps += 1
            return steps <= SMOOTHING_STEPS or takes >= enough

        return set_weight

    def _replay(self) -> int:
        """Edges of the current trajectory that fail, see `replay` of the kernels."""
        return self._kernels.replay(self._n, self._problem, self._setting, self._work, self._lanes, self._braking)

    def _round(
        self, stiffness: float, trials: int, damping: float, set_weight: Callable[[], bool] | None = None
    ) -> float:
        """Steps at one stiffness of the model, with Levenberg's damping; returns the damping that was found good.

        They end when a step saves little, or when `set_weight`, which is called before each, returns false.
        """
        kernels, setting, n = self._kernels, self._setting, self._n
        work, stages, backward = self._work, self._stages, self._backward
        setting[st.STIFFNESS] = stiffness
        least, most = self._weights.penalty
        setting[st.PENALTY] = min(max(stiffness, least), most)
        arguments = n, self._problem, self._signed, setting, work, stages
        kernels.evaluate(*arguments, backward, False)
        merit, improved = math.inf, True
        for _ in range(trials):
            if improved:
                if set_weight is not None and not set_weight():
                    break
                merit = kernels.approximate(*arguments)
            found = math.inf
            if kernels.solve(stages, n, damping, stiffness, backward):
                found = kernels.evaluate(*arguments, backward, True)
            improved = found < merit
            if not improved:
                damping *= 10.0
                if damping > MOST_DAMPING:
                    break
                continue
            work.states[: n + 1], work.inputs[:n] = work.tried_states[: n + 1], work.tried_inputs[:n]
            damping = max(0.2 * damping, LEAST_DAMPING)
            if set_weight is None and merit - found < CONVERGED * setting[st.EVEN] * n:
                break
        return min(damping, 1e3)

    def _fix_durations(self, quantum: float, longer: int) -> None:
        """Divide the trajectory into intervals that are multiples of a time step (s); from now on they stay that long.

        The last ones are single steps, so that the total is at most one step longer than before, and `longer` steps.
        """
        guess, margin = self._result(), self._work.margin[: self._n + 1].copy()
        steps = max(1, math.ceil(guess.time / quantum - ROUNDING)) + longer
        each = max(1, min(round(self._setting[st.EVEN] / quantum), int(self._problem.option[at.STEPS])))
        whole = np.full(steps // each, each)
        self._store(divided(guess, quantum * np.concatenate([whole, np.ones(steps % each)])))
        self._work.margin[: self._n + 1] = np.interp(
            np.linspace(0, 1, self._n + 1), np.linspace(0, 1, len(margin)), margin
        )
        self._setting[[st.SHORTEST, st.LONGEST]] = quantum

    def _load(self, guess: Guess, goal: Goal, begin: float, urgency: float) -> None:
        self._store(guess)
        n, setting, shape = self._n, self._setting, self._vehicle.footprint
        self._weights = weights = weights_of(goal)
        interval = guess.time / n
        length = shape.length / self._vehicle.top_speed
        setting[[st.URGENCY, st.SMOOTHNESS, st.SMOOTHNESS_COST]] = (
            urgency,
            weights.smoothness * length**2 / interval,
            math.inf,
        )
        setting[[st.EVENNESS, st.BEGIN, st.SMALL_CHANGE]] = weights.evenness / interval, begin, weights.small_change
        setting[[st.SHORTEST, st.LONGEST]] = RANGE[0] * interval, RANGE[1] * interval
        inside = INSIDE if goal.is_exact else 1.0
        setting[st.GOAL_DISTANCE] = min(inside * goal.radius, max(goal.radius - NEAR_BORDER, 0.5 * goal.radius))
        setting[[st.GOAL_HEADING, st.GOAL_SHARE]] = goal.heading, INSIDE
        setting[st.GOAL_TURN] = INSIDE * goal.tolerance if goal.has_heading else math.inf

    def _store(self, guess: Guess) -> None:
        """Make a trajectory the current one."""
        n = self._n = len(guess.durations)
        self._reserve(n)
        work = self._work
        work.states[: n + 1], work.inputs[:n, :-1], work.inputs[:n, -1] = guess.states, guess.controls, guess.durations
        work.margin[: n + 1] = 0.0

    def _result(self) -> Guess:
        n, work = self._n, self._work
        return Guess(work.states[: n + 1].copy(), work.inputs[:n, :-1].copy(), work.inputs[:n, -1].copy())

    def _reserve(self, n: int) -> None:
        """Memory for n intervals."""
        if n <= self._capacity:
            return
        self._capacity = n
        nx, m = len(self._vehicle.state), len(self._vehicle.controls) + 1
        self._work, self._stages, self._backward = (
            st.shooting(n, nx, m, self._kernels.block),
            st.stages(n, nx, m),
            st.backward(n, nx, m),
        )
        self._stages.scale[:] = np.append(
            1.0 / np.append(np.ptp(self._vehicle.control_bounds, axis=1), 1.0) ** 2, TRUST
        )


def interval_of(vehicle: Vehicle, time: float) -> float:
    """Duration of the intervals in which a trajectory of `time` s is optimised (s)."""
    stride = STRIDE * vehicle.footprint.length / vehicle.top_speed
    return max(min(INTERVAL, stride), time / MOST_INTERVALS)


def resampled(guess: Guess, interval: float) -> Guess:
    """The same trajectory in intervals of about `interval` s; states in between are interpolated."""
    count = max(math.ceil(guess.time / interval), 2)
    return divided(guess, np.full(count, guess.time / count))


def divided(guess: Guess, durations: Floats) -> Guess:
    """The same trajectory in intervals of `durations` (n,) s; beyond its end it stays in its last state."""
    ends = np.concatenate([[0.0], np.cumsum(guess.durations)])
    times = np.concatenate([[0.0], np.cumsum(durations)])
    states = interpolated_rows(times, ends, guess.states)
    middle = 0.5 * (times[:-1] + times[1:])
    index = np.clip(np.searchsorted(ends, middle, side="right") - 1, 0, len(guess.durations) - 1)
    return Guess(states, guess.controls[index], durations)


def guess_along(path: PosePath, vehicle: Vehicle, start: Floats) -> Guess:
    """First guess from a path of poses: speeds and controls are those at which the path's velocities were seen.

    The durations allow for acceleration.
    """
    motion = motion_of(vehicle)
    _, numbers = motion.extreme_twists(vehicle.footprint.reach)
    seen = numbers[path.twist]
    states = motion.states[np.append(seen, seen[-1:])]
    columns = [vehicle.index(name) for name in ("x", "y", "theta")]
    states[:, columns] = path.poses
    turns = round((start[columns[2]] - path.poses[0, 2]) / math.tau)
    states[:, columns[2]] += math.tau * turns
    states[0] = start
    controls = motion.controls[seen].copy()
    guess = Guess(states, controls, CAREFULLY * path.times)
    return resampled(guess, interval_of(vehicle, guess.time))


def guess_to_goal(
    vehicle: Vehicle, workspace: Workspace, goal: Goal, settings: Settings, start: Floats
) -> Guess | None:
    """Guess along the path of poses from a start (nx,) to a goal with a heading; None if there is no path."""
    found = pose_cost_to_go_of(vehicle, workspace, goal, settings)
    path = found.path_from(*pose_of(start, vehicle))
    return guess_along(path, vehicle, start) if path is not None and len(path.times) > 1 else None


def guess_of(vehicle: Vehicle, times: Floats, trajectory: Matrix, controls: Matrix, durations: Floats) -> Guess:
    """Guess of a plan: states `trajectory` (k, nx) at `times` (k,), and the edges' controls (n, nu) and durations."""
    ends = np.cumsum(durations)
    held = np.minimum(np.searchsorted(ends, 0.5 * (times[:-1] + times[1:])), len(ends) - 1)
    return resampled(Guess(trajectory, controls[held], np.diff(times)), interval_of(vehicle, float(ends[-1])))
