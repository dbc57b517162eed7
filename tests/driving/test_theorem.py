"""Theorem 1: deviations within delta, as bad as they can be, and no collision.  The whole sweep is a benchmark."""

from __future__ import annotations

from functools import cache

import pytest

from benchmarks import theorem
from benchmarks.effort import SMOKE
from benchmarks.theorem import Episode, episode, run
from kraft.driving.messages import Commitment
from kraft.driving.proposal import Proposal
from kraft.driving.references import plan_reference
from kraft.driving.safety_check import CycleStart, Decision, SafetyCheck


@cache
def driven(number: int) -> Episode:
    return episode(number)


@pytest.fixture(scope="module")
def episodes() -> list[Episode]:
    return [driven(number) for number in range(16)]  # every method, vehicle and world twice


def test_no_episode_ends_in_a_collision(episodes: list[Episode]) -> None:
    assert [each.number for each in episodes if each.clearance <= 0.0] == []


def test_the_world_never_deviates_by_more_than_the_theorem_allows(episodes: list[Episode]) -> None:
    assert sum(each.broken for each in episodes) == 0


def test_no_vehicle_collides_whose_messages_are_lost() -> None:
    """Theorem 1, case (b): from the end of the cycle on it tracks the contingency on board."""
    lossy = [episode(number, loss=0.4) for number in range(16)]
    assert [each.number for each in lossy if each.clearance <= 0.0] == []
    assert sum(each.broken for each in lossy) == 0
    assert sum(each.cycles for each in lossy) > 60


def test_vehicles_move_stop_and_arrive(episodes: list[Episode]) -> None:
    assert sum(each.cycles for each in episodes) > 100
    assert sum(each.contingencies for each in episodes) > 0
    assert any(each.arrived for each in episodes)


def test_all_cycles_of_an_episode_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(theorem, "CYCLES", 2)
    assert episode(0).cycles == 2


def test_without_the_check_before_a_cycle_the_hostile_world_hits(monkeypatch: pytest.MonkeyPatch) -> None:
    def trusting(self: SafetyCheck, proposal: Proposal, start: CycleStart) -> Decision:
        if proposal.plan is None:
            return self._choose_contingency(start, None, proposal.reason)
        reference = plan_reference(self._dirt.vehicle, proposal.plan, start.time)
        predicted = self._predict(start.root, start.time, start.time + 1.0, Commitment(reference))
        return Decision(reference, predicted, "", proposal.plan)

    monkeypatch.setattr(SafetyCheck, "decide", trusting)
    assert any(episode(number).clearance <= 0.0 for number in range(27, 90, 2))  # as a rule the first one


def test_the_sweep_reports_what_it_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(theorem, "episode", driven)
    report = run(SMOKE)
    found = {row.quantity: row.median for row in report.rows}
    assert found["episodes"] == SMOKE.episodes
    assert found["collisions"] == 0
