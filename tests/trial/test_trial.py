"""Whole trials in the simulated world: delays, blindness, how they end, and that they repeat."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from kraft.driving.estimation.adaptive import AdaptiveEstimator
from kraft.driving.messages import Cycle, ReferenceKind, as_driven
from kraft.driving.method import load_method
from kraft.driving.planner_settings import PlannerSettings
from kraft.scenario import load_scenario
from kraft.simulation.world import World
from kraft.trial.cause import CauseKind
from kraft.trial.plant import Radio
from kraft.trial.result import Outcome, Step, TrialResult, TrialSpec
from kraft.trial.trial import run_trial
from kraft.vehicles.load import load_vehicle

SCENE = """name: short
bounds: {x: [0, 5], y: [0, 4]}
obstacles:
  - {name: pillar, box: {center: [2, 2.5], size: [0.5, 0.5]}}
start: {x: 0.6, y: 1, heading_deg: 0}
goal: {center: [3.4, 1], radius: 0.4}
"""
AIMLESS = "trial: {timeout: 6, oneshot_timeout: 6}\n"


def spec(folder: Path, method: str, more: str = "", scene: str = SCENE, seed: int = 0) -> TrialSpec:
    (folder / "short.yaml").write_text(scene + more)
    found = load_method(method)
    return TrialSpec(load_scenario(folder / "short.yaml"), found, load_vehicle(found.planner.vehicle or "mushr"), seed)


def everything(result: TrialResult) -> bytes:
    """All that a trial leaves, except for what the clock said."""
    parts: list[object] = [result.outcome, result.time, result.obstacle, result.min_clearance]
    for step in result.steps:
        parts += [step.time, *step.pose, step.speed, step.estimate.tobytes(), step.command.tobytes(), step.cycle]
    for seen in result.observations:
        parts += [seen.time, seen.arrival, seen.x, seen.y, seen.theta]
    for cycle in result.cycles:
        parts += [cycle.number, cycle.time, cycle.speed, cycle.kind, cycle.reason, cycle.cost_to_goal, cycle.clearance]
        parts += [cycle.iterations, cycle.nodes, cycle.retained, cycle.predicted.states.tobytes()]
        for reference in (cycle.reference, cycle.contingency):
            if reference is not None:
                parts += [reference.times.tobytes(), reference.states.tobytes(), reference.controls.tobytes()]
    return repr(parts).encode()


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.35, 1.0])
def test_what_is_committed_is_tracked_when_its_cycle_begins_and_it_has_arrived(tmp_path: Path, delay: float) -> None:
    """A step is 0.1 s before its cycle: of a delay, what is longer than that is how much later a cycle begins."""
    sensing = f"sensing: {{communication_delay: {delay}}}\n"
    result = run_trial(spec(tmp_path, "replanner-openloop", sensing + AIMLESS))
    assert len(result.cycles) >= 3
    late = max(0.0, delay - 0.1)
    assert [cycle.time for cycle in result.cycles[:3]] == pytest.approx([late, 1.0 + late, 2.0 + late])
    for cycle in result.cycles:  # what is checked is what is tracked
        assert (cycle.predicted.times[0], cycle.predicted.times[-1]) == pytest.approx((cycle.time, cycle.time + 1.0))
    for step in result.steps:
        known = [cycle for cycle in result.cycles if cycle.time <= step.time + 1e-9]
        expected = known[-1].reference.control_at(step.time) if known else np.zeros(2)
        np.testing.assert_array_equal(step.command, expected)


@pytest.mark.parametrize("delay", [0.1, 0.333])
def test_commands_take_effect_after_their_delay(tmp_path: Path, delay: float) -> None:
    prompt = run_trial(spec(tmp_path, "oneshot-openloop", AIMLESS))
    late = run_trial(spec(tmp_path, "oneshot-openloop", f"sensing: {{command_delay: {delay}}}\n" + AIMLESS))
    then = [step.time for step in prompt.steps if step.speed > 0.02]
    now = [step.time for step in late.steps if step.speed > 0.02]
    assert now[0] - then[0] == pytest.approx(delay, abs=0.034)  # speeds are looked at 30 times a second
    for before, after in zip(prompt.steps, late.steps, strict=False):
        np.testing.assert_array_equal(before.command, after.command)  # open loop: sent as before


@pytest.mark.parametrize("method", ["kraft", "conservative-kraft", "filtered-kraft"])
def test_a_vehicle_that_is_never_seen_stops_after_its_first_cycle(tmp_path: Path, method: str) -> None:
    result = run_trial(spec(tmp_path, method, "sensing: {dropout: 1}\n" + AIMLESS))
    assert result.observations == ()
    assert (result.outcome, result.time) == (Outcome.TIMEOUT, pytest.approx(6.0))
    assert [cycle.kind for cycle in result.cycles] == [ReferenceKind.PLAN] + [ReferenceKind.CONTINGENCY] * (
        len(result.cycles) - 1
    )
    assert all("no observation has arrived" in cycle.reason for cycle in result.cycles[1:])
    assert abs(result.steps[-1].speed) < 0.01
    stands = [step.pose for step in result.steps if step.time > 4.0]
    assert max(math.dist(pose[:2], stands[0][:2]) for pose in stands) < 0.01
    assert math.dist(stands[0][:2], (0.6, 1.0)) < 1.0


def test_a_vehicle_that_is_hidden_for_less_than_its_patience_drives_on(tmp_path: Path) -> None:
    result = run_trial(spec(tmp_path, "kraft", "sensing: {rate_hz: 3, dropout: 0}\n"))
    assert result.outcome is Outcome.SUCCESS
    assert not any("newest observation" in cycle.reason for cycle in result.cycles)


@pytest.mark.parametrize("method", ["conservative-kraft", "oneshot-geometric"])
def test_the_same_spec_gives_the_same_bytes_and_another_seed_others(tmp_path: Path, method: str) -> None:
    first, again, other = (everything(run_trial(spec(tmp_path, method, AIMLESS, seed=k))) for k in (7, 7, 8))
    assert first == again
    assert first != other


def test_observing_changes_nothing(tmp_path: Path) -> None:
    cycles: list[Cycle] = []
    steps: list[Step] = []

    def on_step(world: World, step: Step) -> None:
        assert world.time == step.time
        steps.append(step)

    alone = run_trial(spec(tmp_path, "kraft", AIMLESS))
    watched = run_trial(spec(tmp_path, "kraft", AIMLESS), cycles.append, on_step, keep_trees=True)
    assert everything(alone) == everything(watched)
    assert (tuple(cycles), tuple(steps)) == (watched.cycles, watched.steps)
    assert all(cycle.tree is None for cycle in alone.cycles)
    assert any(cycle.tree is not None for cycle in watched.cycles)


def test_a_trial_succeeds_where_the_vehicle_truly_is_in_the_goal(tmp_path: Path) -> None:
    result = run_trial(spec(tmp_path, "kraft"))
    assert (result.outcome, result.obstacle) == (Outcome.SUCCESS, None)
    assert math.dist(result.steps[-1].pose[:2], (3.4, 1.0)) < 0.4 + 0.05  # at the tick before
    assert all(math.dist(step.pose[:2], (3.4, 1.0)) > 0.4 for step in result.steps)
    assert 0.0 < result.time - result.steps[-1].time <= 0.034 + 1e-9  # its arrival is tested at frames and commands
    assert 0.0 < result.min_clearance < math.inf


def test_a_trial_ends_with_the_first_collision(tmp_path: Path) -> None:
    """Blind driving with a crooked steering ends at the box."""
    scene = SCENE.replace("center: [2, 2.5]", "center: [1.9, 1.42]")
    crooked = "truth: {vehicle: {steering_offset_deg: 12}}\n"
    result = run_trial(spec(tmp_path, "oneshot-openloop", crooked, scene))
    assert (result.outcome, result.obstacle) == (Outcome.COLLISION, "pillar")
    assert result.time < 10.0
    assert result.time - 1 / 30 - 1e-9 <= result.steps[-1].time <= result.time
    assert result.min_clearance < 0.05


@pytest.mark.parametrize("method", ["kraft", "oneshot-kinodynamic"])
def test_a_trial_ends_at_the_time_limit_of_its_kind_of_method(tmp_path: Path, method: str) -> None:
    result = run_trial(spec(tmp_path, method, "trial: {timeout: 1.5, oneshot_timeout: 0.8}\n"))
    limit = 0.8 if method.startswith("oneshot") else 1.5
    assert (result.outcome, result.time) == (Outcome.TIMEOUT, pytest.approx(limit))


@pytest.mark.parametrize(("seconds", "late"), [(0.03, False), (0.04, True)])
def test_every_command_is_timed_and_late_after_the_time_between_two(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seconds: float, late: bool
) -> None:
    readings = itertools.count(step=seconds)
    monkeypatch.setattr("kraft.trial.trial.time", SimpleNamespace(perf_counter=lambda: next(readings)))
    result = run_trial(spec(tmp_path, "kraft", AIMLESS))
    assert result.command_ms == pytest.approx([1000.0 * seconds] * len(result.steps))
    assert result.late_commands == (len(result.steps) if late else 0)


def test_one_shot_decides_once(tmp_path: Path) -> None:
    result = run_trial(spec(tmp_path, "oneshot-kinodynamic"))
    assert result.time > 3.0
    assert len(result.cycles) == 1
    assert {step.cycle for step in result.steps} == {0}
    assert len(result.measures.deviation_mm) == 10  # it is predicted for its first cycle, of 1 s


FAR = SCENE.replace("x: [0, 5]", "x: [0, 9]").replace("center: [3.4, 1]", "center: [8, 1]") + AIMLESS


def with_settings(found: TrialSpec, **settings: object) -> TrialSpec:
    """A trial whose planner has other settings, checked as those of a file."""
    planner = PlannerSettings.model_validate({**found.method.planner.model_dump(), **settings})
    return replace(found, method=found.method.model_copy(update={"planner": planner}))


def fail_after(monkeypatch: pytest.MonkeyPatch, messages: int) -> None:
    """Let the radio lose all messages after the first ones."""

    def delivers(self: Radio) -> bool:
        self._sent += 1
        self.lost += self._sent > messages
        return self._sent <= messages

    monkeypatch.setattr(Radio, "delivers", delivers)


@pytest.mark.parametrize("contingencies", ["model", "tracked"])
@pytest.mark.parametrize("messages", [1, 3])
def test_a_car_without_messages_stops_with_the_contingency_on_board(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, messages: int, contingencies: str
) -> None:
    fail_after(monkeypatch, messages)
    found = spec(tmp_path, "filtered-kraft", scene=FAR)
    result = run_trial(with_settings(found, on_board="contingency", contingencies=contingencies))
    last, first_lost = result.cycles[messages - 1], result.cycles[messages]
    assert (last.kind, last.switch, first_lost.delivered) == (ReferenceKind.PLAN, messages, False)
    assert last.contingency is not None
    assert last.stopping is not None
    assert max(step.speed for step in result.steps if step.time < messages) > 0.3
    standing = [step for step in result.steps if step.time > last.stopping.times[-1] + 0.5]
    assert len(standing) > 30
    assert max(abs(step.speed) for step in standing) < 0.02
    expected = last.stopping.final_state
    assert math.dist(standing[-1].pose[:2], expected[:2]) < 0.15
    assert math.dist(last.contingency.states[-1][:2], expected[:2]) < 0.1
    assert result.measures.messages_lost == len(result.cycles) - messages


def test_a_car_on_its_plan_drives_on_without_messages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fail_after(monkeypatch, 1)
    result = run_trial(spec(tmp_path, "filtered-kraft", scene=FAR))
    assert result.cycles[0].switch == math.inf
    assert result.steps[-1].speed > 0.3 or result.outcome is not Outcome.TIMEOUT


def test_after_a_lost_message_the_replanner_predicts_that_the_car_stops(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_after(monkeypatch, 3)
    found = spec(tmp_path, "filtered-kraft", scene=FAR)
    result = run_trial(with_settings(found, on_board="contingency"))
    for cycle in result.cycles[4:]:
        true = min(result.steps, key=lambda step: abs(step.time - cycle.time))
        assert math.dist(cycle.predicted.states[0][:2], true.pose[:2]) < 0.15
        assert abs(float(cycle.predicted.states[0][3]) - true.speed) < 0.1
    plans = [cycle for cycle in result.cycles[5:] if cycle.kind is ReferenceKind.PLAN]
    assert plans, "it goes on planning from where the car stands"


def test_what_is_drawn_after_a_lost_message_is_the_contingency(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fail_after(monkeypatch, 2)
    result = run_trial(with_settings(spec(tmp_path, "filtered-kraft", scene=FAR), on_board="contingency"))
    driven = as_driven(result.cycles)
    assert driven[:2] == result.cycles[:2]
    assert all(cycle.kind is ReferenceKind.CONTINGENCY for cycle in driven[2:])
    assert all(cycle.reference is result.cycles[1].contingency for cycle in driven[2:])


def test_the_watchdog_stops_a_car_whose_poses_stay_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The camera sees nothing after 1.5 s; without a watchdog the car tracks its plan until the end of the cycle."""
    from kraft.trial.plant import Plant

    expose = Plant.expose
    monkeypatch.setattr(Plant, "expose", lambda self: expose(self) if self.world.time < 1.5 else _missed(self))
    found = with_settings(spec(tmp_path, "filtered-kraft", scene=FAR), on_board="contingency")
    without, stopped = run_trial(found), run_trial(with_settings(found, watchdog=0.2))
    assert (without.measures.watchdog_stops, stopped.measures.watchdog_stops) == (0, 1)
    first = next(step.time for step in stopped.steps if step.watchdog)
    assert 1.65 < first < 1.8
    assert all(step.watchdog for step in stopped.steps if step.time >= first)
    assert abs(stopped.steps[-1].speed) < 0.02
    assert stopped.steps[-1].pose[0] < without.steps[-1].pose[0]


