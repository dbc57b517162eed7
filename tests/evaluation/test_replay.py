"""Replays: what is recorded comes back, in little space, and a damaged file is refused at its line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import fake_trials
from support.evaluation import refused
from support.replays import unpacked, values_of

from kraft.errors import Code
from kraft.evaluation.journal import REPLAYS, Journal, Replays, TrialRow
from kraft.evaluation.replay import GRID, POINTS, Replay, packed, replay_of, series
from kraft.trial.result import TrialSpec
from ompl_ext.kernels.specialise import kernels
from ompl_ext.obstacles import Polygon
from ompl_ext.plan import TreeView

KEY = ("turns", "kraft", 3)


@given(st.lists(st.floats(-1e4, 1e4), max_size=30), st.sampled_from([0.001, 0.02]), st.integers(0, 2))
def test_a_series_comes_back_to_half_a_quantum(values: list[float], quantum: float, order: int) -> None:
    back = values_of(unpacked(packed(series(np.array(values), quantum, order))))
    assert np.abs(back - np.array(values)).max(initial=0.0) <= quantum / 2 + 1e-9


def test_smooth_series_are_small() -> None:
    x = 0.02 * np.arange(1000.0) + 0.1 * np.sin(np.arange(1000.0) / 50.0)
    assert len(packed(series(x, 0.001, 2))) < len(packed(series(x, 0.001, 0))) / 3


def test_a_replay_has_every_tick_and_cycle_of_its_trial() -> None:
    spec = TrialSpec.load("movable", "kraft", seed=3)
    result = fake_trials.quick(spec)
    boxes = ((1.0, 2.0, 0.1), (3.0, 4.0, 0.2))
    result = replace(result, steps=tuple(replace(step, boxes=boxes) for step in result.steps))
    replay = replay_of(spec, result)
    assert replay is not None
    assert replay.trees is None
    drive = unpacked(replay.drive)
    assert values_of(drive["t"]) == pytest.approx([step.time for step in result.steps], abs=0.0006)
    assert values_of(drive["pose"][0]) == pytest.approx([step.pose[0] for step in result.steps], abs=0.0006)
    assert [cycle["kind"] for cycle in drive["cycles"]] == [cycle.kind for cycle in result.cycles]
    assert [[values_of(axis)[-1] for axis in box] for box in drive["boxes"]] == [list(box) for box in boxes]
    assert list(drive["command"]) == list(spec.vehicle.controls)
    reference = result.cycles[0].reference
    for axis, drawn in enumerate(drive["cycles"][0]["plan"]):
        assert values_of(drawn)[[0, -1]] == pytest.approx(reference.states[[0, -1], axis], abs=0.002)
    assert replay_of(spec, result) == replay
    assert replay_of(spec, replace(result, steps=())) is None


def test_a_replay_has_no_cycle_that_the_trial_ended_before() -> None:
    spec = TrialSpec.load("turns", "kraft")
    cycles = tuple(fake_trials.cycle(k, kind) for k, kind in enumerate(("plan", "plan", "contingency")))
    replay = replay_of(spec, replace(fake_trials.quick(spec), cycles=cycles, time=1.9))
    assert replay is not None
    assert [cycle["t"] for cycle in unpacked(replay.drive)["cycles"]] == [0.0, 1.0]


def test_a_replay_has_what_blocked_the_vehicle_in_the_cycles_that_know_it() -> None:
    spec = TrialSpec.load("turns", "kraft", seed=0)
    result = fake_trials.quick(spec)
    corners = np.array([[1.0, 2.0], [1.4, 2.0], [1.4, 2.2], [1.0, 2.2]])
    free = result.cycles[0]
    replay = replay_of(spec, replace(result, cycles=(free, replace(free, blocked=(Polygon(corners),)))))
    assert replay is not None
    before, after = unpacked(replay.drive)["cycles"]
    assert "blocked" not in before
    (polygon,) = after["blocked"]
    assert np.column_stack([values_of(axis) for axis in polygon]) == pytest.approx(corners, abs=0.006)


def test_branches_of_a_tree_are_whole_and_its_lines_follow_the_edges() -> None:
    """Every line is a piece of one edge: no farther than the car drives meanwhile, and its points are on that edge."""
    spec = TrialSpec.load("turns", "kraft", seed=0)
    vehicle, advance = spec.vehicle, kernels(spec.vehicle).advance
    random, nodes = np.random.default_rng(0), 200
    states, controls = np.zeros((nodes, len(vehicle.state))), np.zeros((nodes, len(vehicle.controls)))
    parents, durations, fine = np.full(nodes, -1), np.zeros(nodes), [states[:1]]
    low, high = vehicle.control_bounds.T
    for node in range(1, nodes):
        parents[node] = random.integers(max(0, node - 20), node)
        controls[node], durations[node] = random.uniform(low, high), random.uniform(0.5, 1.0)
        driven = [states[parents[node]].copy()]
        for _ in range(100):
            after = np.empty_like(driven[-1])
            advance(driven[-1], controls[node], vehicle.parameter_array, durations[node] / 100, after)
            driven.append(after)
        states[node] = driven[-1]
        fine.append(np.array(driven))
    zeros = np.zeros(nodes)
    tree = TreeView(states, parents, controls, durations, zeros, zeros)
    result = fake_trials.quick(spec)
    cycles = (replace(result.cycles[0], tree=tree), *result.cycles[1:])
    replay = replay_of(spec, replace(result, cycles=cycles))
    assert replay is not None
    assert replay.trees is not None
    quantum, dx, dy, before = unpacked(replay.trees)[0]
    points = np.column_stack([dx, dy]).astype(float)
    for k, point in enumerate(before):
        assert point < k
        points[k] += points[point] if point >= 0 else 0.0
    assert before.count(-1) == 1
    assert 200 < len(points) <= POINTS
    axes = [vehicle.index("x"), vehicle.index("y")]
    samples = np.vstack(fine)[:, axes]
    middles = (points[1:] + points[before[1:]]) / 2
    for places, tolerance in ((points, 0.015), (middles, 0.05)):
        nearest = np.hypot(*(quantum * places[:, None] - samples[None]).transpose(2, 0, 1)).min(axis=1)
        assert nearest.max() < tolerance
    lengths = quantum * np.hypot(*(points[1:] - points[before[1:]]).T)
    assert lengths.max() <= GRID * max(map(abs, states[:, vehicle.rest_indices[0]])) + 0.03


def row(seed: int, drive: str) -> TrialRow:
    return TrialRow(
        entry="turns", scenario="turns", method="kraft", seed=seed, outcome="success", t_s=9.0,
        replay=Replay(drive, "t"),
    )  # fmt: skip


def test_replays_are_written_beside_the_trials_and_an_incomplete_line_is_repeated(tmp_path: Path) -> None:
    path = tmp_path / "trials.jsonl"
    journal = Journal(path)
    journal.append(row(3, "first"))
    journal.close()
    assert "first" not in path.read_text()
    with (tmp_path / REPLAYS).open("a") as file:
        file.write('{"entry": "turns", "meth')
    replays = Replays(tmp_path / REPLAYS)
    assert (len(replays), KEY in replays, replays.read(KEY)) == (1, True, Replay("first", "t"))
    journal = Journal(path)
    journal.append(row(4, "second"))
    journal.append(row(3, "again"))
    journal.close()
    replays = Replays(tmp_path / REPLAYS)
    assert (len(replays), replays.read(KEY).drive, replays.sizes(KEY)) == (2, "again", (5, 1))


def test_a_file_without_replays_has_none_and_a_damaged_line_is_refused(tmp_path: Path) -> None:
    file = tmp_path / REPLAYS
    assert len(Replays(file)) == 0
    file.write_text(
        json.dumps({"entry": "turns", "method": "kraft", "seed": 3, "drive": "d", "trees": None}) + "\n{}\n"
    )
    with refused((f"{file}:2:1", Code.SYNTAX)):
        Replays(file)


def test_a_line_that_is_damaged_or_another_one_when_it_is_read_is_refused_by_its_number(tmp_path: Path) -> None:
    file = tmp_path / REPLAYS
    lines = [
        json.dumps({"entry": "turns", "method": "kraft", "seed": k, "drive": "d", "trees": None}) for k in (2, 3, 4)
    ]
    file.write_text("".join(f"{line}\n" for line in lines))
    replays = Replays(file)
    for second in (lines[2], "x" * len(lines[1])):
        file.write_text("".join(f"{line}\n" for line in (lines[0], second, lines[2])))
        with refused((f"{file}:2:1", Code.SYNTAX)):
            replays.read(KEY)
    assert replays.read(("turns", "kraft", 2)) == Replay("d", None)
