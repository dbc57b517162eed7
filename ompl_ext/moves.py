"""Moves from standstill to standstill: how a vehicle follows a path of poses that it cannot follow at speed.

A path of the cost-to-go of poses disregards accelerations.  A vehicle whose wheels turn at a limited rate, or whose
controls are accelerations, leaves it wherever the curvature changes.  It does not if it stops there: the path is cut
into arcs of constant curvature, and before each one everything but the pose comes to rest as the arc needs it, the
wheels' angle for example.  Gauss-Newton then fits the controls along the arc.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ompl_ext.arrays import Bools, Floats, Ints, Matrix
from ompl_ext.kernels.arcs import cross_track
from ompl_ext.kernels.posepath import PosePath
from ompl_ext.kernels.specialise import kernels
from ompl_ext.motion import Motion, corners
from ompl_ext.vehicle import Vehicle

LARGEST_TURN = 2.0  # largest turn of an arc (rad)
TRIED = 0.2  # duration of the motions that show what a control does (s)
ALIKE = 0.01  # difference of the cosines up to which two directions are equally near the wanted one
NOTICED = (0.01, 10)  # step (s) and number of steps of the motions that show which control brakes
SPEEDING, BRAKING = (0.025, 80), (0.02, 100)  # step (s) and number of steps: acceleration of a move, and braking
SETTLING = (0.05, 20)  # step (s) and number of steps in which a vehicle that stands turns its wheels
STOPPED = 0.01  # speed above the lowest one at which braking is over, as a share of the speed before
SETTLED = 0.01  # distance of a component from its last value, as a share of its range, below which it has settled
MOVED = 0.02  # motion in 0.5 s from which on a control moves the vehicle, as a share of the footprint's reach


class Arc(NamedTuple):
    """Motion at a constant velocity of the body from a pose to another: `screw` is its body motion (m, m, rad)."""

    begin: Floats
    end: Floats
    screw: Floats
    shares: Floats  # of the time in which the path moves at each twist


class Profile(NamedTuple):
    """How the vehicle moves at a twist: controls that accelerate and brake, and how far it comes.

    `travel` (n,) is the length (m) of the move that accelerates for `times` (n,) s, and brakes for `braking` (n,) s.
    """

    accelerate: Floats
    brake: Floats
    times: Floats
    braking: Floats
    travel: Floats
    speed: float  # at the end of the longest acceleration (m/s)


def arcs_of(path: PosePath, first: int, last: int, stray: Floats, reach: float, twists: int) -> Iterator[Arc]:
    """Arcs of which the motions `first` to `last` of a path consist, each as long as it fits.

    They may deviate by `stray` (n,), m, from the pose before each motion, and the one after the last.
    """
    poses, begin = np.column_stack([path.poses[:, :2], np.unwrap(path.poses[:, 2])]), first
    while begin < last:
        end, chosen = begin + 1, _screw(poses[begin], poses[begin + 1])
        while end < last and abs(poses[end + 1, 2] - poses[begin, 2]) < LARGEST_TURN:
            screw = _screw(poses[begin], poses[end + 1])
            between = poses[begin + 1 : end + 1]
            away = np.linalg.norm(cross_track(between[None], poses[begin], screw, reach)[0], axis=1)
            if np.any(away > stray[begin + 1 - first : end + 1 - first]):
                break
            end, chosen = end + 1, screw
        shares = np.bincount(path.twist[begin:end], path.times[begin:end], twists)
        yield Arc(poses[begin], poses[end], chosen, shares / shares.sum())
        begin = end


def _screw(begin: Floats, end: Floats) -> Floats:
    """Constant body motion (m, m, rad) that leads from a pose to another."""
    half = 0.5 * (end[2] - begin[2])
    dx, dy = (end[:2] - begin[:2]) / np.sinc(half / math.pi)
    c, s = math.cos(begin[2] + half), math.sin(begin[2] + half)
    return np.array([c * dx + s * dy, c * dy - s * dx, 2.0 * half])


class Moves:
    """Moves of a vehicle along arcs, from standstill to standstill."""

    def __init__(self, vehicle: Vehicle, motion: Motion, twists: Ints, parameters: Floats) -> None:
        self._kernels, self._motion, self._twists, self._parameters = kernels(vehicle), motion, twists, parameters
        self._pose, self._rest = [vehicle.index(name) for name in ("x", "y", "theta")], list(vehicle.rest_indices)
        self._others = [k for k in range(len(vehicle.state)) if k not in self._pose + self._rest]
        self._reach, self._limits, self._bounds = vehicle.footprint.reach, vehicle.state_limits, vehicle.control_bounds
        for name in ("x", "y"):
            self._limits[vehicle.index(name)] = -math.inf, math.inf
        self._idle = np.clip(0.0, *self._bounds.T)
        self._candidates = np.vstack([corners(self._bounds, np.random.default_rng(0)), motion.controls[twists]])
        self._profiles: dict[int, Profile] = {}
        self._scale = np.array([1.0, 1.0, self._reach])

    def inputs_for(self, arc: Arc) -> Matrix:
        """Controls and durations (m, nu + 1) with which the vehicle moves along an arc, to be fitted."""
        profiles = [(share, self._profile(int(k))) for k, share in enumerate(arc.shares) if share > 0.0]
        accelerate: Floats = sum(share * each.accelerate for share, each in profiles)
        brake: Floats = sum(share * each.brake for share, each in profiles)
        profile, length = max(profiles, key=lambda pair: pair[0])[1], float(np.linalg.norm(arc.screw * self._scale))
        seconds = np.interp(length, profile.travel, profile.times)
        seconds += max(length - profile.travel[-1], 0.0) / profile.speed
        braking = max(np.interp(length, profile.travel, profile.braking), BRAKING[0])
        inputs = [np.append(accelerate, 0.5 * seconds)] * 2 + [np.append(brake, 0.5 * braking)] * 2
        return np.array(inputs)

    def settling(self, state: Floats, arc: Arc) -> tuple[Floats, float]:
        """Control (nu,) with which the vehicle stands until it can begin an arc, and for how long (s): 0 if it can.

        What does not move the vehicle from standstill, as steering, is that of the arc; it can begin as soon as no
        component of the state but pose and speed is farther from where the control leads it within a second than
        `SETTLED` allows.
        """
        if not self._others:
            return self._idle, 0.0
        wanted: Floats = sum(
            share * self._profile(int(k)).accelerate for k, share in enumerate(arc.shares) if share > 0.0
        )
        control = np.where(self._moves(wanted), self._idle, wanted)
        step, count = SETTLING
        states = self._rolled(state[None], control[None], step, count)[0][:, self._others]
        span = np.maximum(self._motion.high - self._motion.low, 1e-9)[self._others]
        settled = np.abs(states - states[-1]).max(axis=1, initial=0.0) < SETTLED * span.max()
        return control, step * int(np.argmax(settled))

    def _moves(self, control: Floats) -> Bools:
        """Whether each component (nu,) of a control moves the vehicle from standstill if the others are idle."""
        single = np.where(np.eye(len(control), dtype=bool), control, self._idle)
        ends = self._rolled(np.zeros((len(control), len(self._limits))), single, 0.1, 5)[:, -1]
        moved: Bools = np.linalg.norm(ends[:, self._pose] * self._scale, axis=1) > MOVED * self._reach
        return moved

    def _rolled(self, states: Matrix, controls: Matrix, step: float, count: int) -> Floats:
        """States (k, count + 1, nx) of k motions, each with one control."""
        found = np.empty((len(controls), count + 1, states.shape[1]))
        found[:, 0] = states
        held = np.ascontiguousarray(controls)
        self._kernels.roll_out(found, held, self._parameters, np.full(len(held), step))
        return found

    def _profile(self, twist: int) -> Profile:
        if twist not in self._profiles:
            self._profiles[twist] = self._simulated(twist)
        return self._profiles[twist]

    def _simulated(self, twist: int) -> Profile:
        """Profile of a twist, from motions that begin at standstill."""
        wanted = self._motion.twists[self._twists[twist]] * self._scale
        standing = self._motion.states[self._twists[twist]].copy()
        standing[self._pose + self._rest] = 0.0
        tried = self._rolled(np.tile(standing, (len(self._candidates), 1)), self._candidates, TRIED, 1)[:, -1]
        accelerate = self._candidates[_most_alike(tried[:, self._pose] * self._scale, wanted)]
        step, count = SPEEDING
        states = self._rolled(standing[None], accelerate[None], step, count)[0]
        beyond = np.any((states < self._limits[:, 0]) | (states > self._limits[:, 1]), axis=1)
        states = states[: max(int(np.argmax(beyond)), 1)] if beyond.any() else states
        brake = self._brake(states[len(states) // 2], accelerate)
        braking_step, most = BRAKING
        stopping = self._rolled(states, np.tile(brake, (len(states), 1)), braking_step, most)
        speeds = np.linalg.norm(stopping[:, :, self._rest], axis=2)
        slowest = np.argmax(speeds <= speeds.min(axis=1, keepdims=True) + STOPPED * speeds[:, :1], axis=1)
        until = np.arange(most + 1) <= slowest[:, None]
        stopping = np.where(until[:, :, None], stopping, np.take_along_axis(stopping, slowest[:, None, None], axis=1))
        ahead = self._lengths(states[None])[0]
        travel = np.maximum.accumulate(ahead + self._lengths(stopping)[:, -1])
        speed = float(ahead[-1] - ahead[-2]) / step if len(ahead) > 1 else 0.0
        times: Floats = np.arange(len(states), dtype=np.float64) * step
        braking: Floats = slowest.astype(np.float64) * braking_step
        return Profile(accelerate, brake, times, braking, travel, max(speed, 1e-3))

    def _lengths(self, states: Floats) -> Floats:
        """Lengths (k, n) of motions (k, n, nx) up to each state (m)."""
        steps = np.linalg.norm(np.diff(states[:, :, self._pose], axis=1) * self._scale, axis=2)
        return np.hstack([np.zeros((len(states), 1)), np.cumsum(steps, axis=1)])

    def _brake(self, state: Floats, accelerate: Floats) -> Floats:
        """Control that slows a motion down without a change of its direction."""
        room = np.where(accelerate > 0.0, -self._bounds[:, 0], self._bounds[:, 1])
        room = room / np.maximum(np.abs(accelerate), 1e-9)
        opposite = -max(float(room[accelerate != 0.0].min(initial=1.0)), 0.0) * accelerate
        candidates = np.vstack([self._candidates, opposite, self._idle])
        step, count = NOTICED
        tried = self._rolled(np.tile(state, (len(candidates), 1)), candidates, step, count)
        before, after = self._velocity(tried[:, :2], step), self._velocity(tried[:, -2:], step)
        return candidates[_most_alike(after - before, -before.mean(axis=0))]

    def _velocity(self, states: Floats, step: float) -> Matrix:
        """Velocities (k, 3) of the body between two states (k, 2, nx), the turning rate times the reach (m/s)."""
        poses = states[:, :, self._pose]
        change = (poses[:, 1] - poses[:, 0]) / step
        middle = poses.mean(axis=1)[:, 2]
        c, s = np.cos(middle), np.sin(middle)
        ahead, aside = c * change[:, 0] + s * change[:, 1], c * change[:, 1] - s * change[:, 0]
        return np.column_stack([ahead, aside, self._reach * change[:, 2]])


def _most_alike(found: Matrix, wanted: Floats) -> int:
    """Number of the longest vector of those that point most nearly in the wanted direction."""
    length = np.linalg.norm(found, axis=1)
    cosine = found @ wanted / np.maximum(length * np.linalg.norm(wanted), 1e-12)
    return int(np.argmax(np.where(cosine >= cosine.max() - ALIKE, length, -1.0)))
