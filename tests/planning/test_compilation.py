"""Compilation before planning: what is compiled, when, and what is said of it."""

from __future__ import annotations

import threading
from dataclasses import replace

import pytest

from kraft.planning.compilation import Needs, ensure_all_compiled, ensure_compiled
from kraft.scenario import load_scenario
from kraft.vehicles.load import load_vehicle
from kraft.vehicles.mushr import MUSHR, MUSHR_LAG
from ompl_ext.vehicle import Vehicle


def test_what_identification_needs_is_compiled_before_a_vehicle_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    vehicle, messages, compiled = load_vehicle("mushr"), list[str](), list[Vehicle]()
    ensure_compiled(vehicle, lambda _: None)
    monkeypatch.setattr("kraft.sysid.elimination.is_cached", lambda: False)
    monkeypatch.setattr("kraft.sysid.factor_graph.compile_identification", compiled.append)
    ensure_compiled(vehicle, messages.append)
    assert (messages, compiled) == ([], [])
    ensure_compiled(vehicle, messages.append, steps=True)
    assert "the identification" in messages[0]
    assert compiled == [vehicle]
    assert len([message for message in messages if not message.startswith(" ")]) == 2


def test_the_cost_to_go_of_poses_is_compiled_for_methods_and_for_goals_that_need_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    vehicle, messages, compiled = load_vehicle("mushr"), list[str](), list[str]()
    ensure_compiled(vehicle, lambda _: None, poses=True)
    monkeypatch.setattr("kraft.planning.compilation.is_compiled", lambda name: name != "poses")
    monkeypatch.setattr("kraft.planning.shared_kernels.compile_shared", compiled.append)
    ensure_compiled(vehicle, messages.append)
    assert (messages, compiled) == ([], [])
    ensure_compiled(vehicle, messages.append, poses=True)
    assert compiled == ["poses"]
    assert messages[0].startswith("compiling the cost-to-go of poses for this machine")


def test_a_goal_with_a_heading_needs_the_cost_to_go_of_poses_and_the_local_optimisation() -> None:
    vehicle, goal = load_vehicle("mushr"), load_scenario("turns").goal
    assert Needs.of_goal(vehicle, goal) == Needs(vehicle)
    assert Needs.of_goal(vehicle, load_scenario("parking").goal) == Needs(vehicle, polish=True, poses=True)


def test_what_one_or_the_other_needs_is_needed() -> None:
    vehicle = load_vehicle("mushr")
    one, other = Needs(vehicle, steps=True, modules=("sst",)), Needs(vehicle, polish=True, modules=("rollouts", "sst"))
    assert one | other == Needs(vehicle, steps=True, polish=True, modules=("sst", "rollouts"))
    assert one | Needs(vehicle) == one


def test_the_time_of_a_long_compilation_is_told_while_it_lasts(monkeypatch: pytest.MonkeyPatch) -> None:
    vehicle, messages, told = load_vehicle("mushr"), list[str](), threading.Event()

    def report(text: str) -> None:
        messages.append(text)
        if len(messages) == 3:
            told.set()

    def long_compilation(_: Vehicle) -> None:
        assert told.wait(30.0), "it lasts until it is told of twice"

    ensure_compiled(vehicle, lambda _: None)
    monkeypatch.setattr("kraft.planning.compilation.is_polish_cached", lambda _: False)
    monkeypatch.setattr("kraft.planning.compilation.polish_kernels", long_compilation)
    monkeypatch.setattr("kraft.elapsed.INTERVAL", 0.01)
    ensure_compiled(vehicle, report, polish=True)
    assert messages[1] == messages[2] == "  0 s: compiling the local optimisation for mushr"
    assert messages[-1].startswith("compiled in 0 s")


def test_each_part_that_is_compiled_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    vehicle, messages, compiled = load_vehicle("mushr"), list[str](), list[str]()
    monkeypatch.setattr("kraft.planning.compilation.is_polish_cached", lambda _: False)
    monkeypatch.setattr("kraft.planning.compilation.polish_kernels", lambda _: compiled.append("polish"))
    monkeypatch.setattr("kraft.planning.compilation.is_module_cached", lambda *_: False)
    monkeypatch.setattr("kraft.planning.compilation.optional_module", lambda _, name: compiled.append(name))
    ensure_compiled(vehicle, messages.append, polish=True, modules=("rollouts", "sst"))
    assert compiled == ["polish", "rollouts", "sst"]
    assert messages[0].startswith("compiling 3 parts for this machine, once: ")
    assert messages[1:4] == [
        "  0 s: compiled the local optimisation for mushr (1 of 3)", "  0 s: compiled the rollouts for mushr (2 of 3)",
        "  0 s: compiled the planner sst for mushr (3 of 3)",
    ]  # fmt: skip
    assert messages[4].startswith("compiled in 0 s")


def test_what_several_vehicles_need_is_one_compilation(monkeypatch: pytest.MonkeyPatch) -> None:
    messages, compiled = list[str](), list[str]()
    for cached, yes in (("is_compiled", True), ("is_model_cached", True), ("is_cached", False)):
        monkeypatch.setattr(f"kraft.planning.compilation.{cached}", lambda _, yes=yes: yes)
    monkeypatch.setattr("kraft.planning.compilation._exercise", lambda vehicle: compiled.append(vehicle.name))
    ensure_all_compiled([Needs(load_vehicle(name)) for name in ("mushr", "jackal")], messages.append)
    assert compiled == ["mushr", "jackal"]
    assert messages[0].startswith("compiling 2 parts for this machine, once: ")
    assert messages[0].endswith(": the checks for mushr; the checks for jackal ...")
    assert [message for message in messages if message.startswith("compil")] == [messages[0], messages[-1]]


def test_two_vehicles_of_one_name_are_both_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled = list[Vehicle]()
    for cached, yes in (("is_cached", True), ("is_compiled", True), ("is_polish_cached", False)):
        monkeypatch.setattr(f"kraft.planning.compilation.{cached}", lambda _, yes=yes: yes)
    monkeypatch.setattr("kraft.planning.compilation.polish_kernels", compiled.append)
    vehicles = [replace(vehicle, name="car") for vehicle in (MUSHR, MUSHR_LAG)]
    twice = [Needs(vehicle, polish=True) for vehicle in (*vehicles, vehicles[0])]
    ensure_all_compiled(twice, lambda _: None)
    assert compiled == vehicles