def _missed(plant: object) -> None:
    plant._frames.number += 1  # type: ignore[attr-defined]


def test_a_car_on_its_plan_is_stopped_by_the_watchdog_without_messages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_after(monkeypatch, 2)
    result = run_trial(with_settings(spec(tmp_path, "filtered-kraft", scene=FAR), watchdog=0.5))
    assert result.measures.watchdog_stops == 1
    assert next(step.time for step in result.steps if step.watchdog) == pytest.approx(1.0 + 1.0 + 0.5, abs=0.07)
    assert abs(result.steps[-1].speed) < 0.02


def test_a_car_drives_on_after_its_watchdog_stopped_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from kraft.trial.plant import Plant

    expose = Plant.expose
    seen = lambda time: not 1.5 < time < 2.3  # noqa: E731
    monkeypatch.setattr(Plant, "expose", lambda self: expose(self) if seen(self.world.time) else _missed(self))
    found = with_settings(spec(tmp_path, "filtered-kraft"), on_board="contingency", watchdog=0.2)
    found = replace(found, scenario=load_scenario(tmp_path / "short.yaml"))
    result = run_trial(found)
    assert result.measures.watchdog_stops >= 1
    assert result.outcome is Outcome.SUCCESS


def test_trials_with_everything_on_board_repeat(tmp_path: Path) -> None:
    sensing = "sensing: {message_loss: 0.4, dropout: 0.8}\n"
    found = spec(tmp_path, "filtered-kraft", sensing + AIMLESS, seed=3)
    found = with_settings(found, on_board="contingency", watchdog=0.4, contingencies="tracked")
    assert everything(run_trial(found)) == everything(run_trial(found))


