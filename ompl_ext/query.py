"""What a query asks of the planner: goal, SAFETY, settings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import chain
from numbers import Integral

import numpy as np

from ompl_ext.arrays import Bools, Floats
from ompl_ext.kernels.kernel_types import LANE_WIDTH
from ompl_ext.vehicle import Vehicle, pair

REST_SHARE = 0.02
"""Largest share of its top speed at which a vehicle stands: a slow one drives at the speed that is rest for others."""

MAX_STEPS = 100_000  # integration steps of an edge or a manoeuvre


@dataclass(frozen=True)
class Goal:
    """Goal region: a position, a radius (m) and, optionally, a heading with a tolerance (rad).

    `limits` bound further components of the state there, by name: lowest and highest value (SI).
    """

    center: tuple[float, float]
    radius: float
    heading: float = 0.0
    tolerance: float = math.pi
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        """Take any sequence of two numbers as the centre.

        Raises:
            ValueError: the centre is not two finite numbers, the radius is negative or infinite, the tolerance is
                negative, or limits are not a lowest and a highest number by name.
        """
        center = tuple(map(float, self.center))
        if len(center) != 2 or not all(map(math.isfinite, (*center, self.heading))):
            raise ValueError(f"goal: center {self.center}, heading {self.heading}; expected (x, y) and rad, finite")
        if not (0.0 <= self.radius < math.inf and self.tolerance >= 0.0):
            raise ValueError(f"goal: radius {self.radius}, tolerance {self.tolerance}; expected 0 or more, m finite")
        limits = self.limits
        if not isinstance(limits, Mapping) or any(map(math.isnan, chain.from_iterable(map(pair, limits.values())))):
            raise ValueError(f"goal: limits {limits!r}; expected {{name: (lowest, highest)}}")
        object.__setattr__(self, "center", center)

    @property
    def has_heading(self) -> bool:
        """Whether the goal bounds the heading."""
        return self.tolerance < math.pi

    @property
    def is_exact(self) -> bool:
        """Whether the goal bounds the heading or other components of the state, beside the place."""
        return self.has_heading or bool(self.limits)

    def contains(self, vehicle: Vehicle, state: Floats) -> bool:
        """Whether a state (nx,) of a vehicle is in the region."""
        return self.distance(vehicle, state) < self.radius and self.is_within_limits(vehicle, state)

    def distance(self, vehicle: Vehicle, state: Floats) -> float:
        """Distance of a state (nx,) to the centre, m."""
        return math.hypot(state[vehicle.index("x")] - self.center[0], state[vehicle.index("y")] - self.center[1])

    def is_within_limits(self, vehicle: Vehicle, state: Floats) -> bool:
        """Whether the heading and the further components of a state (nx,) are within their limits, at any position."""
        theta = vehicle.index("theta")
        if self.has_heading and theta >= 0 and math.cos(state[theta] - self.heading) < math.cos(self.tolerance):
            return False
        return all(low <= state[vehicle.index(name)] <= high for name, (low, high) in self.limits.items())

    def check(self, vehicle: Vehicle) -> None:
        """Check that the goal bounds components that the vehicle has.

        Raises:
            ValueError: a name is not a component, or is one that center, radius and heading bound; or low > high.
        """
        others = [name for name in vehicle.state if name not in ("x", "y", "theta")]
        for name, (low, high) in self.limits.items():
            if name not in others:
                has = f"has {', '.join(others)} besides its pose" if others else "has no component besides its pose"
                raise ValueError(f"goal: limits name {name!r}; {vehicle.name} {has}")
            if not low <= high:
                raise ValueError(f"goal: the limits of {name} are {low} to {high}")


@dataclass(frozen=True)
class Safety:
    """Clearance delta(t, v) inside the first cycle and of contingencies.

    It is `delta` + `delta_per_speed` |v| + `delta_per_time` t (m) for t s since the start of the query, t being at most
    `delta_horizon`.  After `near` s it is `far_delta` + `far_delta_per_speed` |v| instead.  The planner takes a
    contingency to begin at the end of the cycle.

    With `enabled`, every edge that crosses the end of the cycle must pass SAFETY (Alg. 2).  A manoeuvre without
    standstill within `horizon` s is not safe.  A vehicle stands if no `rest` component is above `rest_speed` (SI), its
    speed not above `REST_SHARE` of its top speed either.
    """

    enabled: bool = True
    cycle: float = 1.0
    delta: float = 0.0
    delta_per_speed: float = 0.0
    delta_per_time: float = 0.0
    delta_horizon: float = 0.0
    near: float = math.inf
    far_delta: float = 0.0
    far_delta_per_speed: float = 0.0
    rest_speed: float = 0.01
    step: float = 0.1
    horizon: float = 10.0

    def __post_init__(self) -> None:
        """Check the settings.

        Raises:
            ValueError: a number is negative or not finite, or a manoeuvre has too many steps.
        """
        numbers = (self.cycle, self.delta, self.delta_per_speed, self.delta_per_time, self.delta_horizon,
                   self.far_delta, self.far_delta_per_speed, self.rest_speed, self.step, self.horizon)  # fmt: skip
        numbers_are_fine = math.isfinite(sum(numbers)) and min(numbers) >= 0
        if not (numbers_are_fine and self.near >= 0) or self.step == 0:
            raise ValueError(f"safety: numbers must be finite and not negative, got {self}")
        if self.horizon / self.step > MAX_STEPS:
            raise ValueError(f"safety: a horizon of {self.horizon} s has too many steps of {self.step} s")

    def rest_speeds(self, vehicle: Vehicle) -> Floats:
        """Largest values at standstill of the vehicle's `rest` components, of which the first is its speed."""
        largest: Floats = np.full(len(vehicle.rest_indices), self.rest_speed)
        largest[:1] = min(self.rest_speed, REST_SHARE * vehicle.top_speed)
        return largest

    def is_resting(self, vehicle: Vehicle, state: Floats) -> Bools:
        """Whether states (..., nx) are at standstill."""
        resting: Bools = np.all(np.abs(state[..., list(vehicle.rest_indices)]) <= self.rest_speeds(vehicle), axis=-1)
        return resting

    def clearance(self, speed: Floats, time: Floats) -> Floats:
        """delta(t, v) (n,) at speeds (n,), m/s, and times (n,) since the start of the query, s."""
        growth = self.delta_per_time * np.minimum(np.maximum(time, 0.0), self.delta_horizon)
        near: Floats = self.delta + self.delta_per_speed * np.abs(speed) + growth
        if math.isinf(self.near):
            return near
        far = self.far_delta + self.far_delta_per_speed * np.abs(speed)
        delta: Floats = np.where(np.asarray(time) <= self.near, near, far)
        return delta


