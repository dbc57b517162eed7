"""Levels of clearance: where the bound of the deviation is measured, plans keep a share of it, and a margin.

In a narrow place the bound may leave no way.  Then plans keep a smaller share of it, then no margin, and where that
leaves no way either, they keep it for the next cycles only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

from kraft.driving.bound import LATER_DELAY, DeviationBound
from kraft.driving.planner_settings import CalibratedBound, PlannerSettings
from kraft.driving.solvers import Solvers
from ompl_ext.solver import DirtSolver

NEAR: Final = 1.5
"""Time after a commit for which plans keep the bound as it is now, s."""
HYSTERESIS: Final = 0.8
"""Share of the clearance of a wide level that suffices for the remainder of a plan made for this level."""
PAUSE: Final = 3
"""Number of cycles for which plans are not compared after one that keeps less was refused."""
STEADY: Final = 2
"""Number of cycles with the same level after which a higher one is tried."""
NARROW: Final = (1.0, 0.5)
"""Parts of the smallest share that plans keep without the margin before they give up foresight."""
SOON: Final = 3.0
"""Number of cycles for which plans keep the clearance then."""
PROGRESS_TIME: Final = 2.0
"""Time in which plans get cheaper if the vehicle gets on, s."""
INSISTENCE: Final = 1.25
"""Longest time for which less clearance may be kept for any gain, because plans do not get cheaper, s."""
PROGRESS: Final = 0.4
"""Share of `PROGRESS_TIME` by which plans get cheaper, at least."""


@dataclass(frozen=True)
class Level:
    """Clearance that plans keep for `foresight` s: a `share` of the bound, and `margin` m.

    At a `narrow` level the share is also that of the bound's part for the speed, see `kept_of`.
    """

    share: float
    margin: float = 0.0
    foresight: float = 0.0
    narrow: bool = False

    def kept_of(self, bound: DeviationBound, part: float) -> DeviationBound:
        """`part` of what this level keeps of a bound, without the margin: a share of it at rest, and all for the speed.

        A place may be too narrow for the bound at rest; for the part for the speed it is enough to drive slowly.
        Where it is so narrow that hardly a speed is left, the share is also that of what remains for the speed when
        the delay is known: then only a delay that is not known yet makes the vehicle slow.
        """
        spared = (1.0 - self.share) * min(bound.per_speed, LATER_DELAY) if self.narrow else 0.0
        return replace(
            bound.scaled(self.share * part),
            per_speed=part * (bound.per_speed - spared),
            turning=part * bound.turning,
        )


def levels_of(settings: PlannerSettings) -> tuple[Level, ...]:
    """Levels of a method's settings, in the order in which they are tried."""
    if settings.bound is None:
        return (Level(1.0),)
    shares, margin, cycle = settings.bound.shares, settings.margin, settings.cycle
    foresight = max(settings.bound.foresight, cycle)
    farsighted = [Level(share, margin, foresight) for share in shares]
    if margin > 0.0:
        farsighted += [Level(share * shares[-1], 0.0, foresight, narrow=True) for share in NARROW]
    if foresight == cycle:
        return tuple(farsighted)
    soon = min(foresight, SOON * cycle)
    shortsighted = [
        *(Level(share, 0.0, soon, narrow=True) for share in shares[::2]),
        Level(shares[-1], 0.0, cycle, narrow=True),
    ]
    return (*farsighted, *shortsighted)


class Levels:
    """The level that the last plan keeps, and the clearances that the solvers are asked for at a level."""

    def __init__(self, solvers: Solvers, settings: PlannerSettings) -> None:
        self._solvers, self._settings, self._cycle = solvers, settings.bound or CalibratedBound(), settings.cycle
        self.all = levels_of(settings)
        self.bound = DeviationBound(0.0)
        """bound of the present cycle"""
        self.wide = sum(not level.narrow for level in self.all)
        """number of the levels at which a plan keeps the margin"""
        self.farsighted = sum(level.foresight == self.all[0].foresight for level in self.all)
        """number of the levels at which a plan keeps the clearance as long as at the first one"""
        self.kept = 0
        """index of the level of the last plan"""
        self.stalled = False
        """whether there was no progress at that level, and plans may keep less for a gain"""
        self._steady = 0  # number of cycles with this level since a higher one was tried
        self._least, self._waited = math.inf, 0  # cost of the cheapest plan (s), and the number of cycles since then
        self._pause = 0  # number of cycles until plans are compared again

    def set_solvers(self, solvers: Solvers) -> None:
        """Ask other solvers from now on; costs of earlier plans, to another goal or in another map, are no measure."""
        self._solvers = solvers
        self._least, self._waited, self._pause = math.inf, 0, 0

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
        """Ask for the clearance of a level, `eased` for the remainder of a plan that keeps it; returns its solver.

        At a narrow level the clearance is a few centimetres, and a fifth of it is less than what estimates change by in
        a cycle.  The remainder of a plan would be lost in each, so what suffices for it is what suffices when it is
        checked again.
        """
        level, part = self.all[number], 1.0
        if eased:
            part = self._settings.recheck if level.narrow else HYSTERESIS
        dirt, near = self._solvers.planning, level.kept_of(self.bound, part).clearance
        shape = near.delta_per_speed, near.delta_per_time, near.delta_horizon
        self._solvers.checking.set_bound(near.delta, *shape)
        dirt.set_bound(near.delta + part * level.margin, *shape)
        if dirt is not self._solvers.checking:
            later = level.kept_of(self.bound.later, part).clearance
            dirt.set_far(NEAR, later.delta + part * level.margin, later.delta_per_speed)
        dirt.set_cycle(level.foresight)
        return dirt

    def downwards(self, first: int) -> list[int]:
        """Levels from number `first` on; as long as they keep their foresight, every second one of them."""
        return [*range(first, self.farsighted, 2), *range(max(first, self.farsighted), len(self.all))]

    def upwards(self) -> list[int]:
        """Levels to try above that of the last plan: the next one, and the lowest one with the whole foresight."""
        return sorted({self.kept - 1, min(self.kept, self.farsighted) - 1})

    def require(self) -> None:
        """Require what suffices when the last plan is checked again."""
        self._solvers.set_bound(self.all[self.kept].kept_of(self.bound, self._settings.recheck))

    def keep(self, number: int, stalled: bool) -> None:
        """Record that a plan of a level is proposed; if the vehicle is `stalled`, the next level is tried as well.

        Neither the margin nor the foresight is given up for a gain.
        """
        self.stalled = stalled and number + 1 not in (self.wide, self.farsighted, len(self.all))
        self._steady = self._steady % STEADY + 1 if number == self.kept and not self.stalled else 0
        self.kept = number

    def drive_on(self, drives: bool) -> None:
        """Change the level where no plan tells it: a lower one for a vehicle that stopped, a higher one in time."""
        self._steady = self._steady + 1 if drives else 0
        if not drives:
            self.kept = min(self.kept + 1, self.wide - 1)
        elif self._steady > STEADY:
            self.kept, self._steady = max(self.kept - 1, 0), 0
