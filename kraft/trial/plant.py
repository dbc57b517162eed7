"""Plant of a controller: the simulated world with its camera and delayed commands, and the radio to the controller."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from kraft.driving.estimation import CameraModel
from kraft.driving.estimation.camera_model import SINGLE_TAG
from kraft.driving.messages import Observation
from kraft.scenario import Scenario
from kraft.scenario.schema import MARKER_HEIGHT
from kraft.simulation.camera import Camera, MarkerCamera
from kraft.simulation.true_world import TrueWorld
from kraft.simulation.world import Ticks, steps_of
from ompl_ext.arrays import Floats


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
    from kraft.simulation.rendered_camera import RenderedCamera, check_sees

    check_sees(scenario, world.frame)
    return RenderedCamera(scenario, seed)
