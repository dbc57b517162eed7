"""Record runs: drive manoeuvres in free space of the simulated world and log commands, measured poses and true poses.

The folder of a run has these files:

LOGS/run_01/commands.csv    t, throttle, steering, or other controls: t is the time at which the command was sent
LOGS/run_01/poses.csv       t, x, y, yaw: t is the time at which the frame was taken, by the camera's clock
LOGS/run_01/truth.csv       t, x, y, yaw, speed: for comparison; identification never opens it
LOGS/run_01/manifest.json   manoeuvre, start, vehicle, scenario, seed, versions
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from kraft.driving.car_model import model_of
from kraft.driving.vehicle_model import VehicleModel
from kraft.errors import Code, InputError
from kraft.files import new_folder, write_csv, write_json
from kraft.planning.search import check_seed
from kraft.planning.workspace import workspace_of
from kraft.provenance import SIMULATION, plain, plain_hash, versions
from kraft.recording.area import MARGIN_PER_METRE, PATH_STEP
from kraft.recording.manoeuvres import COMMAND_RATE, NAMES, Manoeuvre, manoeuvre
from kraft.scenario import Box, Scenario, Start
from kraft.simulation.true_world import true_robot, world_of
from kraft.trial.plant import Plant
from kraft.trial.robot_content import model_content, robot_content
from kraft.vehicles.load import RecordedVehicle
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.exact import ExactClearance
from ompl_ext.vehicle import Vehicle

CANDIDATES: Final = 300
"""Number of starts that are tried: the first that is free for the whole manoeuvre, else the one free for longest."""
MARGIN: Final = 0.25
"""Required clearance at the start, m."""


@dataclass(frozen=True)
class RunStart:
    """Start of a run, and the time for which the manoeuvre is predicted to have the required clearance, s."""

    start: Start
    time: float


class FreeSpace:
    """Floor of a scenario without its obstacles, its movable boxes and what is outside its bounds."""

    def __init__(self, scenario: Scenario, vehicle: Vehicle) -> None:
        boxes = tuple(Box(box.center, box.size[:2], box.yaw) for box in scenario.truth.movable_boxes)
        task = replace(scenario.task(), obstacles=scenario.obstacles + boxes)
        self._bounds = scenario.bounds
        self._exact = ExactClearance(workspace_of(task, vehicle), vehicle.footprint)

    def clearance(self, x: float, y: float, theta: float) -> float:
        """Distance of the footprint to the nearest obstacle or bound, m."""
        return self._exact.distance(x, y, theta)

    def place(self, path: Matrix, generator: np.random.Generator) -> RunStart:
        """Choose the start of a predicted path of poses (m, 3) from the origin, `PATH_STEP` apart."""
        travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))])
        required = MARGIN + MARGIN_PER_METRE * travelled
        (x0, x1), (y0, y1) = self._bounds.x, self._bounds.y
        best = RunStart(Start(0.0, 0.0, 0.0), -1.0)
        for _ in range(CANDIDATES):
            x, y, heading = map(float, generator.uniform((x0, y0, -math.pi), (x1, y1, math.pi)))
            start = Start(x, y, heading)
            time = self._free_time(moved(path, start), required, best.time)
            if time > best.time:
                best = RunStart(start, time)
            if time >= PATH_STEP * (len(path) - 1):
                break
        return best

    def _free_time(self, poses: Matrix, required: Floats, known: float) -> float:
        """Time for which poses keep the required clearance, s; `known` if the bounds make it no longer than that."""
        (x0, x1), (y0, y1) = self._bounds.x, self._bounds.y
        x, y = poses[:, 0], poses[:, 1]
        outside = np.minimum(np.minimum(x - x0, x1 - x), np.minimum(y - y0, y1 - y)) < required
        inside = int(np.argmax(outside)) if outside.any() else len(poses)
        if PATH_STEP * (inside - 1) <= known:
            return known
        for k in range(inside):
            if self._exact.distance(*map(float, poses[k])) < required[k]:
                return PATH_STEP * (k - 1)
        return PATH_STEP * (inside - 1)


def predicted(model: VehicleModel, manoeuvre: Manoeuvre) -> Matrix:
    """Poses (m, 3) from the origin, `PATH_STEP` apart, predicted by the model."""
    state = np.zeros(len(model.vehicle.state))
    poses = [(0.0, 0.0, 0.0)]
    for k in range(round(manoeuvre.end / PATH_STEP)):
        state = model.advance(state, manoeuvre.control_at((k + 0.5) * PATH_STEP), PATH_STEP)
        poses.append((float(state[model.x]), float(state[model.y]), float(state[model.theta])))
    return np.array(poses)


def moved(path: Matrix, start: Start) -> Matrix:
    """Path from the origin moved to a start, (m, 3)."""
    c, s = math.cos(start.heading), math.sin(start.heading)
    x, y, theta = path.T
    return np.column_stack([start.x + c * x - s * y, start.y + s * x + c * y, start.heading + theta])


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
        vehicle: what is known of the vehicle that drove.
        models: what the run depends on of its planning vehicle and its true robot.
        controls: names of its controls.
        commands: time of sending (s) and control, (m, 1 + nu).
        poses: time of the frame (s) and measured x, y (m) and yaw (rad), (n, 4).
        truth: time (s) and true x, y (m), yaw (rad) and speed (m/s) at every frame of the camera, (k, 5).
        end: time of its end, s.
        note: why it ended early; empty if it did not.
    """

    number: int
    manoeuvre: Manoeuvre
    place: RunStart
    vehicle: RecordedVehicle
    models: Mapping[str, Any]
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
            InputError: if the true robot cannot be simulated there or takes other controls, or the seed is negative.
        """
        check_seed(seed)
        self._scenario, self._seed = scenario, seed
        self._model = model_of(vehicle)
        self._free_space = FreeSpace(scenario, vehicle)
        self._world = world_of(scenario, vehicle, seed, visuals=False, check_start=False)
        robot = true_robot(scenario, vehicle).robot
        self._vehicle = RecordedVehicle.of(vehicle, robot)
        self._models = {"planned": model_content(vehicle), "true": robot_content(robot)}

    def described(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Keys of the manifests that are the same for all runs; `arguments` are those of the user."""
        return _common(self._scenario, arguments, self._vehicle, self._models, tuple(self._model.vehicle.controls))

    def place(self, number: int, path: Matrix) -> RunStart:
        """Start of run `number` if it is to drive a path of poses (m, 3) from the origin, `PATH_STEP` apart."""
        return self._free_space.place(path, self._generator(number))

    def _generator(self, number: int) -> np.random.Generator:
        return np.random.Generator(np.random.PCG64(np.random.SeedSequence([self._seed, number, 0x10C5])))

    def record(self, number: int, commanded: Manoeuvre | None = None, place: RunStart | None = None) -> Recording:
        """Drive run `number`, from 1.

        Args:
            number: of the run.
            commanded: what to drive; a random manoeuvre if None.
            place: where to begin; if None, where the vehicle's model predicts free space.

        Raises:
            InputError: if the scenario has no free space for the manoeuvre.
        """
        generator = self._generator(number)
        if commanded is None:
            commanded = manoeuvre(NAMES[(number - 1) % len(NAMES)], self._model.drive_control, generator)
        if place is None:
            place = self._free_space.place(predicted(self._model, commanded), generator)
        if place.time < SHORTEST:
            shape = self._model.vehicle.footprint
            problem = (
                f"has no free space for a run of {SHORTEST:g} s of {self._model.vehicle.name}, {shape.length:g} x "
                f"{shape.width:g} m (manoeuvre {commanded.name!r})"
            )
            expected = "expected more free floor, as in the scenario training"
            if self._scenario.name == "training":
                expected = (
                    f"expected a scenario of your own with larger bounds and walls: copy {self._scenario.source.file}"
                )
            raise InputError.of(self._scenario.name, problem, expected, Code.GEOMETRY)
        self._world.reset(place.start, number)
        seed = int(generator.integers(2**62))
        plant = Plant(self._world, self._scenario, self._model.vehicle.controls, seed, COMMAND_RATE)
        return _Run(plant, self._free_space, commanded, place, self._vehicle, self._models).drive(number)


