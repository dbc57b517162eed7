"""Choice of a model's structure by what it predicts: which of its terms the logs need.

Drives are cut into windows of the horizon, each with a state of its own at its beginning.  Poses in a window weigh less
the later they are, by the error that the model makes by then: a model that is exact is fitted as in the paper's graph,
and one that lacks an effect is fitted to predict well over the horizon instead of being bent by every small motion.

From the model with all terms, the term whose removal costs least is switched off, and so on.  Every structure is
judged on logs that it was not fitted to (cross-validation over logs, or over parts of a single one); of those whose
error is within one standard error of the best, the simplest is taken (Hastie, Tibshirani, Friedman: The Elements of
Statistical Learning, 2009, Sec. 7.10).  So are those that are hardly worse: of many logs the standard error is so small
that effects of the discrete steps would be taken for terms.

Errors of predictions depend on the few windows with the largest ones, so that a term which acts in other windows does
not show in them.  The likelihood of all poses shows it: a term that was switched off is switched on again if the cost
falls by more than noise and differences between folds explain, and the predictions do not get worse.

A model whose error does not grow beyond the noise of the poses is also compared in longer windows, which tell more:
fewer unknown states at their beginnings explain what a term does.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.errors import Code, InputError
from kraft.sysid.drive_regression import values_with_drive
from kraft.sysid.fit_progress import FitProgress, OnIteration
from kraft.sysid.initial_values import InitialSearch
from kraft.sysid.interface import AT_BOUND, Settings
from kraft.sysid.log_motion import reverses
from kraft.sysid.multistep import CONVERGED, MultiStep, fit
from kraft.sysid.optimiser import RIDGE, Optimum, bounded_step, step_with, without_fold
from kraft.sysid.parallel import in_parallel
from kraft.sysid.parameters import Parameters, parameters_of, variation_of, vehicle_of
from kraft.sysid.prediction import Piece, Predictor, pieces_of
from kraft.sysid.problem import NoiseModel, Point, noise_model
from kraft.sysid.selection import cost_of_terms, costs_of_terms, is_shown, size_of_term
from kraft.sysid.smoothing import measured_noise, thinned
from kraft.sysid.structure_choice import NEGLIGIBLE_LOSS, OFFSETS, Structure, best_of, is_near, may_be_near
from kraft.sysid.window_controls import WindowControls
from kraft.sysid.windows import WINDOW_MIN, Variation, cut, evenly, folds_of, windows_of
from kraft.vehicles.config import VehicleConfig
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs.log import Log


AUXILIARY: Final = ("delay",)
"""Auxiliary parameters beside the terms of the model; all others are terms of it."""
FIRST_GROWTH: Final = (0.2, 0.2, 0.3)
"""Growth of the model's error in the first fit: m/s, m/s, rad/s."""
GROWTH_ROUNDS: Final = 2
"""Fits after which the growth of the error is estimated again."""
FIRST_TERMS: Final = ("friction", "lever")
"""Terms in the search for first values."""
SEARCHED_WINDOWS: Final = 100
"""Most windows that the search uses, evenly spread over the logs; of more, only the last fit uses all."""
FIRST_ITERATIONS, FIRST_CONVERGED = 20, 1e-3
"""Most iterations of the first fits of all terms, and the relative decrease of the cost below which those whose weights
are not final end."""
SAME_OPTIMUM: Final = 2 * FIRST_CONVERGED
"""Relative difference of the costs of two such fits up to which they are taken for fits with the same optimum."""
VARIATION_ROUNDS, VARIATION_CHANGE = 3, 0.3
"""Most estimates of the variation with the chosen terms, and the relative change below which one is the last."""
WORSE_MAX: Final = 3
"""Structures in a row that are clearly worse than the best, after which the search ends."""
NO_DIFFERENCE: Final = 1.0
"""Most increase of the cost by terms that are switched off together: less than any term needs to be shown."""
PATH_COST: Final = 2.0
"""Factor on the increase of the cost on the path that bounds what a term costs: fits there are not at their ends."""
SIZE_MIN: Final = 0.15
"""Least size of a term that is switched on again, over the standard deviation of what is known of cars.

The discrete steps of the model look like a term of up to 0.13."""
LONG_WINDOW: Final = 15.0
"""Length of the windows in which models are compared whose error does not grow, s."""
SURELY_NEEDED: Final = 200.0
"""Linearised decrease of the cost by a term from which its likelihood needs no fit without it.

The effect of a term may rise with the fourth power of its size (`slide`): its decrease is then a sixteenth of that."""
REFIT_ITERATIONS: Final = 6
"""Most iterations after a term is switched off."""
DIVERGED: Final = 1e6
"""Error of a prediction that diverges, m: the structure is judged by it, and not by the other predictions alone."""
OTHER_FITS: Final = 15
"""Usual number of fits of a search beside one for each term: of all terms, of the chosen ones, and in all windows."""
HORIZON_SHARES: Final = (1.0 / 3.0, 2.0 / 3.0, 1.0)
"""Times in a window at which errors are compared, as shares of the horizon."""


