"""Clearance that plans keep: a bound of the deviation from their prediction, solvers that ask for it, and its levels.

The bound is delta(t, v) for t s since the commit and a speed of v m/s.  Its shape comes from the covariance: the error
of the estimated pose at any time, the uncertain delay times the speed, and a growth with time by what the model leaves
out.  These are independent, so their squares add up.  Its scale is a variance ratio, calibrated online: each cycle
compares the deviation of the estimate from the last prediction with the bound.  The stated scale counts as a number of
cycles, so that the calibration begins cautiously.

Where the bound is measured, plans keep one of several levels of clearance: a share of the bound, and a margin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import numpy as np

from kraft.driving.messages import PredictedMotion, Uncertainty
from kraft.driving.method import CalibratedBound, PlannerSettings
from kraft.planning.workspace import displacement, goal_of, poses_of, settings_of, workspace_of
from kraft.scenario import Task
from ompl_ext.arrays import Floats
from ompl_ext.obstacles import Obstacle
from ompl_ext.query import Goal, Safety
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle

NEAR = 1.5  # time after a commit for which plans keep the bound as it is now (s)
LATER_DELTA = 0.1  # bound at rest that is expected afterwards, at least (m)
LATER_GROWTH, LATER_DELAY = 0.08, 0.1  # growth of the bound, and its part for the speed, at most (m/s, s)
KNOWN_DELAY = 0.1  # part of the bound for the speed that remains when the delay counts as known, at most (s)
COVER_EXCESS = 0.05  # of the discs that cover the footprint where the bound is measured, as a share of its width
UNCORRECTED = 0.5  # time for which a wrong acceleration moves the vehicle until the controller corrects its effect (s)


@dataclass(frozen=True)
class DeviationBound:
    """Bound of a deviation with independent parts: the root of `delta`^2 + (`per_speed` v)^2 + (`per_time` t)^2.

    t is at most `horizon` s, and v at most `fastest` m/s (m, s, m/s).
    """

    delta: float
    per_speed: float = 0.0
    per_time: float = 0.0
    horizon: float = 0.0
    fastest: float = math.inf

    @property
    def clearance(self) -> Safety:
        """Clearance that is nowhere less than the bound: linear in v and t, as SAFETY needs it; v is at most `fastest`.

        The root is convex in v and in t, and at most the sum of what v and t alone add to `delta`: chords are above it.
        """
        return Safety(
            delta=self.delta,
            delta_per_speed=_chord(self.delta, self.per_speed, self.fastest),
            delta_per_time=_chord(self.delta, self.per_time, self.horizon),
            delta_horizon=self.horizon,
        )

    def at(self, since: Floats, speeds: Floats) -> Floats:
        """Clearance (n,) at times (n,) since the commit (s) and speeds (n,), m."""
        return self.clearance.clearance(speeds, since)

    def scaled(self, factor: float) -> DeviationBound:
        """Bound times a factor."""
        return replace(
            self, delta=factor * self.delta, per_speed=factor * self.per_speed, per_time=factor * self.per_time
        )

    def kept(self, level: Level, part: float) -> DeviationBound:
        """`part` of the clearance of a level, without its margin: a share of the bound at rest, and all for the speed.

        A place may be too narrow for the bound at rest; for the rest of the bound the vehicle only has to drive slowly.
        Where it is so narrow that hardly a speed is left, the share is also that of what remains for the speed when
        the delay is known: then only a delay that is not known yet makes the vehicle slow.
        """
        spared = (1.0 - level.share) * min(self.per_speed, KNOWN_DELAY) if level.narrow else 0.0
        return replace(self.scaled(level.share * part), per_speed=part * (self.per_speed - spared))

    @property
    def drive_is_known(self) -> bool:
        """Whether delay and drive are known as well as is expected for later."""
        return self.per_time <= LATER_GROWTH and self.per_speed <= LATER_DELAY

    @property
    def later(self) -> DeviationBound:
        """Bound that is expected for the later part of a plan: delay and drive will be known better then."""
        grown = math.hypot(max(self.delta, LATER_DELTA), min(self.per_time, LATER_GROWTH) * self.horizon)
        return DeviationBound(grown, min(self.per_speed, LATER_DELAY), fastest=self.fastest)


def _chord(constant: float, slope: float, end: float) -> float:
    """Slope of the chord from 0 to `end` of the root of `constant`^2 + (`slope` x)^2; without an end it is `slope`."""
    if end == 0.0 or constant == 0.0 or math.isinf(end):
        return slope
    return (math.hypot(constant, slope * end) - constant) / end


RATIOS: Final = 33
"""Number of shapes of an ellipse for which quantiles are tabulated."""
ANGLES: Final = 64
"""Number of directions of a deviation over which its probability is integrated."""
HALVINGS: Final = 50
"""Number of halvings of the interval in which a quantile is looked for."""
LARGEST: Final = 10.0
"""Its end, standard deviations."""


@cache
def radius_quantiles(level: float) -> tuple[Floats, Floats]:
    """Ratios (n,) of the axes of an ellipse, and the `level` quantile (n,) of the length of a normal vector with it.

    The quantile is in units of the larger standard deviation.  With the ratio 0 it is that of a deviation along a line,
    with 1 the one of Rayleigh's distribution.
    """
    ratios = np.linspace(0.0, 1.0, RATIOS)
    angles = (np.arange(ANGLES) + 0.5) * math.tau / ANGLES
    variance = np.cos(angles) ** 2 + (ratios[:, None] * np.sin(angles)) ** 2  # of the length, in units of Rayleigh's
    low, high = np.zeros(RATIOS), np.full(RATIOS, LARGEST)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        is_below = np.exp(-0.5 * middle[:, None] ** 2 / variance).mean(axis=1) > 1.0 - level
        low, high = np.where(is_below, middle, low), np.where(is_below, high, middle)
    return ratios, high


class BoundCalibration:
    """Bounds for the coming cycle, and their calibration by the cycles before."""

    def __init__(self, settings: CalibratedBound, vehicle: Vehicle) -> None:
        self._settings, self._vehicle = settings, vehicle
        self._ratios, self._count = settings.prior_cycles * settings.initial**2, settings.prior_cycles
        self._last: tuple[PredictedMotion, DeviationBound] | None = None

    @property
    def factor(self) -> float:
        """Scale of the bound, 1 if deviations are as large as the covariance states."""
        low, high = self._settings.limits
        return min(max(math.sqrt(self._ratios / self._count), low), high)

    def bound(self, uncertainty: Uncertainty) -> DeviationBound:
        """Bound for a cycle that is planned from an estimate with this uncertainty."""
        return self._unscaled(uncertainty).scaled(self.factor)

    def committed(self, predicted: PredictedMotion, uncertainty: Uncertainty) -> None:
        """Record the prediction of the committed motion, to be compared with what follows."""
        self._last = predicted, self._unscaled(uncertainty)

    def observe(self, time: float, state: Floats) -> None:
        """Compare an estimated state (nx,) at `time` (s) with the last prediction."""
        if self._last is None or not self._last[0].times[0] < time:
            return
        predicted, bound = self._last
        if time > predicted.times[-1] + 1e-9:
            return
        expected = np.array([np.interp(time, predicted.times, column) for column in predicted.states.T])
        deviation = displacement(state, expected, self._vehicle)
        speed = expected[[self._vehicle.rest_indices[0]]]
        ratio = deviation / float(bound.at(np.array([time - predicted.times[0]]), speed)[0])
        kept = 1.0 - 1.0 / self._settings.memory_cycles
        self._ratios = kept * self._ratios + (ratio / self._settings.expected_ratio) ** 2
        self._count = kept * self._count + 1.0

    def _unscaled(self, uncertainty: Uncertainty) -> DeviationBound:
        vehicle, covariance = self._vehicle, uncertainty.state
        pose = [vehicle.index("x"), vehicle.index("y")]
        turn = vehicle.footprint.reach**2 * float(covariance[vehicle.index("theta"), vehicle.index("theta")])
        smaller, larger = np.sqrt(np.linalg.eigvalsh(covariance[np.ix_(pose, pose)]).clip(0.0) + turn).tolist()
        ratios, quantiles = radius_quantiles(self._settings.level)
        quantile = float(np.interp(smaller / larger, ratios, quantiles)) if larger > 0.0 else 0.0
        growth = math.hypot(self._settings.growth, 0.5 * UNCORRECTED * uncertainty.acceleration)
        along = float(quantiles[0])  # of what a wrong delay and a wrong drive change: the way
        return DeviationBound(
            quantile * larger, along * uncertainty.delay, along * growth, self._settings.horizon, vehicle.top_speed
        )


WAY_MARGIN = 0.05  # distance that the ways of the cost-to-go of poses keep from obstacles where they can (m)
LEAST_GOAL = 0.5  # share of a small goal's radius that is aimed for, however large the margin
MIN_GOAL_RADIUS, MIN_GOAL_TOLERANCE = 0.01, math.radians(1.0)  # of the region that the planner aims for (m, rad)


@dataclass(frozen=True)
class Solvers:
    """Two solvers of one task: `planning` requires the method's margin and foresight, `checking` only its clearance.

    The margin is not required when a plan is checked again, so that small errors do not reject the plan.
    """

    planning: DirtSolver
    checking: DirtSolver
    origin: tuple[Task, Vehicle] | None = None
    """task and vehicle that they were made for"""

    @classmethod
    def of(cls, task: Task, vehicle: Vehicle, settings: PlannerSettings, more: tuple[Obstacle, ...] = ()) -> Solvers:
        """Make the solvers for a method's settings; without a clearance in the settings, SAFETY is disabled.

        `more` are obstacles that the task does not have.
        """
        goal = goal_of(task)
        goal = replace(goal, radius=max(goal.radius - settings.goal_margin, LEAST_GOAL * goal.radius))
        workspace, safety, shape = workspace_of(task, vehicle), method_safety(settings), vehicle.footprint
        workspace = replace(workspace, obstacles=workspace.obstacles + more)
        planner = "sst" if settings.type == "sst" else "dirt"
        search = replace(settings_of(task, vehicle), polish=settings.polish, planner=planner)
        if settings.cost_to_go == "pose" and vehicle.index("theta") >= 0:
            search = replace(search, pose_cost_to_go=True, way_margin=WAY_MARGIN)
        if settings.bound is not None:
            search = replace(search, excess=COVER_EXCESS)
        checking = DirtSolver(vehicle, workspace, goal, safety, search, settings.capacity)
        clearance = settings.bound or settings.safety
        foresight = clearance.foresight if clearance else 0.0
        if settings.margin == 0.0 and foresight <= settings.cycle:
            return cls(checking, checking, (task, vehicle))
        safety = replace(safety, cycle=max(foresight, settings.cycle))
        margin = settings.margin if settings.bound is None else 0.0  # which is added to the bound
        larger_vehicle = replace(vehicle, footprint=shape.with_margin(margin))
        return cls(
            DirtSolver(larger_vehicle, workspace, goal, safety, search, settings.capacity), checking, (task, vehicle)
        )

    def with_obstacles(self, more: tuple[Obstacle, ...], settings: PlannerSettings) -> Solvers:
        """Solvers of the same task with `more` obstacles than it has, and with the present parameters."""
        assert self.origin is not None, "the solvers were made for a task"
        solvers = Solvers.of(*self.origin, settings, more)
        solvers.set_parameters(np.array(list(self.checking.vehicle.parameters.values())))
        return solvers

    def load(self, state: Floats) -> None:
        """Compute what queries of this map share, which the first one from a state (nx,) would do otherwise."""
        for dirt in (self.checking, self.planning):
            dirt.start(state, 0)
            dirt.least_distance(poses_of(state[None, :], dirt.vehicle))

    def set_bound(self, bound: DeviationBound) -> None:
        """Set the clearance that SAFETY asks for in both."""
        asked = bound.clearance
        for dirt in (self.checking, self.planning):
            dirt.set_bound(asked.delta, asked.delta_per_speed, asked.delta_per_time, asked.delta_horizon)

    def set_parameters(self, values: Floats) -> None:
        """Set the parameters of the vehicle (np,) in both."""
        self.checking.set_parameters(values)
        if self.planning is not self.checking:
            self.planning.set_parameters(values)


def goal_region(goal: Goal, vehicle: Vehicle, root: Floats) -> tuple[float, float]:
    """Radius (m) and tolerance of the heading (rad) to aim for from `root` (nx,): smaller ones within the goal.

    A vehicle that is in the goal by its estimate, but not in truth, would wait there.  It aims for half of its
    distance to the centre, or of its deviation from the heading if that is the one closer to its limit.
    """
    if (goal.has_heading or goal.limits) and not goal.contains(vehicle, root):
        return goal.radius, goal.tolerance  # it has to turn or to stop on the way to the centre
    away = math.dist(goal.center, (root[vehicle.index("x")], root[vehicle.index("y")]))
    radius = max(MIN_GOAL_RADIUS, min(goal.radius, 0.5 * away))
    if not goal.has_heading:
        return radius, goal.tolerance
    off = abs(math.remainder(root[vehicle.index("theta")] - goal.heading, math.tau))
    if off / goal.tolerance <= away / goal.radius:
        return radius, goal.tolerance
    return goal.radius, max(MIN_GOAL_TOLERANCE, 0.5 * off)


def method_safety(settings: PlannerSettings) -> Safety:
    """SAFETY with the clearance of a method, disabled if the method has none."""
    margin = settings.safety
    if settings.bound is not None:  # the clearance is set in every cycle
        return Safety(cycle=settings.cycle)
    if margin is None:
        return Safety(enabled=False, cycle=settings.cycle)
    return Safety(cycle=settings.cycle, delta=margin.delta, delta_per_speed=margin.delta_per_speed)


HYSTERESIS = 0.8  # share of the clearance of a wide level that suffices for the rest of a plan made for this level
PAUSE = 3  # cycles for which plans are not compared after one that keeps less was refused
STEADY = 2  # cycles with the same level after which a higher one is tried
NARROW = (1.0, 0.5)  # parts of the smallest share that plans keep without the margin before they give up foresight
SOON = 3.0  # cycles for which plans keep the clearance then
PROGRESS_TIME = 2.0  # time in which plans get cheaper if the vehicle gets on (s)
INSISTENCE = 1.25  # longest time for which less clearance may be kept for any gain, because they do not (s)
PROGRESS = 0.4  # share of that time by which they get cheaper, at least


@dataclass(frozen=True)
class Level:
    """Clearance that plans keep for `foresight` s: a `share` of the bound, and `margin` m.

    At a `narrow` level the share is also that of the bound's part for the speed, see `DeviationBound.kept`.
    """

    share: float
    margin: float = 0.0
    foresight: float = 0.0
    narrow: bool = False


def levels_of(settings: PlannerSettings) -> tuple[Level, ...]:
    """Levels of a method's settings, in the order in which they are tried."""
    if settings.bound is None:
        return (Level(1.0),)
    shares, margin, cycle = settings.bound.shares, settings.margin, settings.cycle
    foresight = max(settings.bound.foresight, cycle)
    far = [Level(share, margin, foresight) for share in shares]
    if margin > 0.0:
        far += [Level(share * shares[-1], 0.0, foresight, narrow=True) for share in NARROW]
    if foresight == cycle:
        return tuple(far)
    soon = min(foresight, SOON * cycle)
    near = [
        *(Level(share, 0.0, soon, narrow=True) for share in shares[::2]),
        Level(shares[-1], 0.0, cycle, narrow=True),
    ]
    return (*far, *near)