class _Run:
    """Run in progress."""

    def __init__(
        self,
        plant: Plant,
        free_space: FreeSpace,
        commanded: Manoeuvre,
        place: RunStart,
        vehicle: RecordedVehicle,
        models: Mapping[str, Any],
    ) -> None:
        self._plant, self._world, self._free_space = plant, plant.world, free_space
        self._manoeuvre, self._place, self._vehicle, self._models = commanded, place, vehicle, models
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
            number, self._manoeuvre, self._place, self._vehicle, self._models, self._plant.controls,
            np.array(self._commands), np.array(self._poses).reshape(-1, 4), np.array(self._truth), world.time, note,
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
        if world.frame.has_turned_over(world.marker[1]):
            return f"turned over after {world.time:.2f} s"
        clearance = self._free_space.clearance(*map(float, world.pose))
        if clearance < STOP:
            return f"stopped after {world.time:.2f} s, {clearance:.2f} m from the nearest obstacle or bound"
        return ""


SCHEMA: Final = "kraft.record/1"
POSES: Final = ("t", "x", "y", "yaw")
TRUTH: Final = ("t", "x", "y", "yaw", "speed")
UNITS: Final = {
    "t": "s", "throttle": "1", "steering": "rad", "x": "m", "y": "m", "yaw": "rad", "speed": "m/s",
}  # fmt: skip
"""Units of the columns; controls of other vehicles than cars have those of their model."""

