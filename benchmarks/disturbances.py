"""Drives in which something happens that no command explains: how much of it is found, and what it does to the fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from benchmarks.effort import Effort
from benchmarks.report import Report, Row, row
from kraft.logs.log import Log, Part
from kraft.sysid import identify, prediction_errors
from kraft.sysid.dynamics import DiscreteModel
from kraft.sysid.parameters import speed_index
from kraft.sysid.unexplained import Stretch, unexplained_stretches, without
from kraft.vehicles.config import load_vehicle_config
from kraft.vehicles.load import load_vehicle
from ompl_ext.arrays import Floats

STEP: Final = 0.01
KINDS: Final = ("held", "lifted", "wall", "carried", "pushed", "turned", "glitch")
TRUTH: Final = {
    "mushr-drive": {"L": 0.3, "v_delta": 0.9, "tau": 0.5, "u_0": 0.15},
    "mushr-lag": {"L": 0.3, "v_delta": 0.9, "tau": 0.5},
}
DELAY: Final = 0.08
"""Delay of the commands, s."""
POSE_EVERY, COMMAND_EVERY = 3, 5
"""Steps between two poses, and between two recorded commands."""
ROUNDS: Final = 6
LOGS: Final = 6
FOUND: Final = 0.5
"""Share of a disturbance that must be found."""


@dataclass(frozen=True)
class Disturbance:
    """Something that no command explains."""

    kind: str
    """one of `KINDS`"""
    begin: float
    """s"""
    end: float

    def at(self, time: float) -> bool:
        """Whether it acts."""
        return self.begin <= time < self.end


def drive(
    name: str,
    model: str,
    seed: int,
    disturbances: tuple[Disturbance, ...] = (),
    *,
    seconds: float = 30.0,
    noise: float = 0.003,
) -> Log:
    """Random levels of throttle and steering, with disturbances; `noise` of the positions is in m."""
    vehicle = load_vehicle(model, parameters=TRUTH.get(model, {}))
    discrete, rng, count = DiscreteModel(vehicle), np.random.default_rng(seed), round(seconds / STEP)
    high, levels = vehicle.control_bounds[:, 1], list[list[float]]()
    while len(levels) < count:
        hold = int(rng.uniform(0.6, 2.0) / STEP)
        throttle = rng.choice([0.0, rng.uniform(0.35, 1.0)], p=[0.1, 0.9])
        levels += [[throttle * high[0], rng.uniform(-0.8, 0.8) * high[1]]] * hold
    commands = np.array(levels[:count])
    late = round(DELAY / STEP)
    acting = np.concatenate([np.zeros((late, 2)), commands])[:count]
    states, shift = np.zeros((count + 1, len(vehicle.state))), np.zeros((count + 1, 3))
    for k in range(count):
        state = discrete.simulate(
            states[k][None],
            np.ascontiguousarray(acting[k][None, None]),
            vehicle.parameter_array[None],
            np.array([STEP]),
        )[-1, 0]
        for disturbance in disturbances:
            if disturbance.at((k + 1) * STEP):
                disturb(state, states[k], shift[k + 1], disturbance, (k + 1) * STEP, speed_index(vehicle))
        states[k + 1] = state
    at = np.arange(0, count + 1, POSE_EVERY)
    poses = states[at, :3] + shift[at] + rng.normal(0.0, [noise, noise, 3.0 * noise], (len(at), 3))
    given = np.arange(0, count, COMMAND_EVERY)
    part = Part(given * STEP, commands[given], at * STEP, poses)
    return Log(name, (), ("throttle", "steering"), (part,))


def disturb(state: Floats, before: Floats, shift: Floats, what: Disturbance, time: float, speed: int) -> None:
    """Change a state, or the shift of the observed pose."""
    match what.kind:
        case "held" | "wall":
            state[:3], state[speed] = before[:3], 0.0
        case "lifted":
            state[speed] *= 0.97
        case "pushed":
            state[speed] = min(max(state[speed], 0.0) + 1.5 * STEP, 1.2)
        case "carried":
            state[:3], state[speed] = before[:3] + STEP * np.array([0.4, -0.3, 0.5]), 0.0
        case "turned":
            state[2] = before[2] + 1.2 * STEP
        case "glitch":
            shift[:] = np.sin(np.pi * (time - what.begin) / (what.end - what.begin)) * np.array([0.25, -0.2, 0.3])


def disturbances_of(rng: np.random.Generator, kinds: tuple[str, ...], seconds: float = 30.0) -> tuple[Disturbance, ...]:
    """One of each kind, of 1 to 2.2 s, one after the other."""
    begins = np.linspace(4.0, seconds - 5.0, len(kinds) + 1)[:-1] + rng.uniform(0.0, 1.5, len(kinds))
    lengths = rng.uniform(1.0, 2.2, len(kinds))
    return tuple(Disturbance(kind, float(a), float(a + d)) for kind, a, d in zip(kinds, begins, lengths, strict=True))


def covered(log: str, disturbance: Disturbance, found: tuple[Stretch, ...]) -> float:
    """Share of a disturbance that was found."""
    own = [min(s.end, disturbance.end) - max(s.begin, disturbance.begin) for s in found if s.log == log]
    return sum(max(0.0, each) for each in own) / (disturbance.end - disturbance.begin)


def run(effort: Effort) -> Report:
    """Measure detection and its effect on the prediction of drives without disturbances."""
    rows = [*detection(min(ROUNDS, effort.seeds))]
    rows += [line for model in list(TRUTH)[: effort.seeds] for line in prediction(model)]
    return Report("disturbances", rows)


def detection(rounds: int) -> list[Row]:
    """Share of the disturbances that are found, and seconds that are left out of drives without any."""
    models, hits, wrong = ("mushr-drive", "mushr-lag", "f1tenth"), list[float](), list[float]()
    for number in range(rounds):
        logs, given = list[Log](), dict[str, tuple[Disturbance, ...]]()
        for k in range(LOGS):
            rng = np.random.default_rng(100 * number + k)
            kinds = tuple(map(str, rng.permutation(KINDS)[:2])) if k % 2 == 0 else ()
            name = f"{number}-{k}"
            given[name] = disturbances_of(rng, kinds)
            noise = 0.003 if number < 3 else 0.01
            logs.append(drive(name, models[number % 3], 1000 * number + k, given[name], noise=noise))
        found = unexplained_stretches(logs)
        hits += [float(covered(name, each, found) > FOUND) for name, own in given.items() for each in own]
        wrong += [sum(s.end - s.begin for s in found if s.log == name) for name, own in given.items() if not own]
    return [
        row(f"found, share of {len(hits)} disturbances", "1", [float(np.mean(hits))], more=True),
        row(f"wrongly left out of {30 * len(wrong)} s", "s", [sum(wrong)]),
    ]


def prediction(model: str) -> list[Row]:
    """Errors after 3 s of drives without disturbances, identified from drives without, with, and with them left out."""
    rng, dirty, clean = np.random.default_rng(0), list[Log](), list[Log]()
    for k in range(LOGS):
        kinds = tuple(map(str, rng.permutation(KINDS)[:3])) if k % 2 == 0 else ()
        dirty.append(drive(f"log-{k}", model, k, disturbances_of(rng, kinds)))
        clean.append(drive(f"log-{k}", model, k))
    unseen = [drive(f"unseen-{k}", model, 9000 + k) for k in range(3)]
    rows, vehicle = [], load_vehicle_config(model)
    cut = without(dirty, unexplained_stretches(dirty))
    for name, logs in (("without disturbances", clean), ("with nine", dirty), ("with nine, left out", cut)):
        errors = prediction_errors(vehicle, unseen, identify(vehicle, logs).values)
        rows.append(row(f"{model}, error after 3 s, drives {name}", "cm", [100.0 * errors.position[3.0]]))
    return rows