def test_a_car_that_is_seen_too_far_uphill_drives_on_to_the_goal() -> None:
    """The camera takes the floor as level: plans end in the goal before the car is there, and the law drives on."""
    result = run_trial(TrialSpec.load("slope", "filtered-kraft", seed=0))
    assert result.outcome is Outcome.SUCCESS
    assert result.time < 25.0


def test_nothing_is_identified_from_the_time_in_which_something_held_the_vehicle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A block of 30 kg that the map does not have stands in the way."""
    left_out, leave_out = list[tuple[float, float]](), AdaptiveEstimator.leave_out

    def recorded(self: AdaptiveEstimator, begin: float, end: float) -> None:
        leave_out(self, begin, end)
        left_out.append((begin, end))
        assert all(last < begin or first > end for first, last in self._history.moving)

    monkeypatch.setattr(AdaptiveEstimator, "leave_out", recorded)
    block = "truth: {movable_boxes: [{center: [1.5, 1], size: [0.4, 1.2, 0.2], mass: 30}]}\n"
    result = run_trial(spec(tmp_path, "adaptive-kraft", block + "trial: {timeout: 12}\n"))
    held = [cycle.held for cycle in result.cycles if cycle.held is not None]
    assert held == left_out
    assert held
    assert all(end - begin >= 2.0 for begin, end in held)


def bundled(method: str, settings: dict[str, object]) -> TrialSpec:
    """Spec of `boxes` with keys that are set."""
    found = load_method(method)
    return TrialSpec(load_scenario("boxes", settings), found, load_vehicle(found.planner.vehicle or "mushr"), 0)


def test_a_true_car_beyond_its_footprint_collides_where_the_footprint_does_not() -> None:
    car = {"truth.car": {"length": 0.9, "width": 0.5, "wheelbase": 0.6}, "start.y": -0.4}
    result = run_trial(bundled("kraft", car))
    assert result.outcome is Outcome.COLLISION
    assert result.min_clearance > 0.1
    assert result.cause is not None
    assert result.cause.kind is CauseKind.UNCOVERED


def test_a_single_plan_that_is_sent_open_loop_never_collides_because_of_an_estimate() -> None:
    noisy = {"sensing.noise_scale": 20.0}
    for method, kind in (("oneshot-openloop", CauseKind.DEVIATION), ("oneshot-geometric", CauseKind.ESTIMATE_WRONG)):
        result = run_trial(bundled(method, noisy))
        assert result.outcome is Outcome.COLLISION
        assert result.cause is not None
        assert result.cause.kind is kind
