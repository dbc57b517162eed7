"""Record runs: drive manoeuvres in the simulated world and log commands, measured poses and true poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from kraft.driving.car_model import model_of
from kraft.errors import Code, InputError
from kraft.recording.free_space import FreeSpace, Place, predicted
from kraft.recording.manoeuvres import NAMES, Manoeuvre, manoeuvre
from kraft.scenario import Scenario
from kraft.simulation.true_world import world_of
from kraft.trial.plant import Plant
from ompl_ext.arrays import Matrix
from ompl_ext.vehicle import Vehicle

COMMAND_RATE: Final = 20.0
"""Rate of the commands, 1/s: not the camera's, so that the two are asynchronous, as on a real car."""
STOP: Final = 0.1
"""Clearance of the true car at which a run ends, m."""
SHORTEST: Final = 2.0
"""A scenario is refused if a manoeuvre has free space for less than this time, s."""


@dataclass(frozen=True)
class Recording:
    """Recorded run.

    Attributes:
        number: number of the run, from 1.
        manoeuvre: commanded manoeuvre.
        place: start of the run.
        controls: names of the vehicle's controls.
        commands: time of sending (s) and control, (m, 1 + nu).
        poses: time of the frame (s) and measured x, y (m) and yaw (rad), (n, 4).
        truth: time (s) and true x, y (m), yaw (rad) and speed (m/s) at every frame of the camera, (k, 5).
        end: time of its end, s.
        note: why it ended early; empty if it did not.
    """

    number: int
    manoeuvre: Manoeuvre
    place: Place
    controls: tuple[str, ...]
    commands: Matrix
    poses: Matrix
    truth: Matrix
    end: float
    note: str = ""


class Recorder:
    """Records runs in a scenario.  A run depends on the scenario, the seed and its number alone."""

    def __init__(self, scenario: Scenario, vehicle: Vehicle, seed: int) -> None:
        """Build the world.

        Args:
            scenario: where to drive; its start and goal are not used.
            vehicle: model: bounds of its controls, footprint and predicted paths.
            seed: seed of manoeuvres, starts and the camera's errors.

        Raises:
            InputError: if the true robot cannot be simulated there, or takes other controls.
        """
        self._scenario, self._seed = scenario, seed
        self._model = model_of(vehicle)
        self._free_space = FreeSpace(scenario, vehicle)
        self._world = world_of(scenario, vehicle, seed)

    def record(self, number: int) -> Recording:
        """Drive run `number`, from 1.

        Raises:
            InputError: if the scenario has no free space for the manoeuvre.
        """
        generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence([self._seed, number, 0x10C5])))
        commanded = manoeuvre(NAMES[(number - 1) % len(NAMES)], self._model.drive_control, generator)
        place = self._free_space.place(predicted(self._model, commanded), generator)
        if place.time < SHORTEST:
            name = self._scenario.name
            problem = f"has no free space for a run of {SHORTEST:g} s (manoeuvre {commanded.name!r})"
            expected = "expected more free floor, as in the scenario training"
            raise InputError.of(name, problem, expected, Code.GEOMETRY)
        self._world.reset(place.start)
        seed = int(generator.integers(2**62))
        plant = Plant(self._world, self._scenario, self._model.vehicle.controls, seed, COMMAND_RATE)
        return _Run(plant, self._free_space, commanded, place).drive(number)


class _Run:
    """Run in progress."""

    def __init__(self, plant: Plant, free_space: FreeSpace, commanded: Manoeuvre, place: Place) -> None:
        self._plant, self._world, self._free_space = plant, plant.world, free_space
        self._manoeuvre, self._place = commanded, place
        self._commands: list[tuple[float, ...]] = []
        self._poses: list[tuple[float, ...]] = []
        self._truth: list[tuple[float, ...]] = []

    def drive(self, number: int) -> Recording:
        """Drive to the end of the manoeuvre, or until the clearance is too small."""
        world, end = self._world, round(self._manoeuvre.end / self._world.dt)
        note = ""
        while not note:
            self._observe()
            self._send()
            if world.steps >= end:
                break
            self._plant.advance(end)
            note = self._stop_reason()
        return Recording(
            number, self._manoeuvre, self._place, self._plant.controls, np.array(self._commands),
            np.array(self._poses).reshape(-1, 4),
            np.array(self._truth), world.time, note,
        )  # fmt: skip

    def _observe(self) -> None:
        world = self._world
        if not self._plant.frame_due:
            return
        x, y, theta = map(float, world.pose)
        self._truth.append((world.time, x, y, theta, world.speed))
        observation = self._plant.expose()
        if observation is not None:
            self._poses.append((observation.time, observation.x, observation.y, observation.theta))

    def _send(self) -> None:
        world = self._world
        if not self._plant.command_due:
            return
        control = self._manoeuvre.control_at(world.time)
        self._commands.append((world.time, *control.tolist()))
        self._plant.send(control)

    def _stop_reason(self) -> str:
        """Why the run has to end now; empty if it goes on."""
        world = self._world
        if world.collision is not None:
            return f"touched {world.collision.obstacle} after {world.time:.2f} s"
        clearance = self._free_space.clearance(*map(float, world.pose))
        if clearance < STOP:
            return f"stopped after {world.time:.2f} s, {clearance:.2f} m from the nearest obstacle or bound"
        return ""
