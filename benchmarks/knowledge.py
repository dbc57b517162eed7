"""What unknown cars collide for want of: drives of prone worlds in which some of it is known from the start."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from benchmarks.effort import Effort
from benchmarks.estimated import driven, episode_parts
from benchmarks.parallel import each, grouped_interval, planning_vehicle
from benchmarks.report import Report, Row, row
from kraft.trial.result import Outcome, TrialSpec
from ompl_ext.vehicle import Vehicle

PRONE = (
    12048, 12172, 12563, 12613, 12703, 12720, 12737, 12746, 12780, 12800, 12836, 12841, 12898, 12927, 12956, 13042,
    13107, 13133, 13313, 13331, 13376, 13380, 13395, 13523, 13693, 13709, 13925,
)  # fmt: skip
"""Episodes of `estimated`, of 12000 to 13999, in which a car collided when they were first driven."""
DRIVE, TURNING, FORCE, DELAY = ("v_delta", "tau", "u_0"), ("L", "phi_diff"), ("a_x", "a_y"), ("delay",)
NARROWER = 0.1  # standard deviation of what is known, as a share of that of its prior
DELAY_STD = 0.01  # that of a known delay (s)


@dataclass(frozen=True)
class Known:
    """Parameters `names` that the robot knows, or the delay.

    Their priors have `narrower` times their deviation, and their means are moved to the truth by this share of the way.
    """

    names: tuple[str, ...] = ()
    moved: float = 1.0
    narrower: float = NARROWER


KNOWN = {
    "nothing more": Known(),
    "wheelbase and steering offset twice as wrong": Known(TURNING, -1.0, 1.0),
    "delay": Known(DELAY),
    "drive: gain, time constant, friction": Known(DRIVE),
    "wheelbase and steering offset": Known(TURNING),
    "force of the floor": Known(FORCE),
    "force and turning": Known((*FORCE, *TURNING)),
    "force and drive": Known((*FORCE, *DRIVE)),
    "all of it": Known((*DRIVE, *TURNING, *FORCE, *DELAY)),
}
"""What is known, by its description in the table.

The worlds are chosen by what happened there.  Whatever changes the plans from there on lets fewer cars collide, as the
second row shows, where the robot knows less.
"""


def run(effort: Effort) -> Report:
    """Drive every prone world as often as the effort says, with each kind of knowledge."""
    planning_vehicle(effort.method)
    drives = len(PRONE) * effort.again
    rows: list[Row] = []
    for label, known in KNOWN.items():
        found = each(partial(outcome, known=known, method=effort.method), range(drives), effort.jobs, chunk=2)
        rows.append(row_of(label, found))
    notes = [
        f"{effort.method}; {len(PRONE)} worlds of `estimated` in which a car collided; seeds of each: {effort.again}.",
        f"What is known has its true value and {NARROWER:g} of its prior's deviation, a delay {DELAY_STD:g} s.",
        "Intervals of 95 % by the bootstrap over worlds.",
    ]
    return Report("knowledge", rows, notes=notes)


def row_of(label: str, outcomes: Sequence[str]) -> Row:
    """Collisions among drives, of which every prone world has one after the other, again and again."""
    worlds = [Counter(outcomes[k :: len(PRONE)]) for k in range(len(PRONE))]
    hits, late = ([world[str(each)] for world in worlds] for each in (Outcome.COLLISION, Outcome.TIMEOUT))
    chance = grouped_interval(hits, [world.total() for world in worlds])
    counted = f"{sum(hits)} of {len(outcomes)}, {chance}; {sum(late)} timeouts"
    return row(f"collisions, known: {label} ({counted})", "%", [100.0 * sum(hits) / len(outcomes)])


def outcome(k: int, known: Known, method: str) -> str:
    """Outcome of drive k of the prone worlds, with what the robot knows."""
    number, again = PRONE[k % len(PRONE)], 1 + k // len(PRONE)
    spec, true = episode_parts(number, method, again)
    return str(driven(replace(spec, vehicle=knowing(spec, true, known)), true).outcome)


def knowing(spec: TrialSpec, true: Vehicle, known: Known) -> Vehicle:
    """The vehicle that the robot plans with, if it knows something of the `true` one, or the delay of commands."""
    vehicle, sensing = spec.vehicle, spec.scenario.sensing
    ranges, values = dict(vehicle.ranges), {}
    for name in vehicle.parameters.keys() & set(known.names):
        ranges[name] = replace(ranges[name], std=known.narrower * ranges[name].std)
        prior = vehicle.parameters[name]
        values[name] = prior + known.moved * (true.parameters[name] - prior)
    delay = vehicle.delay if "delay" not in known.names else (sensing.command_delay + sensing.latency, DELAY_STD)
    return replace(vehicle.with_parameters(values), ranges=ranges, delay=delay)