class Levels:
    """The level that the last plan keeps, and the clearances that the solvers are asked for at a level."""

    def __init__(self, solvers: Solvers, settings: PlannerSettings) -> None:
        self._solvers, self._settings, self._cycle = solvers, settings.bound or CalibratedBound(), settings.cycle
        self.all = levels_of(settings)
        self.wide = sum(not level.narrow for level in self.all)
        """number of the levels at which a plan keeps the margin"""
        self.far = sum(level.foresight == self.all[0].foresight for level in self.all)
        """number of the levels at which a plan keeps the clearance as long as at the first one"""
        self.kept = 0
        """index of the level of the last plan"""
        self.stalled = False
        """whether there was no progress at that level, and plans may keep less for a gain"""
        self._steady = 0  # number of cycles with this level since a higher one was tried
        self._least, self._waited = math.inf, 0  # cost of the cheapest plan (s), and the number of cycles since then
        self._pause = 0  # number of cycles until plans are compared again
        self.bound = DeviationBound(0.0)

    @property
    def share(self) -> float:
        """Share of the bound at the level that the last plan keeps."""
        return self.all[self.kept].share

    @property
    def tries_higher(self) -> bool:
        """Whether it is time to try a higher level."""
        return self.kept > 0 and self._steady >= STEADY

    @property
    def gets_on(self) -> bool:
        """Whether plans have become cheaper lately."""
        return self._waited * self._cycle <= PROGRESS_TIME

    @property
    def compares(self) -> bool:
        """Whether plans are compared with ones that keep less, to find out whether these save enough."""
        return self._pause == 0

    def note_comparison(self, refused: bool) -> None:
        """Note whether a plan that keeps less was refused: in the next cycles the same is likely."""
        self._pause = PAUSE if refused else max(0, self._pause - 1)

    def note_progress(self, cost: float, rises: bool) -> None:
        """Note the cost of a plan (s), and whether plans have become cheaper in the latest cycles.

        Each plan may put off the part that asks for more clearance than there is, so that the vehicle never gets on.
        A level with more clearance than before (`rises`) gets the whole time.  After `INSISTENCE` without success the
        costs may have another reason, such as a weaker drive.
        """
        self._waited += 1
        insists = self._waited * self._cycle > PROGRESS_TIME + INSISTENCE
        if rises or insists or self._least - cost >= PROGRESS * PROGRESS_TIME:
            self._least, self._waited = cost, 0

    def set(self, number: int, eased: bool) -> DirtSolver:
        """Ask for the clearance of a level, `eased` for the rest of a plan that keeps it; returns its solver.

        At a narrow level the clearance is a few centimetres, and a fifth of it is less than what estimates change by in
        a cycle.  The rest of a plan would be lost in each, so what suffices for it is what suffices when it is checked
        again.
        """
        level, part = self.all[number], 1.0
        if eased:
            part = self._settings.recheck if level.narrow else HYSTERESIS
        dirt, near = self._solvers.planning, self.bound.kept(level, part).clearance
        shape = near.delta_per_speed, near.delta_per_time, near.delta_horizon
        self._solvers.checking.set_bound(near.delta, *shape)
        dirt.set_bound(near.delta + part * level.margin, *shape)
        if dirt is not self._solvers.checking:
            later = self.bound.later.kept(level, part).clearance
            dirt.set_far(NEAR, later.delta + part * level.margin, later.delta_per_speed)
        dirt.set_cycle(level.foresight)
        return dirt

    def downwards(self, first: int) -> list[int]:
        """Levels from number `first` on; as long as they keep their foresight, every second one of them."""
        return [*range(first, self.far, 2), *range(max(first, self.far), len(self.all))]

    def upwards(self) -> list[int]:
        """Levels to try above that of the last plan: the next one, and the lowest one with the whole foresight."""
        return sorted({self.kept - 1, min(self.kept, self.far) - 1})

    def require(self) -> None:
        """Require what suffices when the last plan is checked again."""
        self._solvers.set_bound(self.bound.kept(self.all[self.kept], self._settings.recheck))

    def keep(self, number: int, stalled: bool) -> None:
        """Record that a plan of a level is proposed; if the vehicle is `stalled`, the next level is tried as well.

        Neither the margin nor the foresight is given up for a gain.
        """
        self.stalled = stalled and number + 1 not in (self.wide, self.far, len(self.all))
        self._steady = self._steady % STEADY + 1 if number == self.kept and not self.stalled else 0
        self.kept = number

    def drive_on(self, drives: bool) -> None:
        """Change the level where no plan tells it: a lower one for a vehicle that stopped, a higher one in time."""
        self._steady = self._steady + 1 if drives else 0
        if not drives:
            self.kept = min(self.kept + 1, self.wide - 1)
        elif self._steady > STEADY:
            self.kept, self._steady = max(self.kept - 1, 0), 0
