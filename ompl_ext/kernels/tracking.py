"""Tracking of a path by a car: progress along sampled paths, the kinodynamic law, and its closed loop with the model.

The law is Stanley's with speed and steering fed forward from the plan; `kraft.driving.control.path_tracking` makes its
arrays.  The closed loop is predicted many times in every cycle of the replanner, with the planner's own edges.

Hoffmann, Tomlin, Montemerlo, Thrun: Autonomous Automobile Trajectory Tracking for Off-Road Driving: Controller Design,
Experimental Validation and Racing. ACC 2007.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

from numba import types

from ompl_ext.arrays import Floats, Ints, Matrix, int64
from ompl_ext.jit import compiled, part
from ompl_ext.kernels import functions
from ompl_ext.kernels.functions import call_stop
from ompl_ext.kernels.kernel_types import LANE_WIDTH, LANES, PROBLEM, Lanes, Problem, numba_type
from ompl_ext.kernels.search import edge

ARRIVAL_TOLERANCE = 1e-3  # distance to the end of a path below which the car has arrived (m)
K_HOLD = 3.0  # share of full throttle per metre that a car which is held has drifted (1/m)
MOVING = 0.01  # speed above which a car is braked (m/s)

# Indices of where a tracker is: number of the current path, and its sample that was nearest to the car
PATH, SAMPLE = range(2)

# Rows of Track.samples: tracked point (m), heading of the car (rad, unwrapped), time (s, ascending), planned controls,
# unit vector in the direction of travel
X, Y, THETA, TIME, THROTTLE, STEERING, AHEAD_X, AHEAD_Y = range(8)
ROWS = 8

# Indices of Track.kind: 1 for a plan, time at which a manoeuvre begins (s, infinite without one), its number
IS_PLAN, BRAKES_AT, MANOEUVRE = range(3)

# Indices of Law.gain: on the cross-track error (1/s), on the heading, on the progress (1/m); speed added where the law
# divides by it (m/s), how far ahead it looks (s), and how far the tracked point is ahead of the centre (m); the command
# of steering per radian, and that of full throttle
K_PATH, K_HEADING, K_ALONG, SOFTENING, LOOK, OFFSET, RADIAN, FULL_THROTTLE = range(8)
GAINS = 8

# Indices of Law.where: components of the state and of a control, and the number of samples to each side of the last
# nearest one among which the next one is searched
AT_X, AT_Y, AT_THETA, AT_V, AT_THROTTLE, AT_STEERING, AT_WINDOW = range(7)


class Track(NamedTuple):
    """Paths of a reference, each with one direction of travel, one after the other; and its controls.

    Path k has the samples from `first[k]` to `first[k + 1]`, `spacing[k]` m apart; `direction[k]` is 1 forwards, -1
    backwards.
    """

    samples: Matrix  # (8, n)
    first: Ints  # (paths + 1,)
    direction: Ints  # (paths,)
    spacing: Floats  # (paths,)
    times: Floats  # (m,) of the reference
    controls: Matrix  # (m - 1, nu) from one time to the next
    rest: Floats  # (nu,)
    kind: Floats  # (3,)


class Law(NamedTuple):
    """Gains of the kinodynamic law, and the car: bounds of its controls, parameters and compiled functions."""

    gain: Floats  # (8,)
    where: Ints  # (7,)
    low: Floats  # (nu,)
    high: Floats  # (nu,)
    parameters: Floats  # (np,) those of the manoeuvres that stop it
    functions: Ints


class Ticks(NamedTuple):
    """Ticks of a controller: time (s), duration (s) and integration steps of each, and its time in the cycle (s)."""

    time: Floats  # (n,)
    duration: Floats  # (n,)
    steps: Ints  # (n,)
    since: Floats  # (n,)


@part
def samples_of(track: Track, path: int) -> int:
    """Number of samples of a path."""
    count: int = track.first[path + 1] - track.first[path]
    return count


@part
def count_until(times: Floats, first: int, end: int, time: float) -> int:
    """Number of the ascending times before index `end` that are at most `time`, those before `first` included."""
    low, high = first, end
    while low < high:
        middle = (low + high) // 2
        if time < times[middle]:
            high = middle
        else:
            low = middle + 1
    return low


@part
def arc_length_at(track: Track, path: int, time: float) -> float:
    """Planned arc length at `time` (s), m."""
    first, last = track.first[path], track.first[path + 1] - 1
    times, spacing = track.samples[TIME], track.spacing[path]
    k = count_until(times, first, last + 1, time) - 1
    if k < first:
        return 0.0
    if k >= last:
        return spacing * (last - first)
    return spacing * (1.0 / (times[k + 1] - times[k]) * (time - times[k]) + (k - first))


@part
def index_at(track: Track, path: int, arc_length: float) -> int:
    """Index in a path of the sample nearest to an arc length (m)."""
    spacing, last = track.spacing[path], samples_of(track, path) - 1.0
    if not (spacing > 0.0 and arc_length > 0.0):  # also of a state that is not a number
        return 0
    return round(min(arc_length / spacing, last))


@part
def select(track: Track, at: Ints, path: int, time: float) -> None:
    """Go on to a path, at the sample that is planned for `time` (s)."""
    at[PATH] = path
    at[SAMPLE] = index_at(track, path, arc_length_at(track, path, time))


@part
def advance_to(track: Track, at: Ints, time: float) -> None:
    """Advance to the path that is planned for `time` (s)."""
    while at[PATH] < len(track.direction) - 1 and time >= track.samples[TIME, track.first[at[PATH] + 1] - 1]:
        select(track, at, at[PATH] + 1, time)


@part
def nearest(track: Track, law: Law, path: int, x: float, y: float, start: int) -> int:
    """Index in a path of the sample nearest to a point, by local search from `start`, within a window to each side.

    The search repeats while it finds nearer samples.  It does not skip a loop of a path that crosses itself, and it
    recovers after the car was moved.
    """
    first, count, window = track.first[path], samples_of(track, path), law.where[AT_WINDOW]
    while True:
        low, high = max(start - window, 0), min(start + window + 1, count)
        found, least = low, math.inf
        for k in range(low, high):
            dx, dy = track.samples[X, first + k] - x, track.samples[Y, first + k] - y
            if dx * dx + dy * dy < least:
                found, least = k, dx * dx + dy * dy
        if abs(found - start) < window or found == 0 or found == count - 1 or found == start:
            return found
        start = found


@part
def project(track: Track, at: Ints, law: Law, state: Floats) -> tuple[float, float]:
    """Project the tracked point onto the current path, searching from the last nearest sample on, which it becomes.

    Returns the arc length up to the projection (m), along the tangents beyond the ends, and the offset of the car to
    the left of the path, left as seen by the car (m).
    """
    path, theta = at[PATH], state[law.where[AT_THETA]]
    direction = track.direction[path]
    offset = law.gain[OFFSET] * direction
    x = state[law.where[AT_X]] + offset * math.cos(theta)
    y = state[law.where[AT_Y]] + offset * math.sin(theta)
    at[SAMPLE] = nearest(track, law, path, x, y, at[SAMPLE])
    k = track.first[path] + at[SAMPLE]
    dx, dy = x - track.samples[X, k], y - track.samples[Y, k]
    ahead_x, ahead_y = track.samples[AHEAD_X, k], track.samples[AHEAD_Y, k]
    along = dx * ahead_x + dy * ahead_y
    aside = dx * (-direction * ahead_y) + dy * (direction * ahead_x)
    return track.spacing[path] * at[SAMPLE] + along, aside


@part
def is_past_end(track: Track, path: int, arc_length: float) -> bool:
    """Whether an arc length (m) is at or beyond the end of a path."""
    return arc_length >= track.spacing[path] * (samples_of(track, path) - 1) - ARRIVAL_TOLERANCE


@part
def planned_throttle(track: Track, law: Law, time: float) -> float:
    """Throttle that the reference holds at `time` (s)."""
    times, throttle = track.times, law.where[AT_THROTTLE]
    if time >= times[-1] or len(track.controls) == 0:
        return track.rest[throttle]
    k = max(count_until(times, int64(0), len(times), time) - 1, 0)
    held: float = track.controls[k, throttle]
    return held


@part
def angle_between(first: float, second: float) -> float:
    """Angle from the second to the first one within half a turn (rad): `math.remainder` by a turn, which is exact."""
    angle = first - second
    rest = abs(angle) % (2.0 * math.tau)
    if rest + rest > math.tau:
        rest -= math.tau
        if rest + rest >= math.tau:
            rest -= math.tau
    return -rest if angle < 0.0 else rest


@part
def slower(direction: int, one: float, other: float) -> float:
    """The one of two throttles that drives less in a direction of travel."""
    return min(one, other) if direction > 0 else max(one, other)


@part
def held_throttle(track: Track, law: Law, path: int, arc_length: float) -> float:
    """Throttle at rest; one that holds the car against a force is corrected by the way it has drifted."""
    throttle: float = track.rest[law.where[AT_THROTTLE]]
    if throttle != 0.0:
        length = track.spacing[path] * (samples_of(track, path) - 1)
        throttle += track.direction[path] * K_HOLD * law.gain[FULL_THROTTLE] * (length - arc_length)
    return throttle


@part
def limited(track: Track, law: Law, path: int, throttle: float, time: float, state: Floats, control: Floats) -> float:
    """At most the throttle with which the manoeuvre brakes the car at its present speed, as soon as it has begun.

    A car that is faster than planned would otherwise coast on where the planned throttle fades.  `control` is working
    memory.
    """
    speed = track.direction[path] * state[law.where[AT_V]]
    if time + law.gain[LOOK] < track.kind[BRAKES_AT] or speed <= MOVING:
        return throttle
    call_stop(law.functions[functions.STOP], (state, law.parameters, int(track.kind[MANOEUVRE]), control))
    return slower(track.direction[path], throttle, control[law.where[AT_THROTTLE]])


@part
def tracking_throttle(
    track: Track, law: Law, path: int, arc_length: float, time: float, state: Floats, control: Floats
) -> float:
    """Planned throttle plus feedback on the progress; a contingency never gets more throttle than planned.

    The planned throttle is that of the present time, not of the present position: otherwise a car that is a little
    ahead of a slow part of the plan would get the throttle of a later, faster part and get further ahead.
    """
    direction = track.direction[path]
    behind = arc_length_at(track, path, time) - arc_length
    planned = planned_throttle(track, law, time + law.gain[LOOK])
    throttle = planned + direction * law.gain[K_ALONG] * law.gain[FULL_THROTTLE] * behind
    if track.kind[IS_PLAN] == 1.0:
        return throttle
    if time >= track.times[-1]:
        throttle = planned = held_throttle(track, law, path, arc_length)
    return limited(track, law, path, slower(direction, throttle, planned), time, state, control)


@part
def steering_feedback(track: Track, law: Law, at: Ints, aside: float, speed: float, state: Floats) -> float:
    """Feedback on the angle of the wheels, rad (Hoffmann et al. 2007, eq. 5, with a softened denominator).

    The front axle moves in the direction theta + steering.  Its heading error relative to its path is therefore the
    heading error of the car plus the planned steering, which is fed forward.  In reverse, steering turns the car the
    other way, so the heading error changes its sign; the cross-track error does not.
    """
    gain, path = law.gain, at[PATH]
    heading = angle_between(track.samples[THETA, track.first[path] + at[SAMPLE]], state[law.where[AT_THETA]])
    return track.direction[path] * gain[K_HEADING] * heading - math.atan2(gain[K_PATH] * aside, speed + gain[SOFTENING])


@part
def command(track: Track, at: Ints, law: Law, time: float, state: Floats, control: Floats) -> None:
    """Write the control (nu,) of the kinodynamic law; past the end of the path it is the rest control."""
    advance_to(track, at, time + law.gain[LOOK])
    arc_length, aside = project(track, at, law, state)
    path = at[PATH]
    if path == len(track.direction) - 1 and is_past_end(track, path, arc_length):
        held = held_throttle(track, law, path, arc_length)
        throttle = limited(track, law, path, held, time, state, control)
        steering = track.rest[law.where[AT_STEERING]]
    else:
        speed = abs(state[law.where[AT_V]])
        ahead = track.first[path] + index_at(track, path, arc_length + law.gain[LOOK] * speed)
        turn = steering_feedback(track, law, at, aside, speed, state)
        steering = track.samples[STEERING, ahead] + law.gain[RADIAN] * turn
        throttle = tracking_throttle(track, law, path, arc_length, time, state, control)
    for k, value in ((law.where[AT_THROTTLE], throttle), (law.where[AT_STEERING], steering)):
        control[k] = min(max(value, law.low[k]), law.high[k])


@part
def is_resting(state: Floats, rest: Ints, largest: Floats) -> bool:
    """Whether a state is at standstill, as `Safety.is_resting`."""
    resting = True
    for k in range(len(rest)):
        resting = resting and abs(state[rest[k]]) <= largest[k]
    return resting


def _closed_loop(
    track: Track,
    at: Ints,
    law: Law,
    problem: Problem,
    work: Lanes,
    ticks: Ticks,
    until: float,
    rest: Ints,
    rest_speeds: Floats,
    states: Matrix,
    controls: Matrix,
) -> tuple[int, float]:
    """Drive from `states[0]` with the model and write states (n + 1, nx) and controls (n, nu) of the ticks.

    It ends early at standstill at or after `until` (s).  Returns the number of ticks and the least slack (m),
    infinite without one.
    """
    nx, nu, slack = states.shape[1], controls.shape[1], math.inf
    for tick in range(len(ticks.time)):
        state = states[tick]
        if ticks.time[tick] >= until and is_resting(state, rest, rest_speeds):
            return tick, slack
        command(track, at, law, ticks.time[tick], state, controls[tick])
        for k in range(nx):
            work.source[k] = state[k]
        for k in range(nu):
            work.control[k * LANE_WIDTH] = controls[tick, k]
        work.duration[0], work.steps[0] = ticks.duration[tick], ticks.steps[tick]
        edge(problem, work, ticks.since[tick])
        for k in range(nx):
            states[tick + 1, k] = work.trajectory[(work.steps[0] * nx + k) * LANE_WIDTH]
        slack = min(slack, work.slack[0])
    return len(ticks.time), slack


def _command(track: Track, at: Ints, law: Law, time: float, state: Floats, control: Floats) -> None:
    command(track, at, law, time, state, control)


def _project(track: Track, at: Ints, law: Law, state: Floats) -> tuple[float, float]:
    return project(track, at, law, state)


def _select(track: Track, at: Ints, path: int, time: float) -> None:
    select(track, at, path, time)


def _begin(track: Track, at: Ints, time: float) -> None:
    select(track, at, int64(0), time)
    advance_to(track, at, time)


@dataclass(frozen=True)
class Tracking:
    """Compiled functions above that Python calls; `begin` selects path and sample that are planned for a time (s)."""

    command: Callable[[Track, Ints, Law, float, Floats, Floats], None]
    closed_loop: Callable[..., tuple[int, float]]
    project: Callable[[Track, Ints, Law, Floats], tuple[float, float]]
    select: Callable[[Track, Ints, int, float], None]
    begin: Callable[[Track, Ints, float], None]


@cache
def tracking() -> Tracking:
    """The compiled functions; compiled, or loaded from the cache, on the first call."""
    track, law, ticks = numba_type(Track), numba_type(Law), numba_type(Ticks)
    number, floats, ints, matrix = types.float64, types.float64[::1], types.int64[::1], types.float64[:, ::1]
    pair: Any = types.Tuple
    projection, loop = pair((number, number)), pair((types.int64, number))
    of_loop = loop(track, ints, law, PROBLEM, LANES, ticks, number, ints, floats, matrix, matrix)
    return Tracking(
        compiled(_command, signature=types.void(track, ints, law, number, floats, floats)),
        compiled(_closed_loop, signature=of_loop),
        compiled(_project, signature=projection(track, ints, law, floats)),
        compiled(_select, signature=types.void(track, ints, types.int64, number)),
        compiled(_begin, signature=types.void(track, ints, number)),
    )