class StructureSearch:
    """Fits of the same logs with terms on and off."""

    def __init__(
        self,
        vehicle: VehicleConfig,
        logs: Sequence[Log],
        settings: Settings,
        on_iteration: OnIteration,
        window: float | None = None,
        most: int = SEARCHED_WINDOWS,
    ) -> None:
        """Cut the logs into windows of the horizon, or of about `window` s, and measure the noise of the poses.

        At most `most` of the windows are used.
        """
        self.vehicle, self.settings = vehicle, settings
        chosen = settings.auxiliary
        self.auxiliary = chosen if isinstance(chosen, tuple) else () if chosen == "none" else AUXILIARY
        self.model: Vehicle = vehicle_of(vehicle)
        self.iterations, self.fits, self.fits_planned, self._on_iteration = 0, 0, 0, on_iteration
        self._logs = logs
        parts = [part for log in logs for part in log.parts]
        noise = settings.noise or measured_noise([p.pose_times for p in parts], [p.poses for p in parts])
        found = [
            (segment, part)
            for i, log in enumerate(logs)
            for part in log.parts
            for segment in cut(thinned(part, settings.step), i, settings, window)
        ]
        segments = [segment for segment, _ in found]
        if not segments:
            problem = f"have no window of {WINDOW_MIN:g} s with four poses"
            expected = "expected longer drives, more poses a second, or a longer horizon"
            raise InputError.of("logs", problem, expected, Code.DATA)
        self.noise: NoiseModel = noise_model(self.model, settings, noise)
        self.growth: Floats = np.array(FIRST_GROWTH)
        stated = variation_of(self.parameters(()), settings)
        self.variation = Variation.of(tuple(stated), np.array(list(stated.values())))
        windows = windows_of(segments, [part for _, part in found], folds_of(segments, len(logs)))
        windows = replace(windows, halved=window is not None)  # errors of steps add up in long windows
        self.windows, self._folds, self._window = windows.some(most), windows.folds, window
        self._is_sample = len(self.windows.segments) < len(segments)
        fitted = {s.log for s in self.windows.segments}
        pieces = pieces_of(logs, settings, settings.horizon)
        self._pieces = evenly([piece for piece in pieces if piece.segment.log in fitted], SEARCHED_WINDOWS)
        self._predictors: dict[int, Predictor] = {}
        self._controls = WindowControls(self.windows, self.parameters(()))

    def goes_on(self, before: StructureSearch) -> None:
        """Count iterations and fits on from those of another search."""
        self.iterations, self.fits, self.fits_planned = before.iterations, before.fits, before.fits_planned

    def parameters(self, terms: Sequence[str]) -> Parameters:
        """Parameters with the given terms on, and the others off and frozen; what is frozen anyway keeps its value."""
        known = parameters_of(self.vehicle, self.settings, self.auxiliary)
        off = [spec for spec in known.specs if spec.neutral is not None and spec.name not in {*terms, *known.frozen}]
        settings = replace(
            self.settings,
            values={**{spec.name: spec.neutral for spec in off if spec.neutral is not None}, **self.settings.values},
            frozen=(*self.settings.frozen, *(spec.name for spec in off)),
        )
        return parameters_of(self.vehicle, settings, self.auxiliary)

    @cached_property
    def candidates(self) -> tuple[str, ...]:
        """Terms that may be switched off: those that the settings leave open."""
        known = parameters_of(self.vehicle, self.settings, self.auxiliary)
        given = {*self.settings.values, *known.frozen, *self._unexcited}
        return tuple(spec.name for spec in known.specs if spec.neutral is not None and spec.name not in given)

    @cached_property
    def _unexcited(self) -> frozenset[str]:
        """Terms that no log can show: braking without throttle backwards, its drive without motion backwards."""
        if "throttle" not in self.model.controls:
            return frozenset()
        k = list(self.model.controls).index("throttle")
        low = min(float(part.commands[:, k].min()) for log in self._logs for part in log.parts)
        if low >= 0.0:
            return frozenset({"brake", "reverse"})
        return frozenset() if reverses(self._logs) else frozenset({"reverse"})

    def graph(self, terms: Sequence[str]) -> MultiStep:
        """The multi-step problem with some terms on."""
        return MultiStep(self._controls, self.parameters(terms), self.noise, self.growth, self.variation)

    def full(self) -> Structure:
        """Fit of all terms, from the best of several first values."""
        graph = self.graph(self.candidates)
        optimum, *_ = self._best_first(graph, self._first_points(graph), FIRST_CONVERGED)
        others: list[Optimum] = []
        for made in range(GROWTH_ROUNDS):
            self.growth = graph.found_growth(optimum.point)
            self.variation = graph.found_variation(optimum.point.states)
            graph = self.graph(self.candidates)
            more = _with_drive(graph, optimum.point) if made == 0 else [found.point for found in others]
            tolerance = CONVERGED if made == GROWTH_ROUNDS - 1 else FIRST_CONVERGED
            optimum, *others = self._best_first(graph, [optimum.point, *more], tolerance)
        return self._judged(self.candidates, graph, optimum)

    def _first_points(self, graph: MultiStep) -> list[Point]:
        """Points where fits begin: the nominal values with the signs that fit best, and a search with few terms on."""
        p = graph.problem.parameters
        signed = [k for k, spec in enumerate(p.specs) if p.free[k] and spec.min == -spec.max and spec.value != 0.0]
        signs = [np.where(np.isin(np.arange(len(p.nominal)), flipped), -1.0, 1.0) * p.nominal
                 for count in range(len(signed) + 1) for flipped in itertools.combinations(signed, count)]  # fmt: skip
        nominal = min(signs, key=lambda rho: graph.cost(graph.start(rho)))
        if regressed := _with_drive(graph, graph.start(nominal)):
            return regressed
        few = self.graph(FIRST_TERMS)
        q, problem = few.problem.parameters, few.problem
        search = InitialSearch(
            q, problem.dynamics.discrete_model, problem.chains, few.smoothed, problem.actuators.mean(q.nominal)[0]
        )
        found = self._optimise(few, few.start(search.best()), FIRST_ITERATIONS).point.rho
        return [graph.start(nominal), graph.start(np.where(p.free & q.free, found, p.nominal))]

    def _best_first(self, graph: MultiStep, starts: Sequence[Point], tolerance: float) -> list[Optimum]:
        """The fits from several points that end in optima of their own; the windows of the best are reduced last."""
        fits = [self._optimise(graph, start, FIRST_ITERATIONS, tolerance) for start in starts]
        best = min(fits, key=lambda found: found.cost)
        if best is not fits[-1]:  # the variation follows from what was eliminated last
            graph.linearise(best.point)
            graph.reduce(0.0)
        others = [found for found in fits if found.cost - best.cost > SAME_OPTIMUM * best.cost]
        return [best, *others]

    def _optimise(
        self, graph: MultiStep, start: Point, iterations: int | None = None, tolerance: float = CONVERGED
    ) -> Optimum:
        self.fits_planned = max(self.fits_planned or self.fits + len(self.candidates) + OTHER_FITS, self.fits + 1)
        self.fits += 1
        number, planned = self.fits, self.fits_planned
        optimum = fit(
            graph,
            start,
            iterations or self.settings.iterations,
            lambda made, cost: self._on_iteration(FitProgress(number, planned, made, cost)),
            tolerance,
        )
        self.iterations += optimum.iterations
        return optimum

    def without(self, structure: Structure, *off: str) -> Structure:
        """The structure with fewer terms, fitted again."""
        terms = tuple(name for name in structure.terms if name not in off)
        graph, before = self.graph(terms), structure.optimum.point
        p = graph.problem.parameters
        chosen = np.isin(p.names, off)
        low, high = p.low - before.rho, p.high - before.rho
        low[chosen] = high[chosen] = (p.nominal - before.rho)[chosen]
        rho = p.within_bounds(before.rho + step_with(structure.optimum.factors, low, high, p.free, chosen))
        kept = before.rho.copy()
        rho[chosen] = kept[chosen] = p.nominal[chosen]
        # the linearised step may lead far off where a term matters
        start = min((graph.with_rho(before, values) for values in (rho, kept)), key=graph.cost)
        fitted = self._judged(terms, graph, self._optimise(graph, start, REFIT_ITERATIONS))
        return replace(fitted, without=", ".join(off))

    def converged(self, structure: Structure) -> Structure:
        """The structure after a fit to the end, with the variation of parameters estimated again.

        The first estimate was made with terms that are off now; too large a variation makes predictions follow noise.
        """
        graph, terms = structure.graph, structure.terms
        return replace(self._converged(terms, graph, structure.optimum.point), without=structure.without)

    def _converged(self, terms: tuple[str, ...], graph: MultiStep, start: Point) -> Structure:
        optimum = self._optimise(graph, start)
        for _ in range(VARIATION_ROUNDS):
            before, self.variation = self.variation, graph.found_variation(optimum.point.states)
            graph = self.graph(terms)
            optimum = self._optimise(graph, optimum.point)
            if np.allclose(self.variation.between, before.between, rtol=VARIATION_CHANGE):
                break
        return self._judged(terms, graph, optimum)

    def is_exact(self, structure: Structure) -> bool:
        """Whether the model's error stays below the noise of the poses over the longest window."""
        growth = structure.graph.found_growth(structure.optimum.point)
        longest = float(self.windows.since.max())
        return bool(np.all(growth * longest <= structure.graph.noise.pose_sigmas))

    def in_long_windows(self, structure: Structure, path: Sequence[Structure]) -> tuple[Structure, StructureSearch]:
        """The structure with the terms that the likelihood of long windows shows, and the search in these.

        The structure as it is, and this search, if the model's error grows, or if few logs are cut into other folds.
        """
        if not self.is_exact(structure):
            return structure, self
        longer = self._in_windows(LONG_WINDOW, SEARCHED_WINDOWS)
        if longer._folds != self._folds or longer.windows.folds != self.windows.folds:
            return structure, self
        found = longer._again(structure)
        if not longer.is_exact(found):
            return structure, self
        found = longer.pruned(longer._extended(found, path))
        return (found, longer) if is_near(found, structure, NEGLIGIBLE_LOSS) else (structure, self)

    def in_all_windows(self, structure: Structure) -> tuple[Structure, StructureSearch]:
        """The structure fitted to all windows to the end, and the search in these; this one if it has them all."""
        if not self._is_sample:
            return structure, self
        whole = self._in_windows(self._window, sys.maxsize)
        return whole._again(structure), whole

    def _in_windows(self, length: float | None, most: int) -> StructureSearch:
        """The search in other windows of the same logs."""
        other = StructureSearch(self.vehicle, self._logs, self.settings, self._on_iteration, length, most)
        other.growth, other.variation = self.growth, self.variation
        other.goes_on(self)
        return other

    def _again(self, structure: Structure) -> Structure:
        """A structure of a search in other windows, fitted in these to the end."""
        graph = self.graph(structure.terms)
        found = self._converged(structure.terms, graph, graph.start(structure.optimum.point.rho))
        return replace(found, without=structure.without, added=structure.added)

    def _extended(self, structure: Structure, path: Sequence[Structure]) -> Structure:
        """The structure with those of the other terms on that the likelihood shows, those of large gain first."""
        tried = {name: self._with(structure, name, _last_with(path, name)) for name in self.candidates
                 if name not in structure.terms}  # fmt: skip
        for name in sorted(tried, key=lambda name: tried[name].optimum.cost):
            more = tried[name]
            if not _gains(more, name, structure.optimum.cost - more.optimum.cost):
                continue
            if set(structure.terms) - set(more.terms):  # another term is on by now
                more = self._with(structure, name, more)
            if _gains(more, name, structure.optimum.cost - more.optimum.cost) and is_near(more, structure, 0.0):
                structure = replace(more, added=", ".join(filter(None, (structure.added, name))))
        return structure

    def pruned(self, structure: Structure) -> Structure:
        """The structure without those terms that predictions do not need and the likelihood does not show.

        Nor is a term shown that is smaller than what the discrete steps of the model look like.
        """
        costs = _linearised_costs(structure)
        for name in sorted((name for name in costs if costs[name] <= SURELY_NEEDED), key=lambda name: costs[name]):
            less = self.without(structure, name)
            gain = less.optimum.cost - structure.optimum.cost
            shown = _is_shown if name in OFFSETS else _gains
            if not shown(structure, name, gain) and is_near(less, structure, NEGLIGIBLE_LOSS):
                without = ", ".join(filter(None, (structure.without, name)))
                structure = replace(less, added=structure.added, without=without)
        return structure

    def completed(self, structure: Structure, path: Sequence[Structure]) -> Structure:
        """The structure with those terms on again that the likelihood shows, and with which it predicts as well."""
        lost = {
            after.without: (after.optimum.cost - before.optimum.cost, before)
            for before, after in itertools.pairwise(path)
            if after.without in before.terms and after.without not in structure.terms
        }
        for name in sorted(lost, key=lambda name: -lost[name][0]):
            cost, before = lost[name]
            is_known = cost > -NO_DIFFERENCE  # a cost that falls without a term is that of a fit in another valley
            if is_known and not _gains(before, name, PATH_COST * cost):
                continue
            more = self._with(structure, name, before)
            gain = structure.optimum.cost - more.optimum.cost
            if _gains(more, name, gain) and is_near(more, structure, 0.0):
                structure = replace(more, added=", ".join(filter(None, (structure.added, name))))
        return structure

    def _with(self, structure: Structure, name: str, other: Structure) -> Structure:
        """The structure with one more term, which begins at its value in another structure."""
        terms = tuple(term for term in self.candidates if term == name or term in structure.terms)
        graph, before = self.graph(terms), structure.optimum.point
        p = graph.problem.parameters
        rho = before.rho.copy()
        rho[p.index(name)] = other.optimum.point.rho[p.index(name)]
        return self._judged(terms, graph, self._optimise(graph, graph.with_rho(before, rho)))

    def _judged(self, terms: tuple[str, ...], graph: MultiStep, optimum: Optimum) -> Structure:
        """Errors of each fold with the parameters that the other folds give, to first order about the optimum.

        The parameters differ from those of the fit by the influence of the fold alone: what a fit of few iterations
        has left, all folds have in common.
        """
        p, point, windows = graph.problem.parameters, optimum.point, self.windows
        low, high = p.low - point.rho, p.high - point.rho
        left = bounded_step(optimum.factors, RIDGE, low, high, p.free)  # far too long where the fit is not at its end
        steps = [
            bounded_step(without_fold(optimum.factors, fold), RIDGE, low, high, p.free) for fold in range(windows.folds)
        ]
        rhos = [p.within_bounds(point.rho + step - left) for step in steps]
        errors = np.full((windows.folds, len(HORIZON_SHARES)), np.nan)
        predictors = self._predictors_of_folds()
        predicted = in_parallel(lambda fold: predictors[fold].poses(rhos[fold]), predictors)
        for (fold, predictor), poses in zip(predictors.items(), predicted, strict=True):
            off = poses - predictor.observed
            size = np.nan_to_num(np.hypot(off[..., 0], off[..., 1]), nan=DIVERGED)
            square = np.minimum(size, DIVERGED) ** 2
            for i, share in enumerate(HORIZON_SHARES):
                after = share * self.settings.horizon
                tolerance = np.maximum(0.75 * self.settings.step, 0.5 * predictor.interval)
                at = predictor.ahead & (np.abs(predictor.since - after) <= tolerance[:, None])
                if at.any():
                    errors[fold, i] = math.sqrt(float(np.mean(square[at]))) / after
        if np.isnan(errors).all():
            least = HORIZON_SHARES[0] * self.settings.horizon
            problem = f"have no stretch that is predicted for {least:.3g} s, a third of the horizon"
            raise InputError.of("logs", problem, "expected longer drives, or a shorter horizon", Code.DATA)
        return Structure(terms, graph, optimum, errors, np.array(rhos))

    def _predictors_of_folds(self) -> dict[int, Predictor]:
        """Predictors of the windows of each fold that has any; they keep what they found for the structure before."""
        if not self._predictors:
            p, folds = self.parameters(self.candidates), [self._fold_of(piece) for piece in self._pieces]
            self._predictors = {
                fold: Predictor([piece for piece, own in zip(self._pieces, folds, strict=True) if own == fold], p,
                                self.noise, self.growth, self.variation.total)
                for fold in sorted(set(folds))
            }  # fmt: skip
        return self._predictors

    def _fold_of(self, piece: Piece) -> int:
        """Fold of the window of the fit that begins nearest to a predicted one."""
        begin = piece.segment.begin + piece.known
        apart = [abs(s.begin - begin) if s.log == piece.segment.log else math.inf for s in self.windows.segments]
        return int(self.windows.fold[int(np.argmin(apart))])

    def path(self, every: Structure | None = None) -> list[Structure]:
        """Structures from all terms (`every`, fitted here if left out) to few, each without the term that costs least.

        Terms that the first fit left at their neutral value are switched off together, and so are those that make next
        to no difference even together.  The path ends where several structures in a row predict worse than the best.
        """
        found = [every or self.full()]
        p, rho = found[0].graph.problem.parameters, found[0].optimum.point.rho
        away = np.abs(rho - [spec.neutral if spec.neutral is not None else np.inf for spec in p.specs])
        idle = [name for name in found[0].terms if away[p.index(name)] <= AT_BOUND * (p.high - p.low)[p.index(name)]]
        if idle:
            found.append(self.without(found[0], *idle))
        while found[-1].terms and not self._too_few(found):
            found.append(self._less(found[-1]))
        return found

    def _less(self, structure: Structure) -> Structure:
        """The structure without the term that costs least, or without all that cost next to nothing together."""
        p, optimum = structure.graph.problem.parameters, structure.optimum
        costs = _linearised_costs(structure)
        cheapest, several = sorted(costs, key=lambda name: costs[name]), 1
        while several < len(costs) and cost_of_terms(p, optimum, cheapest[: several + 1]) <= NO_DIFFERENCE:
            several += 1
        if several > 1:
            less = self.without(structure, *cheapest[:several])
            if less.optimum.cost - optimum.cost <= NO_DIFFERENCE:
                return less
        return self.without(structure, cheapest[0])

    @staticmethod
    def _too_few(path: Sequence[Structure]) -> bool:
        best = best_of(path)
        return len(path) > WORSE_MAX and not any(may_be_near(s, best) for s in path[-WORSE_MAX:])

    def alike(self, other: Structure, *more: str) -> Structure:
        """The structure with the terms of one of another model, as far as this model has them, and with `more`."""
        terms = tuple(name for name in (*other.terms, *more) if name in self.candidates)
        graph, before = self.graph(terms), other.graph.problem.parameters
        p = graph.problem.parameters
        known = dict(zip(before.names, other.optimum.point.rho, strict=True))
        rho = np.array([known.get(n, v) for n, v in zip(p.names, p.nominal, strict=True)])
        start = graph.start(p.within_bounds(np.where(p.free, rho, p.nominal)))
        return self._judged(terms, graph, self._optimise(graph, start))


