"""Logs that were never driven and an identification that nobody made, for what only passes them on."""

from __future__ import annotations

import numpy as np

from kraft.logs.log import Log, Part, Source
from kraft.sysid.acceptance import PredictionEvaluation, PredictionPair
from kraft.sysid.data import LogSplit
from kraft.sysid.interface import Identification, LogFit, Noise, ParameterEstimate, PartFit
from kraft.sysid.prediction import Window

NAMES = ("L", "phi_diff", "v_delta")


def fake_log(name: str, turn: float = 0.2, duration: float = 8.0) -> Log:
    """An arc at 0.5 m/s."""
    times = np.arange(0.0, duration, 1 / 30)
    yaw = turn * times
    poses = np.column_stack([0.5 * np.sin(yaw) / turn, 0.5 * (1 - np.cos(yaw)) / turn, yaw])
    command_times = np.arange(0.0, duration, 0.5)
    commands = np.column_stack([np.where(command_times % 1 == 0, 0.8, 0.4), np.full(len(command_times), 0.1)])
    source = Source(f"logs/{name}/poses.csv", f"{abs(hash_of(name)):064x}"[:64])
    return Log(name, (source,), ("throttle", "steering"), (Part(command_times, commands, times, poses),), (), "guessed")


def hash_of(name: str) -> int:
    return int.from_bytes(name.encode(), "big")


def estimated(value: float, std: float, **other: object) -> ParameterEstimate:
    known = {
        "ci95": (value - 2 * std, value + 2 * std), "unit": "m", "description": "what it is", "initial": 0.36,
        "min": -1.0, "max": 2.0, "frozen": False, "at_bound": False, **other,
    }  # fmt: skip
    return ParameterEstimate(value=value, std=std, **known)  # type: ignore[arg-type]


def fake_identification(logs: tuple[Log, ...], **other: object) -> Identification:
    covariance = np.diag([0.01, 0.002, 0.02]) ** 2
    known: dict[str, object] = {
        "model": "mushr",
        "parameters": {
            "L": estimated(0.33, 0.01, description="wheelbase"),
            "phi_diff": estimated(0.004, 0.002, unit="rad", initial=0.0),
            "v_delta": estimated(0.6, 0.02, unit="m/s"),
            "delay": estimated(0.1, 0.01, unit="s", initial=0.0, description="time until a command takes effect"),
        },
        "auxiliary": ("delay",), "names": NAMES, "covariance": covariance, "interval": "graph",
        "graph_covariance": covariance, "unidentified": (), "converged": True, "iterations": 7, "cost": 12.0,
        "noise": Noise(0.01, 0.02), "noise_measured": True, "process": {}, "warnings": (), "notes": ("a note",),
        "logs": tuple(fake_fit(log) for log in logs), "rear_axle": 0.16,
    }  # fmt: skip
    return Identification(**{**known, **other})  # type: ignore[arg-type]


def fake_fit(log: Log) -> LogFit:
    (part,) = log.parts
    times = np.arange(0.0, part.pose_times[-1], 0.05)
    states = np.column_stack([np.interp(times, part.pose_times, column) for column in part.poses.T])
    states = np.column_stack([states, np.full(len(times), 0.5)])
    noise = 0.01 * np.sin(np.arange(3 * len(part.poses)).reshape(-1, 3) ** 2)
    weights = np.where(np.arange(len(part.poses)) % 40 == 0, 0.2, 1.0)
    controls = np.full((len(times) - 1, 2), 0.1)
    return LogFit(
        log.name, (PartFit(times, states, controls, part.pose_times, part.poses, part.poses + noise, weights),)
    )


def fake_windows(logs: tuple[Log, ...], drift: float) -> tuple[Window, ...]:
    found = []
    for log in logs:
        times, poses = log.parts[0].pose_times[:90], log.parts[0].poses[:90]
        off = np.column_stack([drift * times, np.zeros(90), 0.5 * drift * times])
        found.append(Window(log.name, times, poses, poses + off))
    return tuple(found)


def fake_evaluation(split: LogSplit) -> PredictionEvaluation:
    def pair(logs: tuple[Log, ...]) -> PredictionPair:
        return PredictionPair(fake_windows(logs, 0.01), fake_windows(logs, 0.1), fake_windows(logs, 0.2))

    return PredictionEvaluation(pair(split.fitted), pair(split.held_out) if split.held_out else None)
