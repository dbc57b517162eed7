"""Logs of a robot with two driven sides before an identification: clocks, two robots, commands that show nothing."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import pytest

from benchmarks.synthetic_logs import synthetic_logs
from kraft.errors import InputError
from kraft.logs.log import Log
from kraft.sysid.checks import SteeringInMotion
from kraft.sysid.screening import check_consistency, two_cars
from kraft.sysid.terms import check_controls
from kraft.vehicles.config import load_vehicle_config

SEEDS = range(4)


@cache
def logs(first: int = 0, **truth: float) -> tuple[Log, ...]:
    seeds = [first + k for k in SEEDS]
    return tuple(synthetic_logs(load_vehicle_config("differential"), truth, seeds, seconds=12.0))


def later(given: Sequence[Log], time: float) -> list[Log]:
    """The logs with commands whose clock is `time` s ahead of that of the poses."""
    return [
        replace(log, parts=tuple(replace(p, command_times=p.command_times + time) for p in log.parts)) for log in given
    ]


def refusal(given: Sequence[Log]) -> str:
    with pytest.raises(InputError) as error:
        check_consistency(given)
    return str(error.value)


@pytest.mark.parametrize("truth", [{}, {"tau": 0.6, "tau_turn": 0.5}, {"effort": 0.8, "effort_turn": 0.3}])
def test_logs_of_one_robot_pass(truth: dict[str, float]) -> None:
    check_consistency(logs(**truth))
    assert two_cars(logs(**truth)) == ""


@pytest.mark.parametrize(("time", "said"), [(1.03, "later"), (-1.07, "earlier"), (2.5, "later")])
def test_clocks_that_are_apart_are_said_with_the_offset(time: float, said: str) -> None:
    found = re.search(r"recorded ([\d.]+) s (\w+) than they act.*zero: (-?[\d.]+)}", refusal(later(logs(), time)))
    assert found is not None
    assert found[2] == said
    assert float(found[3]) == pytest.approx(time, abs=0.15)


@pytest.mark.parametrize("other", [{"track": 0.6}, {"gain": 0.65}])
def test_two_robots_are_told_apart_by_their_logs(other: dict[str, float]) -> None:
    second = logs(20, **other)
    mixed = [log for pair in zip(logs(), second, strict=True) for log in pair]
    message = refusal(mixed)
    assert all(", ".join(log.name for log in group) in message for group in (logs(), second))
    assert message.endswith(two_cars(mixed))


@pytest.mark.parametrize(
    ("right", "said", "to_drive"),
    [(1.0, "hardly differ", "turns to both sides"), (-1.0, "hardly differ but for their sign", "straight drives")],
)
def test_sides_that_are_never_commanded_apart_are_said(right: float, said: str, to_drive: str) -> None:
    """Neither the track nor the gain follows from straight drives, or from turns on the spot, alone."""
    alike = [
        replace(log, parts=tuple(replace(p, commands=p.commands[:, [0, 0]] * [1.0, right]) for p in log.parts))
        for log in logs()
    ]
    with pytest.raises(InputError) as error:
        check_controls(alike, SteeringInMotion.of(alike))
    assert str(error.value) == f"logs: have commands of left and right that {said}; expected {to_drive} too"
    check_controls(logs(), SteeringInMotion.of(logs()))
