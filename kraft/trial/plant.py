"""Plant of a controller: the simulated world with its camera and delayed commands; and the oracle that knows the world.

The oracle is the only estimator that is told the truth, to find out what is possible in a scenario.  It takes the
simulated `World` itself.  `kraft.driving` cannot import the simulation, so no other estimator can be given one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import replace
from typing import Final

import numpy as np

from kraft.driving.estimation import CameraModel
from kraft.driving.estimation.camera_model import SINGLE_TAG
from kraft.driving.estimation.dead_reckoning import DeadReckoning
from kraft.driving.messages import Estimate, Observation
from kraft.driving.vehicle_model import VehicleModel
from kraft.errors import Code, InputError
from kraft.scenario import Scenario
from kraft.scenario.truth import VehicleGap
from kraft.simulation.camera import Camera, MarkerCamera
from kraft.simulation.car import MARKER_HEIGHT, MUSHR
from kraft.simulation.floor_frame import yaw_rotation
from kraft.simulation.true_world import ModelWorld, TrueWorld
from kraft.simulation.world import Ticks, steps_of
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle


class Radio:
    """Radio from the replanner to the car's controller, which loses a share of the messages.

    The first message always arrives: the first plan is on board before the drive begins.
    """

    def __init__(self, loss: float, seed: int) -> None:
        """`loss` is the share of lost messages; which ones are lost depends on the trial's seed alone."""
        self._loss, self._sent, self.lost = loss, 0, 0
        self._generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, 0x2AD10])))

    def delivers(self) -> bool:
        """Whether the next message arrives; `lost` counts those that do not."""
        self._sent += 1
        lost = self._generator.random() < self._loss and self._sent > 1
        self.lost += lost
        return not lost


def camera_model(scenario: Scenario) -> CameraModel:
    """Camera as its user knows it: `rendered` measures the height of the tag, `planar` errs everywhere the same."""
    sensing, start = scenario.sensing, scenario.start
    level_at = None if sensing.preset == "rendered" else (start.x, start.y)
    errors = None if sensing.preset == "planar" else SINGLE_TAG
    return CameraModel(sensing.camera, MARKER_HEIGHT, level_at, errors)


class Plant:
    """World with the clocks of its camera and of its controller.

    A drive repeats: `expose` if `frame_due`, `send` if `command_due`, then `advance`.
    """

    def __init__(
        self, world: TrueWorld, scenario: Scenario, controls: Iterable[str], seed: int, command_rate: float
    ) -> None:
        """Connect camera and command delay to a world.

        Args:
            world: the world, at time 0.
            scenario: the world's; its `sensing` has rate and errors of the camera and the delay of the commands.
            controls: names of the vehicle's controls in their order, the same as those of the world.
            seed: of the camera's errors.
            command_rate: commands per second.

        Raises:
            InputError: if the camera is too low, or if frames are rendered and do not show the marker at the start.
            MissingDependency: if frames are rendered and OpenCV or OpenGL is missing.
        """
        sensing = scenario.sensing
        self.world = world
        self._camera = camera_of(world, scenario, seed)
        self._frames, self._ticks = Ticks(sensing.rate_hz, world.dt), Ticks(command_rate, world.dt)
        self._delay = steps_of(sensing.command_delay, world.dt)
        self.controls = tuple(controls)
        self._order = [self.controls.index(name) for name in world.controls]
        self._commands: deque[tuple[int, Floats]] = deque()

    @property
    def frame_due(self) -> bool:
        """Whether the camera takes a frame now."""
        return self.world.steps >= self._frames.due

    @property
    def command_due(self) -> bool:
        """Whether the controller sends a command now."""
        return self.world.steps >= self._ticks.due

    def expose(self) -> Observation | None:
        """Take the due frame; None if the marker is not detected."""
        self._frames.number += 1
        return self._camera.expose(self.world.time, *self.world.marker)

    def send(self, control: Floats) -> None:
        """Send the due control (nu,) of the vehicle; it takes effect after the scenario's command delay."""
        self._ticks.number += 1
        self._commands.append((self.world.steps + self._delay, control[self._order]))

    def advance(self, until: int) -> None:
        """Apply the commands whose delay is over and step to the next event, at most to physics step `until`."""
        world, commands = self.world, self._commands
        while commands and commands[0][0] <= world.steps:
            world.apply(commands.popleft()[1])
        arrival = commands[0][0] if commands else until
        due = min(until, arrival, self._ticks.due, self._frames.due)
        world.step(max(due - world.steps, 1))


def camera_of(world: TrueWorld, scenario: Scenario, seed: int) -> Camera:
    """Camera of the scenario's preset."""
    if scenario.sensing.preset != "rendered":
        return MarkerCamera(scenario.sensing, MARKER_HEIGHT, seed)
    from kraft.simulation.rendered_camera import RenderedCamera

    rendered = RenderedCamera(scenario, seed)
    place = np.array([scenario.start.x, scenario.start.y, MARKER_HEIGHT])
    rendered.check_sees(world.frame.to_world(place), world.frame.rotation @ yaw_rotation(scenario.start.heading))
    return rendered


PARAMETERS: Final = ("L", "phi_diff", "v_delta", "tau", "u_0")


class OracleEstimator:
    """True state, predicted to the time at which a command acts, with the commands that are on their way."""

    belief: Final = None

    def __init__(
        self, world: TrueWorld, command_delay: float, vehicle: Vehicle, model: VehicleModel, start_state: Floats
    ) -> None:
        """Estimate the state of `world`, whose commands act `command_delay` s after they are sent.

        `model` is that of the true car at the begin of the drive, `vehicle` that of the car which the model was
        identified on: if the car changes, the parameters of `model` follow.
        """
        self._world, self._model, self.horizon = world, model, command_delay
        self._vehicle, self._gap = vehicle, world.gap
        self._reckoning = DeadReckoning(model.advance, model.rest, start_state)

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
