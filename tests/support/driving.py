"""What the tests of estimators and controllers share: cars, references made by the model, and a truth that lags."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kraft.driving.car_model import CarModel
from kraft.driving.control import Controller
from kraft.driving.messages import Estimate, Reference, ReferenceKind
from kraft.driving.references import plan_reference
from kraft.planning.plan import plan_task
from kraft.planning.search import Budget
from kraft.scenario import load_scenario
from kraft.vehicles.mushr import MUSHR, MUSHR_LAG
from ompl_ext.arrays import Floats

PROMPT = MUSHR.with_parameters({"L": 0.2965, "phi_diff": 0.0, "v_delta": 0.6228})
LAGGING = MUSHR_LAG.with_parameters({"L": 0.2965, "phi_diff": 0.0, "v_delta": 0.6228, "tau": 1.0103})
RATE = 30.0
START = np.array([1.0, -0.5, math.pi / 2, 0.0])


@functools.cache
def car() -> CarModel:
    return CarModel(PROMPT)


@functools.cache
def slow_car() -> CarModel:
    return CarModel(LAGGING)


@functools.cache
def reversing_car() -> CarModel:
    """The same car with a throttle that goes below zero."""
    return CarModel(replace(PROMPT, controls={**PROMPT.controls, "throttle": (-1.0, 1.0)}))


def drive(
    model: CarModel,
    start: Floats,
    legs: Sequence[tuple[float, float, float]],
    kind: ReferenceKind = ReferenceKind.PLAN,
    begin: float = 0.0,
) -> Reference:
    """Reference of legs (throttle, steering, duration in s), sampled every 0.1 s, as the model drives them."""
    times, states, controls = [begin], [np.asarray(start, dtype=float)], []
    for throttle, steering, duration in legs:
        for _ in range(round(duration / 0.1)):
            controls.append([throttle, steering])
            states.append(model.advance(states[-1], np.array(controls[-1]), 0.1))
            times.append(times[-1] + 0.1)
    return Reference(kind, np.array(times), np.array(states), np.array(controls).reshape(-1, 2), np.zeros(2))


@functools.cache
def plan_of_turns(seed: int = 1) -> Reference:
    plan = plan_task(load_scenario("turns").task(), PROMPT, Budget(iterations=2000), seed=seed).plan
    assert plan is not None
    return plan_reference(PROMPT, plan, 0.0)


class Truth:
    """The model behind a delay (s), a throttle with a lag (s), a steering servo with a rate (rad/s) and a scale."""

    def __init__(
        self,
        model: CarModel,
        state: Floats,
        lag: float = 0.0,
        servo: float = math.inf,
        delay: int = 0,
        scale: float = 1.0,
    ) -> None:
        self.model, self.state = model, np.array(state, dtype=float)
        self._lag, self._servo, self._scale = lag, servo, scale
        self._waiting = [np.zeros(2)] * delay
        self._throttle = self._steering = 0.0

    def step(self, command: Floats, duration: float = 1.0 / RATE) -> None:
        self._waiting.append(command)
        throttle, steering = self._waiting.pop(0)
        steps = 8
        h = duration / steps
        for _ in range(steps):
            self._throttle += (throttle - self._throttle) * (1.0 if self._lag == 0 else -math.expm1(-h / self._lag))
            self._steering += float(np.clip(steering - self._steering, -self._servo * h, self._servo * h))
            self.state = self.model.advance(self.state, np.array([self._scale * self._throttle, self._steering]), h)


def track(
    controller: Controller, truth: Truth, reference: Reference, seconds: float, stop_at_end: bool = False
) -> tuple[Floats, Floats]:
    """Close the loop without noise; returns states (n, nx) and commands (n, nu)."""
    states, commands = [], []
    for k in range(round(seconds * RATE)):
        command = controller.command(Estimate(reference.start + k / RATE, truth.state.copy(), 0.0), reference)
        truth.step(command)
        states.append(truth.state.copy())
        commands.append(command)
        if stop_at_end and passed(truth.state, reference):
            break
    return np.array(states), np.array(commands)


def passed(state: Floats, reference: Reference) -> bool:
    """Whether a state is at, or beside and beyond, the end of a reference."""
    dx, dy = state[:2] - reference.states[-1, :2]
    heading = reference.states[-1, 2]
    return math.hypot(dx, dy) < 0.5 and bool(dx * math.cos(heading) + dy * math.sin(heading) > -0.03)


def off_path(states: Floats, reference: Reference) -> Floats:
    """Distance of each state from the reference's path as a polyline, m."""
    a, b = reference.states[:-1, :2], reference.states[1:, :2]
    step = b - a
    size = np.maximum((step**2).sum(1), 1e-12)
    out = []
    for point in states[:, :2]:
        share = np.clip(((point - a) * step).sum(1) / size, 0.0, 1.0)
        out.append(np.hypot(*(a + share[:, None] * step - point).T).min())
    return np.array(out)