@dataclass(frozen=True)
class Settings:
    """Settings of DIRT, and of SST instead of it.  Lengths in m, times in s."""

    planner: str = "dirt"
    """`dirt`, or `sst`, which has no regions, no child extension, no exploration and no optimisation"""
    selection_radius: float = 0.2
    """radius around a sample within which SST selects the node with the lowest cost"""
    pruning_radius: float = 0.1
    """radius around a witness of SST within which one node is active"""
    blossom: int = 32
    insertions: int = 1
    child_extension: bool = True
    pruning: bool = False
    goal_bias: float = 0.05
    exploration: float = 0.1
    beyond: float = 1.0  # OMPL parameter control_bound_bias; this is the name in plan files
    shortest: float = 0.5
    longest: float = 1.0
    steps: int = 10
    quantum: float = 0.0
    heading_weight: float = 0.05
    resolution: float = 0.01
    discs: int = 4
    excess: float = 0.0
    """by how much the discs over the footprint may exceed it, as a share of its width; 0: `discs` equal ones"""
    cell: float = 0.02
    pose_cost_to_go: bool | None = None
    """whether the cost-to-go knows the heading; by default it does if the goal has one"""
    way_margin: float = 0.0
    """distance that ways of that cost-to-go keep from obstacles where they can, except close to a pose to reach (m)"""
    polish: bool | None = None
    """whether plans are improved by local optimisation; by default they are if the goal has a heading"""

    def __post_init__(self) -> None:
        """Check that the kernels' arrays can hold the settings.

        Raises:
            ValueError: names every invalid setting.
        """
        whole = ("blossom", "insertions", "steps", "discs")
        fractions = [name for name in whole if not isinstance(getattr(self, name), Integral)]
        if fractions:
            raise ValueError(f"settings: {', '.join(fractions)} must be whole numbers")
        rules = {
            f"planner is {self.planner!r}, not 'dirt' or 'sst'": self.planner in ("dirt", "sst"),
            f"blossom is {self.blossom}, not 1 to {LANE_WIDTH}": 1 <= self.blossom <= LANE_WIDTH,
            f"insertions is {self.insertions}, not 1 to blossom": 1 <= self.insertions <= max(self.blossom, 1),
            f"an edge has {self.most_steps} integration steps, not 1 to {MAX_STEPS}": 1 <= self.most_steps <= MAX_STEPS,
            f"durations {self.shortest} to {self.longest} are not 0 < shortest <= longest": 0
            < self.shortest
            <= self.longest
            < math.inf,
            f"goal_bias is {self.goal_bias}, not 0 to 1": 0 <= self.goal_bias <= 1,
            f"exploration is {self.exploration}, not 0 to 1": 0 <= self.exploration <= 1,
            f"discs is {self.discs}, not 1 to 1000": 1 <= self.discs <= 1000,
            f"excess is {self.excess}, not 0 to 1": 0.0 <= self.excess <= 1.0,
            "lengths are not finite, or not positive": all(
                math.isfinite(value) and value >= low
                for value, low in (
                    (self.cell, 1e-6),
                    (self.resolution, 0.0),
                    (self.selection_radius, 0.0),
                    (self.pruning_radius, 0.0),
                    (self.heading_weight, 0.0),
                    (self.beyond, 0.0),
                    (self.quantum, 0.0),
                    (self.way_margin, 0.0),
                )
            ),
        }
        wrong = [what for what, fine in rules.items() if not fine]
        if wrong:
            raise ValueError("settings: " + "; ".join(wrong))

    @property
    def most_steps(self) -> int:
        """Integration steps of the longest edge: with a quantum those of the multiple of it that is nearest."""
        if not self.quantum > 0:
            return self.steps
        multiples = self.longest / self.quantum
        return math.floor(multiples + 0.5) if multiples <= MAX_STEPS else MAX_STEPS + 1
