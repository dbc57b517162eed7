"""Motion that a vehicle is capable of, seen in simulated motions of its model: rates, ranges and body velocities."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np

from ompl_ext.arrays import Floats, Ints, Matrix
from ompl_ext.kernels.specialise import model_step
from ompl_ext.vehicle import Vehicle

STEP = 0.05  # of the simulated motions (s)
ROLLOUTS, SEGMENTS, SEGMENT_STEPS = 48, 12, 10  # random motions, constant controls of each, steps of each of these
HELD_STEPS = 100  # of the motions with one control each, at its bounds or zero
CORNERS = 3  # most controls whose lowest, zero and highest values are all combined; of more, random combinations
ON_BOUND = 1 / 3  # share of the random controls on each bound
CACHED = 16  # vehicles whose motions are kept
EDGE_DURATIONS = (0.5, 1.0)  # shortest and longest edge for most vehicles (s)
SLOW_RESPONSE = 1.2  # time to the top speed above which edges are longer (s)
PREFER_SLOW = 0.05  # share of a twist's size that counts against it: of almost equal twists the slowest is taken
NEGLIGIBLE = 0.02  # share of the largest twist below which a twist counts as none, or two count as the same

_cache: OrderedDict[tuple[object, ...], Motion] = OrderedDict()


@dataclass(frozen=True)
class Motion:
    """What was seen in motions from standstill, or as near to it as possible, within the vehicle's limits.

    `low`, `high`, `rate` (nx,): smallest and largest value and largest rate of each state component.  `twists` (n, 3)
    are velocities ahead and to the left (m/s) and turning rates (rad/s), relative to the body, `states` (n, nx) and
    `controls` (n, nu) those at which they were seen.
    """

    low: Floats
    high: Floats
    rate: Floats
    twists: Matrix
    states: Matrix
    controls: Matrix

    def extreme_twists(self, length: float) -> tuple[Matrix, Ints]:
        """Twists (n, 3) that are extreme in some direction, and their numbers: time-optimal motions consist of these.

        A turning rate counts as the speed of a point `length` m away.  Of almost equal twists the slowest is taken.
        """
        grid = [-1.0, 0.0, 1.0]
        found: list[int] = []
        scaled = self.twists * (1.0, 1.0, length)
        size = np.linalg.norm(scaled, axis=1)
        for direction in np.array([(a, b, c) for a in grid for b in grid for c in grid if a or b or c]):
            support = scaled @ (direction / np.linalg.norm(direction))
            best = int(np.argmax(support - PREFER_SLOW * size))
            if support[best] > NEGLIGIBLE * size.max():
                found.append(best)
        found = _distinct(scaled, found)
        chosen = scaled[found]
        chosen[np.abs(chosen) < 2.0 * NEGLIGIBLE * size.max()] = 0.0
        return chosen / (1.0, 1.0, length), np.array(found)


def _distinct(scaled: Matrix, indices: list[int]) -> list[int]:
    kept: list[int] = []
    least = NEGLIGIBLE * np.linalg.norm(scaled, axis=1).max()
    for index in indices:
        if all(np.linalg.norm(scaled[index] - scaled[other]) > least for other in kept):
            kept.append(index)
    return kept


def motion_key(vehicle: Vehicle) -> tuple[object, ...]:
    """Key that is the same for vehicles with the same motion: of the model, the parameters and the bounds."""
    parts = vehicle.parameter_array, vehicle.control_bounds, vehicle.state_limits
    functions = vehicle.derivative, vehicle.actuation, vehicle.stop  # without source the hash has only their names
    return (vehicle.hash, *map(id, functions), *(part.tobytes() for part in parts))


def motion_of(vehicle: Vehicle) -> Motion:
    """Motion of a vehicle, simulated once for its model, parameters and bounds."""
    key = motion_key(vehicle)
    if key not in _cache:
        _cache[key] = _simulate(vehicle)
        if len(_cache) > CACHED:
            _cache.popitem(last=False)
    return _cache[key]


def edge_durations(vehicle: Vehicle) -> tuple[float, float]:
    """Shortest and longest edge (s) that suit a vehicle: longer ones if it accelerates slowly, or is slow for its size.

    Such a vehicle hardly moves in a short edge, and a tree of such edges does not get anywhere: the longest edge leads
    as far as the vehicle is long, or farther.
    """
    shortest, longest = EDGE_DURATIONS
    response = _response_time(vehicle)
    if response > SLOW_RESPONSE:
        shortest, longest = shortest * response, 1.5 * longest * response
    passing = vehicle.footprint.length / vehicle.top_speed
    return max(shortest, 0.5 * passing), max(longest, passing)


def _response_time(vehicle: Vehicle) -> float:
    """Time to the top speed at the acceleration from standstill (s); 0 for a vehicle without a speed."""
    if not vehicle.rest:
        return 0.0
    advance, state, k = model_step(vehicle), np.zeros(len(vehicle.state)), vehicle.rest_indices[0]
    largest, after = 0.0, np.zeros(len(vehicle.state))
    for control in corners(vehicle.control_bounds, np.random.default_rng(0)):
        advance(state, np.ascontiguousarray(control), vehicle.parameter_array, STEP, after)
        largest = max(largest, abs(float(after[k])) / STEP)
    return vehicle.top_speed / largest if largest > 0.0 else 0.0


def _simulate(vehicle: Vehicle) -> Motion:
    random, bounds = np.random.default_rng(0), vehicle.control_bounds
    idle = np.clip(0.0, bounds[:, 0], bounds[:, 1])
    held = [[control, idle] for control in corners(bounds, random)]  # idle: on at a speed that is limited
    varied = [[_random_control(bounds, random) for _ in range(SEGMENTS)] for _ in range(ROLLOUTS)]
    pieces = [_rollout(vehicle, controls, HELD_STEPS) for controls in held]
    pieces += [_rollout(vehicle, controls, SEGMENT_STEPS) for controls in varied]
    before, after, controls = (np.vstack([piece[part] for piece in pieces]) for part in range(3))
    rates = (after - before) / STEP
    theta = vehicle.index("theta")
    heading = 0.5 * (before[:, theta] + after[:, theta]) if theta >= 0 else np.zeros(len(before))
    vx, vy = (rates[:, vehicle.index(name)] for name in ("x", "y"))
    c, s = np.cos(heading), np.sin(heading)
    turning = rates[:, theta] if theta >= 0 else np.zeros(len(before))
    twists = np.column_stack([c * vx + s * vy, c * vy - s * vx, turning])
    seen = np.vstack([before, after])
    return Motion(seen.min(axis=0), seen.max(axis=0), np.abs(rates).max(axis=0), twists, after, controls)


def corners(bounds: Matrix, random: np.random.Generator) -> list[Floats]:
    """Controls (nu,) of which every component is lowest, highest or nearest to zero; of many components random ones."""
    middle = np.clip(0.0, bounds[:, 0], bounds[:, 1])
    levels = np.column_stack([bounds[:, 0], middle, bounds[:, 1]])
    if len(bounds) > CORNERS:
        return [levels[np.arange(len(bounds)), random.integers(3, size=len(bounds))] for _ in range(3**CORNERS)]
    mesh = np.meshgrid(*levels, indexing="ij")
    return list(np.stack(mesh, axis=-1).reshape(-1, len(bounds)))


def _random_control(bounds: Matrix, random: np.random.Generator) -> Floats:
    share = np.clip((random.random(len(bounds)) - ON_BOUND) / (1.0 - 2.0 * ON_BOUND), 0.0, 1.0)
    return bounds[:, 0] + share * (bounds[:, 1] - bounds[:, 0])


def _rollout(vehicle: Vehicle, controls: list[Floats], steps: int) -> tuple[Matrix, Matrix, Matrix]:
    """States (n, nx) before and after each step, and controls (n, nu).

    The motion begins at standstill, or as near to it as the limits allow.  A step that leaves them is not made.
    """
    advance, parameters, limits = model_step(vehicle), vehicle.parameter_array, vehicle.state_limits
    for name in ("x", "y"):
        limits[vehicle.index(name)] = -math.inf, math.inf
    state, before, after, held = np.clip(np.zeros(len(vehicle.state)), *limits.T), [], [], []
    bounded = np.flatnonzero(np.isfinite(limits).any(axis=1))
    low, high = limits[bounded].T
    for control in map(np.ascontiguousarray, controls):
        for _ in range(steps):
            following = np.empty_like(state)
            advance(state, control, parameters, STEP, following)
            if len(bounded) and (np.any(following[bounded] < low) or np.any(following[bounded] > high)):
                break
            before.append(state)
            after.append(following)
            held.append(control)
            state = following
    widths = len(state), len(state), len(vehicle.controls)
    first, second, third = (
        np.array(rows).reshape(-1, width) for rows, width in zip((before, after, held), widths, strict=True)
    )
    return first, second, third
