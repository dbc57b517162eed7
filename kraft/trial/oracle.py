"""Oracle: the only estimator that is told the truth, to find out what is possible in a scenario, and its model.

It takes the simulated world itself.  `kraft.driving` cannot import the simulation, so no other estimator can be given
one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from kraft.driving.estimation.dead_reckoning import DeadReckoning
from kraft.driving.messages import Estimate, Observation
from kraft.driving.vehicle_model import VehicleModel
from kraft.errors import Code, InputError
from kraft.scenario.truth import VehicleGap
from kraft.simulation.car import MUSHR
from kraft.simulation.model_world import ModelWorld
from kraft.simulation.true_world import TrueWorld
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle

PARAMETERS: Final = ("L", "phi_diff", "v_delta", "tau", "u_0")
"""Parameters of a model that can follow every difference of the true car."""


class OracleEstimator:
    """True state, predicted to the time at which a command acts, with the commands that are on their way."""

    belief: Final = None

    def __init__(
        self, world: TrueWorld, command_delay: float, vehicle: Vehicle, model: VehicleModel, start_state: Floats
    ) -> None:
        """Estimate the state of `world`, whose commands act `command_delay` s after they are sent.

        `model` is that of the true car at the start of the drive, `vehicle` that of the car which the model was
        identified on: if the car changes, the parameters of `model` follow.
        """
        self._world, self._model, self.horizon = world, model, command_delay
        self._vehicle, self._gap = vehicle, world.gap
        self._reckoning = DeadReckoning(model.after_commands, model.rest, start_state)

    def observe(self, observation: Observation) -> None:
        """Ignore the observation."""

    def commanded(self, time: float, control: Floats) -> None:
        """Record that `control` (nu,) is sent at `time` (s, ascending); it acts after the delay."""
        self._reckoning.command(time + self.horizon, control)

    def estimate(self, time: float) -> Estimate:
        """State at `time` (s) plus the delay."""
        state, model = self._reckoning.at(time), self._model
        for name, value in self._world.components.items():
            if (k := model.vehicle.index(name)) >= 0:
                state[k] = value
        state[model.pose] = self._world.pose
        state[model.v] = self._world.speed
        self._reckoning.reset(time, state)
        return Estimate(time + self.horizon, self._reckoning.at(time + self.horizon), 0.0)

    def leave_out(self, begin: float, end: float) -> None:
        """Do nothing: nothing is identified."""

    def replanning_estimate(self, time: float) -> Estimate:
        """State at `time` (s) plus the delay, with the parameters of the car if they have changed."""
        parameters = None
        if self._world.gap != self._gap:
            self._gap = self._world.gap
            parameters = true_vehicle(self._vehicle, self._gap).parameter_array
            self._model.set_parameters(parameters)
        return replace(self.estimate(time), parameters=parameters)

    def uncertainty(self, time: float) -> None:
        """No bound rests on this estimator: it states no uncertainty."""


def true_model(vehicle: Vehicle, world: TrueWorld, gap: VehicleGap) -> Vehicle:
    """Model with the parameters of the true robot, as far as they are known.

    Raises:
        InputError: as `true_vehicle`.
    """
    if isinstance(world, ModelWorld) and world.truth.hash == vehicle.hash:
        return vehicle.with_parameters(world.truth.parameters)
    return true_vehicle(vehicle, gap)


def true_vehicle(vehicle: Vehicle, gap: VehicleGap) -> Vehicle:
    """Model of the true car: a model with drive train, its parameters changed as the car is (`truth.vehicle`).

    The force of the drive is proportional to the throttle minus that which friction uses up, the steady speed to the
    force; so a force larger by a factor k gives v_delta (k - u_0) / (1 - u_0) and u_0 / k.  A steering angle larger by
    k gives L / k, and an offset is one of the commanded angle.  The time constant grows with the mass.

    Raises:
        InputError: if the car differs from its model, and the model has other parameters or could not move.
    """
    if gap == VehicleGap():
        return vehicle
    if missing := [name for name in PARAMETERS if name not in vehicle.parameters]:
        problem = f"has no {', '.join(missing)}, so it cannot be told how the true car differs"
        raise InputError.of(vehicle.name, problem, "expected the model mushr-drive", Code.MISMATCH)
    values = dict(vehicle.parameters)
    drive, friction = gap.drive_scale, values["u_0"]
    if drive <= friction:
        problem = (
            f"would not move with a drive_scale of {drive:g}: its friction takes a share of {friction:g} of the drive"
        )
        raise InputError.of(vehicle.name, problem, "expected a drive_scale above that", Code.MISMATCH)
    values["v_delta"] *= (drive - friction) / (1.0 - friction)
    values["u_0"] = friction / drive
    values["L"] /= gap.steering_scale
    values["phi_diff"] += gap.steering_offset / gap.steering_scale
    values["tau"] *= 1.0 + MUSHR.chassis_mass * (gap.mass_scale - 1.0) / MUSHR.effective_mass
    return replace(vehicle, parameters=values, top_speed=values["v_delta"])
