"""Theorem 1 where the deviation is not bounded by construction but estimated: random arenas, cars, delays and errors.

Everything on the robot's side is that of a trial: estimator, identification, bound, planner, contingencies, controller.
The true car is the vehicle's own compiled model with other parameters, which costs less than MuJoCo.  The theorem holds
as often as its assumption does, that no point of the car deviates by more than delta from the prediction.
"""

from __future__ import annotations

import math
import time as clock
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from benchmarks.effort import Effort
from benchmarks.parallel import each, grouped_interval, interval, planning_vehicle
from benchmarks.random_arenas import random_arena
from benchmarks.report import Report, Row, Target, row
from kraft.driving.method import Method, load_method
from kraft.simulation.model_world import ModelWorld
from kraft.trial.measures import farthest_point
from kraft.trial.result import Outcome, TrialResult, TrialSpec
from kraft.trial.trial import run_trial
from kraft.vehicles.load import load_vehicle
from ompl_ext.interpolation import interpolated_rows
from ompl_ext.vehicle import Vehicle

ITERATIONS = (200, 400)  # of a cycle, instead of 500 and 1000: more episodes for the same time
TIMEOUT = 30.0  # s
DELAYS = {"command_delay": 0.25, "latency": 0.15, "communication_delay": 0.2}
"""Largest of each random delay, s; that of commands and that of poses together are within the estimator's range."""
NOISE = (0.5, 1.5)  # factor on the errors of poses
CORRELATION = (0.0, 1.5)  # time constant of the errors (s)
OTHER_SEEDS = 1_000_003  # between the seeds of two drives of the same world and car
SPREAD = 1.5  # standard deviations of the prior within which the parameters of a car are
HOLD = 0.45  # throttle that holds the car against its force, at most


@dataclass(frozen=True)
class Episode:
    """How a drive went, and how often its bound held.

    `ticks` are those of the controller with a bound, `held` those at which no point of the car was farther from the
    prediction than delta; `broken` is the number of the `cycles` with a tick at which one was.  `delta` (m) and
    `deviation` (m) are the means over the ticks.  `judged_to_end` is whether the last of the ticks is less than a tick
    before the end; if not, nothing is known of a collision there.  `collided_within_delta` is whether delta held at it.
    """

    number: int
    outcome: str
    time: float
    ticks: int
    held: int
    cycles: int
    broken: int
    delta: float
    deviation: float
    judged_to_end: bool
    collided_within_delta: bool
    seconds: float


def run(effort: Effort) -> Report:
    """Drive all episodes."""
    planning_vehicle(effort.method)
    method = load_method(effort.method)
    level = method.planner.bound.level if method.planner.bound else None
    began = clock.perf_counter()
    episodes = each(partial(episode, name=effort.method), range(effort.estimated), effort.jobs, chunk=4)
    hits = [e.number for e in episodes if e.outcome == Outcome.COLLISION]
    further = each(partial(_further, numbers=hits, name=effort.method), range(effort.again * len(hits)), effort.jobs)
    took = clock.perf_counter() - began
    return report(episodes, level, took, effort, further)