def _with_drive(graph: MultiStep, point: Point) -> list[Point]:
    """The point with the drive of regressions that know its delay; empty for models without such a drive.

    With the first growth of the error, a fit hardly tells terms of the drive from others, and their priors decide.  A
    limit of the acceleration may then end where it has no effect, and no fit from there finds it again.
    """
    problem = graph.problem
    mean = problem.actuators.mean(point.rho)[0]
    found = values_with_drive(problem.parameters, problem.chains, graph.smoothed, mean, point.rho)
    return [graph.with_rho(point, rho) for rho in found]


def _is_shown(structure: Structure, name: str, gain: float) -> bool:
    """Whether the likelihood shows a term by the decrease `gain` of the cost."""
    return is_shown(structure.graph.problem.parameters, structure.optimum, name, gain)


def _gains(structure: Structure, name: str, gain: float) -> bool:
    """Whether a term is as large as in cars, and shown by the decrease `gain` of the cost."""
    size = size_of_term(structure.graph.problem.parameters, structure.optimum, name)
    return size >= SIZE_MIN and _is_shown(structure, name, gain)


def _last_with(path: Sequence[Structure], name: str) -> Structure:
    """The last structure of a path that has a term."""
    return next(structure for structure in reversed(path) if name in structure.terms)


def _linearised_costs(structure: Structure) -> dict[str, float]:
    """Increase of the linearised cost by switching off each term."""
    return costs_of_terms(structure.graph.problem.parameters, structure.optimum, structure.terms)
