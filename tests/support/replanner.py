"""What the tests of replanning share: a replanner in Turns, and a vehicle that is where it is predicted to be."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache

import numpy as np

from kraft.driving.bound import DeviationBound
from kraft.driving.car_model import CarModel
from kraft.driving.control import make_controller
from kraft.driving.control_settings import Kinodynamic, OpenLoop
from kraft.driving.messages import Cycle, Estimate, Uncertainty
from kraft.driving.plan_search import PlanSearch
from kraft.driving.planner_settings import Clearance, PlannerSettings
from kraft.driving.proposal import Proposal
from kraft.driving.proposer import Proposer
from kraft.driving.replanner import Replanner
from kraft.driving.solvers import Solvers
from kraft.planning.workspace import start_state
from kraft.scenario import Task, load_scenario
from kraft.vehicles.load import load_vehicle
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle

MARGIN = Clearance(delta=0.05, delta_per_speed=0.25)
FARSIGHTED = Clearance(delta=0.02, delta_per_speed=0.05, foresight=3.0)
BESIDE_THE_WALL = np.array([1.96, 0.0, math.pi / 2, 0.0])  # 0.1 m from the right wall


@cache
def turns() -> Task:
    return load_scenario("turns").task()


@cache
def mushr() -> Vehicle:
    return load_vehicle("mushr")


def planner_settings(**settings: object) -> PlannerSettings:
    return PlannerSettings(**{"mode": "replanning", "iterations": 300, "lead": 0.1, **settings})  # type: ignore[arg-type]


def proposer(seed: int = 0, task: Task | None = None, realtime: bool = False, **settings: object) -> Proposer:
    planner = planner_settings(**settings)
    return Proposer(PlanSearch(Solvers.of(task or turns(), mushr(), planner), planner, seed, realtime=realtime))


def replanner(
    seed: int = 0,
    task: Task | None = None,
    tracking: bool = False,
    model: str = "mushr",
    delay: float = 0.0,
    command_timeout: float | None = None,
    realtime: bool = False,
    **settings: object,
) -> Replanner:
    planner = planner_settings(**settings)
    kind = Kinodynamic(kind="kinodynamic") if tracking else OpenLoop(kind="open_loop")
    vehicle = load_vehicle(model)
    controller = make_controller(kind, CarModel(vehicle))
    return Replanner(
        Solvers.of(task or turns(), vehicle, planner), planner, controller, seed, period=1 / 30, delay=delay,
        command_timeout=command_timeout, realtime=realtime,
    )  # fmt: skip


def start() -> Floats:
    return start_state(turns(), mushr())


def proposals(subject: Proposer, *bounds: DeviationBound) -> Iterator[Proposal]:
    """Proposals with a bound each, from the start of Turns and then from where each plan leads in a cycle."""
    root, plan = start(), None
    for number, bound in enumerate(bounds):
        subject.set_bound(bound)
        proposal = subject.propose(number, root, plan)
        yield proposal
        plan = proposal.plan
        assert plan is not None
        root = np.array([np.interp(1.0, plan.times, column) for column in plan.trajectory.T])


def share_kept(subject: Proposer) -> float:
    """Share of the bound that the last plan keeps."""
    return subject.levels.all[subject.levels.kept].share


def drive(
    subject: Replanner,
    cycles: int,
    error: Floats | None = None,
    begin: Floats | None = None,
    uncertainty: Uncertainty | None = None,
) -> list[Cycle]:
    """Cycles of a vehicle that is, up to `error`, where it is predicted to be."""
    state, time = start() if begin is None else begin, 0.0
    current = subject.begin(state)
    found: list[Cycle] = []
    for _ in range(cycles):
        estimated = state if error is None or not found else state + error
        found.append(subject.step(Estimate(time, estimated, 0.0, None, uncertainty), current))
        current, time = found[-1].commitment, subject.next_step
        predicted = found[-1].predicted
        state = np.array([np.interp(time, predicted.times, column) for column in predicted.states.T])
    return found
