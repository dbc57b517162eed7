"""Car with dry friction in the strict sense: an integration that shares nothing with the model that is identified.

The model of `kraft.vehicles.car` is smooth at standstill, at the ends of the dead zone and between the sides of the
steering, since planning and identification need derivatives.  Here nothing is: friction of full size opposes any motion
and holds the car at rest as long as the drive does not exceed it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ompl_ext.arrays import Floats, Matrix

SUBSTEP = 0.0005
"""Integration step, s."""


def driven(truth: Mapping[str, float], acting: Floats, step: float) -> Floats:
    """States [x, y, theta, v, delta, r] (steps + 1, cars, 6) of cars from rest, poses of the tracked point.

    Args:
        truth: parameters of `car-lag`.
        acting: throttle and steering (steps, cars, 2), each held for a step.
        step: s, a multiple of `SUBSTEP`.
    """
    share, wheel = _beyond(truth, acting[..., 0]), _wheel(truth, acting[..., 1])
    substeps, cars = round(step / SUBSTEP), acting.shape[1]
    x, y, theta, v, delta, r = np.zeros((6, cars))
    states = np.zeros((len(acting) + 1, cars, 6))
    for i, (u, target) in enumerate(zip(share, wheel, strict=True)):
        for _ in range(substeps):
            bend = _curvature(truth, v, delta)
            slip, yaw = truth["slip"] * v * r, theta - truth["yaw_offset"]
            vx = v * np.cos(yaw - slip) - truth["lever"] * r * np.sin(yaw)
            vy = v * np.sin(yaw - slip) + truth["lever"] * r * np.cos(yaw)
            x, y, theta = x + SUBSTEP * vx, y + SUBSTEP * vy, theta + SUBSTEP * r
            rate = (target - delta) / truth["tau_steer"]
            v = _speed_after(truth, v, r, delta, bend, u)
            delta = delta + SUBSTEP * rate / np.hypot(1.0, rate * truth["rate_limit"])
            r = r + SUBSTEP * (v * bend - r) / truth["tau_yaw"]
        states[i + 1] = np.column_stack([x, y, theta, v, delta, r])
    return states


def _beyond(truth: Mapping[str, float], throttle: Matrix) -> Matrix:
    """Throttle beyond the dead zone."""
    beyond: Matrix = np.sign(throttle) * np.maximum(np.abs(throttle) - truth["dead_zone"], 0.0)
    return beyond


def _wheel(truth: Mapping[str, float], steering: Matrix) -> Matrix:
    """Angle of the wheels that is commanded, rad."""
    turned = steering / np.hypot(1.0, truth["saturation"] * steering)
    angle: Matrix = truth["phi_diff"] + truth["steer"] * turned * (1.0 + truth["asymmetry"] * np.sign(steering))
    return angle


def _curvature(truth: Mapping[str, float], v: Floats, delta: Floats) -> Floats:
    wanted = np.tan(delta) / (truth["L"] * (1.0 + truth["understeer"] * v**2))
    bend: Floats = wanted / (1.0 + (v**2 * wanted * truth["slide"]) ** 4) ** 0.25
    return bend


def _speed_after(truth: Mapping[str, float], v: Floats, r: Floats, delta: Floats, bend: Floats, u: Floats) -> Floats:
    """Speed after a substep; friction brings a car to rest and holds it, and never reverses it."""
    push = truth["a_drive"] * u * (1.0 + truth["progression"] * np.abs(u))
    push = np.where(push * v < 0.0, truth["brake"] * push, push)
    lateral, turned = v * r, np.tan(delta)
    friction = (
        truth["friction"]
        + truth["scrub"] * np.abs(lateral * turned)
        + truth["skid"] * np.abs(lateral * (turned - truth["L"] * bend))
    )
    driven = push - (truth["damping"] + truth["back_emf"] * np.abs(u)) * v
    if truth["effort"] > 0.0:
        driven = np.clip(driven, -1.0 / truth["effort"], 1.0 / truth["effort"])
    coasting = np.where(u == 0.0, truth["coast"] * v, 0.0)
    rolling = v + SUBSTEP * (driven - coasting - truth["drag"] * v * np.abs(v))
    after: Floats = np.sign(rolling) * np.maximum(np.abs(rolling) - SUBSTEP * friction, 0.0)
    return after