def _further(k: int, numbers: Sequence[int], name: str) -> Episode:
    """Drive number k of the further ones in the worlds of some episodes."""
    return episode(numbers[k % len(numbers)], name, 1 + k // len(numbers))


def report(
    episodes: Sequence[Episode], level: float | None, took: float, effort: Effort, further: Sequence[Episode] = ()
) -> Report:
    """Table of the episodes, against the level that the method states, if it states one.

    `further` ones are drives of worlds in which one collided.
    """
    total = sum(e.seconds for e in episodes)
    count = {outcome: [e for e in episodes if e.outcome == outcome] for outcome in map(str, Outcome)}
    drives, allowed = len(episodes), None if level is None else Target(100.0 * (1.0 - level))
    hits = count["collision"]
    rows = [
        row("episodes", "", [drives]),
        row(f"collisions ({interval(len(hits), drives)})", "%", [100.0 * len(hits) / drives], allowed),
        row(f"timeouts ({interval(len(count['timeout']), drives)})", "%", [100.0 * len(count["timeout"]) / drives]),
        row("time of the successful ones", "s", [e.time for e in count["success"]]),
        *delta_rows(episodes, allowed),
        row("processor time of an episode", "s", [e.seconds for e in episodes]),
        *further_rows(further),
    ]  # fmt: skip
    notes = [
        f"{effort.method} with {ITERATIONS[0]} to {ITERATIONS[1]} iterations a cycle; "
        f"{'no level' if level is None else f'level {level:g}'}; 95 % intervals.",
        "Changes were kept or refused by some of these worlds; those from 12000 on only after they were measured.",
        f"Processor time {total:,.0f} s in {effort.jobs} processes, {took:,.0f} s of wall clock.",
    ]
    if hits:
        notes.append(f"collisions in episodes {[e.number for e in hits][:40]}")
    return Report("estimated", rows, notes=notes)


def delta_rows(episodes: Sequence[Episode], allowed: Target | None) -> list[Row]:
    """How often delta held; no rows of a method without a clearance."""
    ticks, held, cycles, broken = (
        sum(getattr(e, name) for e in episodes) for name in ("ticks", "held", "cycles", "broken")
    )
    if ticks == 0:
        return []
    hits, drives = [e for e in episodes if e.outcome == Outcome.COLLISION], len(episodes)
    some = sum(e.broken > 0 for e in episodes)
    return [
        row("collisions at a tick at which delta held", "", [sum(e.collided_within_delta for e in hits)]),
        row("collisions without a tick with a bound just before", "", [sum(not e.judged_to_end for e in hits)]),
        row(f"ticks at which delta did not hold, of {ticks:,}", "%", [100.0 * (1.0 - held / ticks)], allowed),
        row(f"cycles with such a tick, of {cycles:,} ({interval(broken, cycles)})", "%", [100.0 * broken / cycles]),
        row(f"episodes with such a tick ({interval(some, drives)})", "%", [100.0 * some / drives]),
        row("mean delta", "mm", [1000.0 * e.delta for e in episodes if e.ticks]),
        row("mean deviation", "mm", [1000.0 * e.deviation for e in episodes if e.ticks]),
    ]


def further_rows(further: Sequence[Episode]) -> list[Row]:
    """What came of further drives of the worlds in which an episode collided.

    A third of them collide, so that two versions can be compared with a fortieth of the drives that it takes
    on all worlds.  The interval is bootstrapped over worlds, since the drives of one are alike.
    """
    if not further:
        return []
    worlds, hits = (
        Counter(e.number for e in further),
        Counter(e.number for e in further if e.outcome == Outcome.COLLISION),
    )
    always = sum(hits[world] == drives for world, drives in worlds.items())
    chance = grouped_interval([hits[world] for world in worlds], list(worlds.values()))
    return [
        row(f"collisions in {len(further)} further drives of these worlds, other seeds ({chance})", "%",
            [100.0 * hits.total() / len(further)]),
        row(f"worlds in which each of these collides, of {len(worlds)}", "", [always]),
        row("timeouts in these drives", "%",
            [100.0 * sum(e.outcome == Outcome.TIMEOUT for e in further) / len(further)]),
    ]  # fmt: skip


def episode(number: int, name: str, again: int = 0) -> Episode:
    """Drive episode `number`; `again` is the number of another drive of its world and car, with other seeds."""
    began = clock.process_time()
    spec, true = episode_parts(number, name, again)
    return judged(number, driven(spec, true), spec.vehicle, clock.process_time() - began)


def driven(spec: TrialSpec, true: Vehicle) -> TrialResult:
    """Result of a trial with this true car."""
    return run_trial(spec, world=ModelWorld(spec.scenario, true, {}, spec.seed))


def episode_parts(number: int, name: str, again: int = 0) -> tuple[TrialSpec, Vehicle]:
    """Trial of an episode, or number `again` of its other ones, and its true car."""
    rng = np.random.default_rng([31, number])
    sensing = {key: float(rng.uniform(0.0, most)) for key, most in DELAYS.items()}
    sensing |= {"noise_scale": float(rng.uniform(*NOISE)), "correlation_time": float(rng.uniform(*CORRELATION))}
    scenario = random_arena(number, "open", (1.0, 1.0), sensing=sensing, trial={"timeout": TIMEOUT})
    method = load_method(name)
    vehicle = load_vehicle(method.planner.vehicle or scenario.vehicle)
    return TrialSpec(scenario, cheaper(method), vehicle, number + OTHER_SEEDS * again), random_car(rng, vehicle)


def cheaper(method: Method) -> Method:
    """The method with fewer iterations."""
    least, most = ITERATIONS
    planner = method.planner.model_copy(update={"iterations": least, "max_iterations": most})
    return method.model_copy(update={"planner": planner})


def random_car(rng: np.random.Generator, vehicle: Vehicle) -> Vehicle:
    """A car with random parameters within their ranges, which the throttle can hold against its force."""
    while True:
        values = {}
        for name, value in vehicle.parameters.items():
            bounds = vehicle.ranges[name]
            low, high = max(bounds.low, value - SPREAD * bounds.std), min(bounds.high, value + SPREAD * bounds.std)
            values[name] = float(rng.uniform(low, high))
        force = math.hypot(values.get("a_x", 0.0), values.get("a_y", 0.0))
        if force * values["tau"] * (1.0 - values["u_0"]) <= HOLD * values["v_delta"]:
            return replace(vehicle, parameters=values)


def judged(number: int, result: TrialResult, vehicle: Vehicle, seconds: float) -> Episode:
    """Compare the true motion of each cycle with its prediction and its delta."""
    times, truth = np.array([s.time for s in result.steps]), np.array([s.pose for s in result.steps])
    driven = np.array([not s.watchdog for s in result.steps])
    pose = [vehicle.index(name) for name in ("x", "y", "theta")]
    apart, deltas, cycle_of, last_judged = [np.zeros(0)], [np.zeros(0)], [np.zeros(0, dtype=int)], -math.inf
    ends = [cycle.time for cycle in result.cycles[1:]] + [math.inf]
    for k, (cycle, end) in enumerate(zip(result.cycles, ends, strict=True)):
        predicted = cycle.predicted
        last = min(end, float(predicted.times[-1]))
        within = driven & (times >= cycle.time - 1e-9) & (times < last - 1e-9)
        if predicted.delta is None or not within.any():
            continue
        expected = interpolated_rows(times[within], predicted.times, predicted.states[:, pose])
        apart.append(farthest_point(truth[within], expected, vehicle.footprint))
        deltas.append(np.interp(times[within], predicted.times, predicted.delta))
        cycle_of.append(np.full(int(within.sum()), k))
        last_judged = float(times[within][-1])
    deviation, delta, cycles = np.concatenate(apart), np.concatenate(deltas), np.concatenate(cycle_of)
    held = deviation <= delta
    tick = float(np.diff(times).max()) if len(times) > 1 else math.inf
    to_end = bool(last_judged > result.time - tick - 1e-9)
    return Episode(
        number=number,
        outcome=str(result.outcome),
        time=result.time,
        ticks=len(held),
        held=int(held.sum()),
        cycles=len(np.unique(cycles)),
        broken=len(np.unique(cycles[~held])),
        delta=float(delta.mean()) if len(delta) else 0.0,
        deviation=float(deviation.mean()) if len(deviation) else 0.0,
        judged_to_end=to_end,
        collided_within_delta=bool(result.outcome is Outcome.COLLISION and to_end and held[-1]),
        seconds=seconds,
    )
