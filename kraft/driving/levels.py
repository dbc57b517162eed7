"""Levels of clearance that a plan may keep where the bound of the deviation is measured: shares of it, and a margin."""

from __future__ import annotations

from dataclasses import dataclass

from kraft.driving.bound import DeviationBound
from kraft.driving.method import CalibratedBound, PlannerSettings
from kraft.driving.solvers import Solvers
from ompl_ext.solver import DirtSolver

HYSTERESIS = 0.8  # share of the clearance of a level that suffices for a plan that was made for this level
STEADY = 2  # cycles with the same level after which a higher one is tried
NARROW = (1.0, 0.5)  # parts of the smallest share that plans keep without the margin before they give up foresight
SOON = 3.0  # cycles for which plans keep the clearance then


@dataclass(frozen=True)
class Level:
    """Clearance that plans keep for `foresight` s: a `share` of the bound, and `margin` m."""

    share: float
    margin: float = 0.0
    foresight: float = 0.0


def levels_of(settings: PlannerSettings) -> tuple[Level, ...]:
    """Levels of a method's settings, in the order in which they are tried."""
    if settings.bound is None:
        return (Level(1.0),)
    shares, margin, cycle = settings.bound.shares, settings.margin, settings.cycle
    foresight = max(settings.bound.foresight, cycle)
    far = [Level(share, margin, foresight) for share in shares]
    if margin > 0.0:
        far += [Level(share * shares[-1], 0.0, foresight) for share in NARROW]
    if foresight == cycle:
        return tuple(far)
    soon = min(foresight, SOON * cycle)
    return (*far, *(Level(share, 0.0, soon) for share in shares[::2]), Level(shares[-1], 0.0, cycle))


class Levels:
    """The level that the last plan keeps, and the clearances that the solvers are asked for at a level."""

    def __init__(self, solvers: Solvers, settings: PlannerSettings) -> None:
        self._solvers, self._settings = solvers, settings.bound or CalibratedBound()
        self.all = levels_of(settings)
        self.wide = len(self._settings.shares)
        """number of the levels at which a plan keeps the margin"""
        self.far = sum(level.foresight == self.all[0].foresight for level in self.all)
        """number of the levels at which a plan keeps the clearance as long as at the first one"""
        self.kept = 0
        """index of the level of the last plan"""
        self._steady = 0  # number of cycles with this level since a higher one was tried
        self.bound = DeviationBound(0.0)

    @property
    def share(self) -> float:
        """Share of the bound at the level that the last plan keeps."""
        return self.all[self.kept].share

    @property
    def tries_higher(self) -> bool:
        """Whether it is time to try a higher level."""
        return self.kept > 0 and self._steady >= STEADY

    def set(self, number: int, eased: bool) -> DirtSolver:
        """Ask for the clearance of a level, `eased` for the rest of a plan that keeps it; returns its solver."""
        level, part = self.all[number], HYSTERESIS if eased else 1.0
        bound, dirt = self.bound.scaled(level.share * part), self._solvers.planning
        self._solvers.checking.set_bound(bound.delta, bound.per_speed, bound.per_time, bound.horizon)
        dirt.set_bound(bound.delta + part * level.margin, bound.per_speed, bound.per_time, bound.horizon)
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
        self._solvers.set_bound(self.bound.scaled(self.share * self._settings.recheck))

    def keep(self, number: int, stalled: bool) -> None:
        """Record that a plan of a level is proposed; if the vehicle is `stalled`, the next plan may keep less."""
        self._steady = self._steady % STEADY + 1 if number == self.kept else 0
        self.kept = number
        if stalled and number + 1 not in (self.wide, self.far, len(self.all)):
            self.kept, self._steady = number + 1, 0

    def drive_on(self, drives: bool) -> None:
        """Change the level where no plan tells it: a lower one for a vehicle that stopped, a higher one in time."""
        self._steady = self._steady + 1 if drives else 0
        if not drives:
            self.kept = min(self.kept + 1, self.wide - 1)
        elif self._steady > STEADY:
            self.kept, self._steady = max(self.kept - 1, 0), 0
