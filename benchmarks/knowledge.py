"""What unknown cars collide for want of: drives of prone worlds in which some of it is known from the start."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import partial

from benchmarks.effort import Effort
from benchmarks.estimated import driven, episode_parts
from benchmarks.parallel import each, interval, planning_vehicle
from benchmarks.report import Report, Row, row
from kraft.trial.result import Outcome, TrialSpec
from ompl_ext.vehicle import Vehicle

PRONE = (
    12048, 12172, 12563, 12613, 12703, 12720, 12737, 12746, 12780, 12800, 12836, 12841, 12898, 12927, 12956, 13042,
    13107, 13133, 13313, 13331, 13376, 13380, 13395, 13523, 13693, 13709, 13925,
)  # fmt: skip
"""Episodes of `estimated`, of 12000 to 13999, in which a car collided when they were first driven."""
DRIVE, TURNING, FORCE, DELAY = ("v_delta", "tau", "u_0"), ("L", "phi_diff"), ("a_x", "a_y"), ("delay",)
KNOWN = {
    "nothing more": (),
    "delay": DELAY,
    "drive: gain, time constant, friction": DRIVE,
    "wheelbase and steering offset": TURNING,
    "force of the floor": FORCE,
    "force and turning": (*FORCE, *TURNING),
    "force and drive": (*FORCE, *DRIVE),
    "all of it": (*DRIVE, *TURNING, *FORCE, *DELAY),
}
"""What is known, by its description in the table."""
NARROWER = 0.1  # standard deviation of what is known, as a share of that of its prior
DELAY_STD = 0.01  # that of a known delay (s)


def run(effort: Effort) -> Report:
    """Drive every prone world as often as the effort says, with each kind of knowledge."""
    planning_vehicle(effort.method)
    drives = len(PRONE) * effort.again
    rows: list[Row] = []
    for known, names in KNOWN.items():
        found = Counter(each(partial(outcome, names=names, method=effort.method), range(drives), effort.jobs, chunk=2))
        hits, late = found[str(Outcome.COLLISION)], found[str(Outcome.TIMEOUT)]
        label = f"collisions, known: {known} ({hits} of {drives}, {interval(hits, drives)}; {late} timeouts)"
        rows.append(row(label, "%", [100.0 * hits / drives]))
    notes = [
        f"{effort.method}; {len(PRONE)} worlds of `estimated` in which a car collided; seeds of each: {effort.again}.",
        f"What is known has its true value and {NARROWER:g} of its prior's deviation, a delay {DELAY_STD:g} s.",
    ]
    return Report("knowledge", rows, notes=notes)


def outcome(k: int, names: tuple[str, ...], method: str) -> str:
    """Outcome of drive k of the prone worlds, where the robot knows the parameters `names`."""
    number, again = PRONE[k % len(PRONE)], 1 + k // len(PRONE)
    spec, true = episode_parts(number, method, again)
    return str(driven(replace(spec, vehicle=knowing(spec, true, names)), true).outcome)


def knowing(spec: TrialSpec, true: Vehicle, names: tuple[str, ...]) -> Vehicle:
    """The vehicle that the robot plans with, knowing some parameters of the `true` one, or the delay of commands."""
    vehicle, sensing = spec.vehicle, spec.scenario.sensing
    known = [name for name in names if name in vehicle.parameters]
    ranges = {name: replace(vehicle.ranges[name], std=NARROWER * vehicle.ranges[name].std) for name in known}
    delay = vehicle.delay if "delay" not in names else (sensing.command_delay + sensing.latency, DELAY_STD)
    return replace(
        vehicle.with_parameters({name: true.parameters[name] for name in known}),
        ranges={**vehicle.ranges, **ranges},
        delay=delay,
    )