KEYS: Final = (
    "schema", "arguments", "run", "manoeuvre", "start", "end", "note", "vehicle", "models", "commands", "poses",
    "units", "clock", "scenario", "versions",
)  # fmt: skip
"""Keys of a manifest, in their order."""
NEW_KEYS: Final = frozenset({"models"})
"""Those that older manifests lack."""
FILES: Final = ("commands.csv", "poses.csv", "truth.csv", "manifest.json")
"""Files of a run."""


def write_recording(folder: Path, scenario: Scenario, arguments: Mapping[str, Any], recording: Recording) -> Path:
    """Write a run into its own new folder in `folder`, in one step, and return that folder.

    Raises:
        InputError: if the run cannot be written.
    """
    final = folder / f"run_{recording.number:02d}"
    with new_folder(final) as temporary:
        write_csv(temporary / "commands.csv", ("t", *recording.controls), recording.commands.tolist())
        write_csv(temporary / "poses.csv", POSES, recording.poses.tolist())
        write_csv(temporary / "truth.csv", TRUTH, recording.truth.tolist())
        write_json(temporary / "manifest.json", _manifest(scenario, arguments, recording))
    return final


def _manifest(scenario: Scenario, arguments: Mapping[str, Any], recording: Recording) -> dict[str, Any]:
    """Content of the manifest: everything that repeating the run needs, and no time of day."""
    start = recording.place.start
    common = _common(scenario, arguments, recording.vehicle, recording.models, recording.controls)
    mine = {
        "run": recording.number,
        "manoeuvre": recording.manoeuvre.name,
        "start": {"x": start.x, "y": start.y, "heading": start.heading},
        "end": recording.end,
        "note": recording.note,
        "commands": len(recording.commands),
        "poses": len(recording.poses),
    }
    return {key: {**common, **mine}[key] for key in KEYS}


def _common(
    scenario: Scenario,
    arguments: Mapping[str, Any],
    vehicle: RecordedVehicle,
    models: Mapping[str, Any],
    controls: Sequence[str],
) -> dict[str, Any]:
    """Keys of the manifest that are the same for all runs of a recording."""
    described = {f.name: plain(getattr(scenario, f.name)) for f in fields(scenario) if f.compare}
    return {
        "schema": SCHEMA,
        "arguments": dict(arguments),
        "vehicle": vehicle.model_dump(mode="json", exclude_none=True),
        "models": dict(models),
        "units": {name: unit for name, unit in UNITS.items() if name in (*POSES, *TRUTH, *controls)},
        "clock": "both files count from the beginning of the run; a pose carries the time its frame was taken",
        "scenario": {"sha256": plain_hash(described), "content": described},
        "versions": versions(SIMULATION),
    }
