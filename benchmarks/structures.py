"""Choice of a model of cars with random terms: how often it finds them, and what the choice costs in prediction.

The cars are driven by an own integration, in which friction, dead zone and the sides of the steering are sharp.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from benchmarks.coulomb import driven
from benchmarks.effort import Effort
from benchmarks.report import Report, Row, Target, row
from benchmarks.synthetic_logs import FINE, CommandSeries, synthetic_logs
from kraft.logs.log import Log
from kraft.sysid.interface import Settings
from kraft.sysid.model_choice import identify_car
from kraft.sysid.optimiser import inverse
from kraft.sysid.prediction import predict_windows, process_noise, window_errors
from kraft.sysid.structure import Structure, StructureSearch
from kraft.vehicles.config import VehicleConfig, load_vehicle_config
from kraft.vehicles.load import load_vehicle
from ompl_ext.vehicle import Vehicle

RANGES: Final[Mapping[str, tuple[float, float]]] = {
    "asymmetry": (0.1, 0.3),
    "saturation": (0.6, 1.5),
    "dead_zone": (0.08, 0.2),
    "progression": (0.3, 0.8),
    "brake": (1.5, 3.0),
    "back_emf": (0.6, 2.0),
    "friction": (0.4, 1.5),
    "drag": (0.1, 0.3),
    "scrub": (0.3, 1.0),
    "understeer": (0.05, 0.2),
    "slide": (0.1, 0.25),
    "slip": (0.02, 0.06),
    "skid": (0.5, 2.0),
    "tau_steer": (0.15, 0.3),
    "tau_yaw": (0.15, 0.3),
    "rate_limit": (0.15, 0.5),
    "delay": (0.05, 0.2),
    "lever": (0.05, 0.2),
    "yaw_offset": (0.03, 0.1),
    "effort": (0.3, 0.6),
    "coast": (0.5, 2.0),
}
"""Sizes of the terms that are on."""
SIGNED: Final = ("asymmetry", "lever", "yaw_offset")
ON: Final = 0.4
"""Probability of a term."""
CARS: Final = 20
LOGS, UNSEEN, SECONDS, RATE = 10, 5, 30.0, 20.0
NOISE: Final = (0.003, 0.009)
OFF: Final = 0.005
"""Most by which the commands of some cars act before or after their recorded times, s."""
HIDDEN: Final = 3.0
"""Size of a term, in standard deviations of a fit of the terms that are there, up to which it cannot be told."""
WORSE: Final = 1.1
"""Largest error over that of the best fixed choice."""


@dataclass(frozen=True)
class Trial:
    """The choice for one random car."""

    there: frozenset[str]
    found: frozenset[str]
    hidden: frozenset[str]
    """terms that are there, but not larger than `HIDDEN` standard deviations of what the logs tell about them"""
    errors: Mapping[str, float]
    """errors after 3 s of drives that nothing was fitted to, by choice: auto, all terms, the terms that are there, m"""

    @property
    def is_exact(self) -> bool:
        """Whether the terms that can be told were found, and no others than those that are there."""
        return self.there - self.hidden <= self.found <= self.there

    @property
    def ratio(self) -> float:
        """Error of the automatic choice over that of the best fixed one."""
        return self.errors["auto"] / min(error for name, error in self.errors.items() if name != "auto")

    @property
    def text(self) -> str:
        """Terms that are missed or too many, and the errors."""
        wrong = [*(f"-{name}" for name in sorted(self.there - self.found))]
        wrong += [f"+{name}" for name in sorted(self.found - self.there)]
        errors = ", ".join(f"{name} {100.0 * error:.2f} cm" for name, error in self.errors.items())
        return f"{len(self.there)} terms, {' '.join(wrong) or 'all found'}; {errors}"


def random_truth(rng: np.random.Generator) -> dict[str, float]:
    """Parameters of a car with random terms; those that it lacks are at their neutral values."""
    specs = load_vehicle_config("car-lag").parameters
    truth = {name: spec.neutral for name, spec in specs.items() if spec.neutral is not None}
    truth |= {"phi_diff": rng.normal(0.0, 0.02), "steer": rng.uniform(0.3, 0.5), "a_drive": rng.uniform(3.0, 6.0)}
    truth |= {"damping": rng.uniform(0.6, 1.2)}
    for name, (low, high) in RANGES.items():
        size, sign = rng.uniform(low, high), rng.choice([-1.0, 1.0]) if name in SIGNED else 1.0
        if rng.random() < ON:
            truth[name] = sign * size
    if truth["slide"] == truth["understeer"] == 0.0:  # the front wheels do not slip: skid has no effect
        truth["skid"] = 0.0
    return truth


def terms_of(truth: Mapping[str, float]) -> frozenset[str]:
    """Terms that are on."""
    neutral = {name: spec.neutral for name, spec in load_vehicle_config("car-lag").parameters.items()}
    return frozenset(name for name in RANGES if name in truth and truth[name] != neutral.get(name, 0.0))


def commands(rng: np.random.Generator) -> CommandSeries:
    """Levels of throttle and steering, among them coasting and braking.

    They change where a step of the synthetic drive begins.  Otherwise every change would act up to half a step earlier
    or later than recorded, which moves the car by far more than the noise of its poses: no term is such an effect.
    """
    times = np.cumsum([0.0, *rng.uniform(0.5, 1.8, round(2 * SECONDS))])
    times = FINE * np.round(times[times < SECONDS - FINE] / FINE)
    throttle = rng.uniform(0.2, 1.0, len(times))
    kind = rng.random(len(times))
    throttle = np.where(kind < 0.12, 0.0, np.where(kind < 0.24, -0.6 * throttle, throttle))
    return times, np.column_stack([throttle, rng.uniform(-1.0, 1.0, len(times))])


def drives(truth: Mapping[str, float], seeds: Sequence[int], off: float = 0.0) -> list[Log]:
    """Logs of a car, one per seed; each command acts up to `off` s before or after its recorded time."""
    names = load_vehicle_config("car-lag").parameters
    vehicle = load_vehicle("car-lag", parameters={name: value for name, value in truth.items() if name in names})
    whole = dict(vehicle.parameters)
    given = [commands(np.random.default_rng([seed, 1])) for seed in seeds]
    logs = synthetic_logs(
        vehicle,
        truth,
        seeds,
        seconds=SECONDS,
        noise=NOISE,
        rate=RATE,
        commands=given,
        motion=lambda acting: driven(whole, acting, FINE),
    )
    return [_stamped(log, off, np.random.default_rng([seed, 2])) for log, seed in zip(logs, seeds, strict=True)]


def _stamped(log: Log, off: float, rng: np.random.Generator) -> Log:
    """The log with times of its commands, except for the first, that are up to `off` s wrong."""
    (part,) = log.parts
    wrong = rng.uniform(-off, off, len(part.command_times))
    times = part.command_times + np.where(part.command_times > 0.0, wrong, 0.0)
    return replace(log, parts=(replace(part, command_times=times),))


def trial(seed: int, off: float = 0.0) -> Trial:
    """Choose a model for a random car, and compare it with fixed choices on other drives; `off` as for `drives`."""
    truth = random_truth(np.random.default_rng([seed, 0]))
    seeds = range(100 * seed, 100 * seed + LOGS + UNSEEN)
    logs = drives(truth, seeds, off)
    fitted, unseen, settings = logs[:LOGS], logs[LOGS:], Settings()
    auto = identify_car(fitted, settings)
    identified = auto.identification
    found = next((t.terms for t in identified.trials if t.chosen), identified.auxiliary)
    errors = {"auto": error(auto.base.definition, unseen, identified.values, identified.predicting(settings))}
    vehicle, there = load_vehicle_config("car-lag"), terms_of(truth)
    search = StructureSearch(vehicle, fitted, settings, lambda *_: None)
    every = search.full()
    exact = search.without(every, *(name for name in search.candidates if name not in there))
    every, exact = search.converged(every), search.converged(exact)
    for name, fixed in (("all terms", every), ("terms that are there", exact)):
        values = dict(zip(fixed.graph.problem.parameters.names, map(float, fixed.optimum.point.rho), strict=True))
        walks = process_noise(search.model, search.growth, settings.horizon)
        process = {component: deviation for component, deviation in walks.items() if deviation > 0.0}
        known = replace(settings, process=process, variation=search.variation.total)
        errors[name] = error(vehicle, unseen, values, known)
    return Trial(there, frozenset(found), hidden_terms(exact, truth, there), errors)


def hidden_terms(exact: Structure, truth: Mapping[str, float], there: frozenset[str]) -> frozenset[str]:
    """Terms that the logs do not tell from none, even if it is known which other terms there are.

    Grip, for example, of a car that never drives fast enough to reach its limit: no choice can find such a term.
    """
    parameters, factors = exact.graph.problem.parameters, exact.optimum.factors
    free = np.flatnonzero(parameters.free)
    variance = np.diag(inverse(factors.total_information[np.ix_(free, free)]))
    deviation = {parameters.names[k]: math.sqrt(v) for k, v in zip(free, variance, strict=True)}
    neutral = {spec.name: spec.neutral or 0.0 for spec in parameters.specs}
    return frozenset(
        name for name in there & deviation.keys() if abs(truth[name] - neutral[name]) < HIDDEN * deviation[name]
    )


def error(vehicle: VehicleConfig | Vehicle, logs: Sequence[Log], values: Mapping[str, float], known: Settings) -> float:
    """Position error after 3 s, m."""
    return window_errors(predict_windows(vehicle, logs, values, known)).position[3.0]


def run(effort: Effort) -> Report:
    """Measure over random cars."""
    count = min(effort.seeds, CARS)
    exact, stamped = ([_reported(seed, off) for seed in range(count)] for off in (0.0, OFF))
    told = [float(t.is_exact) for t in stamped]
    many = [float(len(t.found - t.there)) for t in stamped]
    return Report(
        "structures",
        [
            *rows(exact),
            row(f"commands up to {1000 * OFF:g} ms off: the same of the terms that can be told", "1", told, more=True),
            row(f"commands up to {1000 * OFF:g} ms off: terms too many, of each car", "1", many),
        ],
    )


def _reported(seed: int, off: float) -> Trial:
    found = trial(seed, off)
    print(seed, found.text, file=sys.stderr, flush=True)
    return found


def rows(trials: Sequence[Trial]) -> list[Row]:
    """Summary of the trials."""
    exact = [float(t.found == t.there) for t in trials]
    told = [float(t.is_exact) for t in trials]
    right = [float((name in t.found) == (name in t.there)) for t in trials for name in RANGES]
    return [
        row(f"the same terms, share of {len(trials)} cars", "1", [float(np.mean(exact))], Target(0.9, most=False)),
        row("the same of those that the logs can tell, share of the cars", "1", [float(np.mean(told))], more=True),
        row("terms there that the logs cannot tell, of each car", "1", [float(len(t.hidden)) for t in trials]),
        row("terms rightly on or off, share", "1", [float(np.mean(right))], more=True),
        row("terms missed, of each car", "1", [float(len(t.there - t.found)) for t in trials]),
        row("terms too many, of each car", "1", [float(len(t.found - t.there)) for t in trials]),
        row("error after 3 s, auto", "cm", [100.0 * t.errors["auto"] for t in trials]),
        row("over that of the best fixed choice", "times", [t.ratio for t in trials], Target(WORSE, of="worst")),
    ]
