"""Commands of a robot: units and signs between the controls of a model and the messages that the robot takes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np

from kraft.driving.car_model import CarModel, model_of
from kraft.errors import Code, InputError
from kraft.robot.messages import ACKERMANN, JOINTS, header, joints, make
from kraft.robot.robot_file import Robot
from kraft.vehicles import CAR_CONTROLS, WHEELBASE, control_unit, is_car
from kraft.vehicles.identification_record import CommandScale
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle

DOUBTFUL: Final = 2.0
"""Factor between the steering that is sent and the angle of the model's wheels from which on the unit is in doubt."""
RIGHT_ANGLE: Final = 0.5 * math.pi
"""Angle beyond which no wheels turn, rad: a larger number has another unit."""


def limited(vehicle: Vehicle, robot: Robot) -> Vehicle:
    """Vehicle whose controls and top speed keep the limits of a robot, so that plans keep them too.

    The throttle backwards, which brakes, is not limited.

    Raises:
        InputError: if the vehicle does not reach the limited speed, has other controls than the robot takes, or is no
            car.
    """
    check_controls(vehicle, robot)
    limits = robot.limits
    if limits.speed is None and limits.steering_deg is None:
        return vehicle
    if not is_car(vehicle):
        problem, expected = f"are given, and {vehicle.name} is no car", "expected a vehicle file with smaller bounds"
        raise InputError([robot.source.diagnostic("limits", problem, expected, code=Code.CONFLICT)])
    bounds = dict(vehicle.controls)
    top = vehicle.top_speed
    if limits.speed is not None:
        low, high = bounds["throttle"]
        model = model_of(vehicle)
        assert isinstance(model, CarModel), "it is a car"
        most = min(high, model.throttle_for(limits.speed))
        if model.steady_speed(most) <= 0.0:
            problem = f"is {limits.speed:g} m/s, at which {vehicle.name} does not move"
            expected = f"expected up to {model.steady_speed(high):.3g} m/s"
            raise InputError([robot.source.diagnostic("limits.speed", problem, expected, code=Code.MISMATCH)])
        bounds["throttle"], top = (low, most), min(top, limits.speed)
    if limits.steering_deg is not None:
        (low, high), (least, most) = bounds["steering"], _steering_up_to(vehicle, math.radians(limits.steering_deg))
        bounds["steering"] = max(low, least), min(high, most)
    return replace(vehicle, controls=bounds, top_speed=top)


def _steering_up_to(vehicle: Vehicle, angle: float) -> tuple[float, float]:
    """Steering at which the wheels turn by an angle (rad) to the right and to the left."""
    if control_unit(vehicle, "steering") == "rad" or WHEELBASE not in vehicle.parameters:
        return -angle, angle
    model, bend = CarModel(vehicle), math.tan(angle) / vehicle.parameters[WHEELBASE]
    return model.steering_for(-bend), model.steering_for(bend)


def unit_problem(vehicle: Vehicle, robot: Robot) -> str | None:
    """What is wrong if steering is sent that is no angle; None if it may be one.

    It is one in radians, or in degrees if the factor of the robot file makes them of the model's numbers.
    """
    if robot.command.type == JOINTS or not is_car(vehicle) or (sent := _largest_angle(vehicle, robot)) <= RIGHT_ANGLE:
        return None
    steering, most = robot.command.steering, _largest_steering(vehicle)
    if most > RIGHT_ANGLE:
        problem = f"steering of up to {sent:.4g} would be sent as radians: {vehicle.name} has it in another unit"
        return f"{problem}; state command.steering.scale in the robot file, {math.radians(1.0):.4f} if it is degrees"
    if not _sends_degrees(vehicle, robot):
        problem = f"steering of up to {sent:.4g} would be sent: {vehicle.name} has up to {most:.3g}, and "
        problem += f"command.steering.scale is {steering.scale:g}; expected a factor that makes radians of it"
        return f"{problem}, or {math.degrees(_largest_turn(vehicle)) / most:.4g} if the robot takes degrees"
    if steering.offset_deg:
        problem = f"command.steering.offset_deg would be added as {math.radians(steering.offset_deg):.3g} rad"
        return f"{problem} to steering in degrees, which command.steering.scale makes; expected it to be left out"
    return None


def unit_warnings(vehicle: Vehicle, robot: Robot, converted: Mapping[str, CommandScale]) -> Iterator[str]:
    """What is doubtful of the numbers that are sent.

    `converted` are the commands whose numbers in the logs were not those that the identified model takes.
    """
    is_angle = robot.command.type != JOINTS and is_car(vehicle)
    if is_angle and _sends_degrees(vehicle, robot):
        sent, scale = _largest_angle(vehicle, robot), robot.command.steering.scale
        doubt = f"steering is sent in degrees, up to {sent:.3g}, as command.steering.scale is {scale:g}"
        yield f"{doubt}: {robot.command.type} has radians; does the robot take degrees?"
    elif is_angle and WHEELBASE in vehicle.parameters:
        sent, wheels = _largest_angle(vehicle, robot), _largest_turn(vehicle)
        if not wheels / DOUBTFUL <= sent <= wheels * DOUBTFUL:
            doubt = (
                f"steering of up to {sent:.2g} rad is sent, at which the wheels of {vehicle.name} turn by {wheels:.2g}"
            )
            yield f"{doubt} rad: is command.steering.scale right?"
    factors = {"throttle": robot.command.speed.scale, "steering": robot.command.steering.scale} if is_angle else {}
    for name, record in converted.items():
        is_speed = name == "throttle" and is_angle and robot.command.speed.unit == "m/s"
        is_inverse = record.neutral == 0.0 and math.isclose(factors.get(name, 1.0) * record.scale, 1.0, rel_tol=0.05)
        if not is_speed and not is_inverse:
            yield (
                f"{name} is not sent in the numbers of the logs, of which {record.neutral:g} is neutral: the model has "
                f"(number - {record.neutral:g}) {record.scale:g}; does the robot take what is sent?"
            )


def _largest_angle(vehicle: Vehicle, robot: Robot) -> float:
    """Largest steering angle that a robot is sent, rad."""
    steering = robot.command.steering
    offset = math.radians(steering.offset_deg)
    return max(abs(steering.scale * edge + offset) for edge in vehicle.controls["steering"])


def _largest_steering(vehicle: Vehicle) -> float:
    """Largest number that a model has as steering, in its own unit."""
    return max(abs(edge) for edge in vehicle.controls["steering"])


def _largest_turn(vehicle: Vehicle) -> float:
    """Largest angle of the wheels of a model, rad; its steering where the wheelbase is not known."""
    if WHEELBASE not in vehicle.parameters:
        return _largest_steering(vehicle)
    turns = CarModel(vehicle)
    bend = max(abs(turns.curvature(edge)) for edge in vehicle.controls["steering"])
    return math.atan(bend * vehicle.parameters[WHEELBASE])


def _sends_degrees(vehicle: Vehicle, robot: Robot) -> bool:
    """Whether the factor of the robot file makes degrees of a model's steering, which has another unit."""
    if _largest_steering(vehicle) > RIGHT_ANGLE or (sent := _largest_angle(vehicle, robot)) <= RIGHT_ANGLE:
        return False
    wheels = math.degrees(_largest_turn(vehicle))
    return wheels / DOUBTFUL <= sent <= wheels * DOUBTFUL


def check_controls(vehicle: Vehicle, robot: Robot) -> None:
    """Check that the messages of a robot have all controls of a vehicle.

    Raises:
        InputError: if not.
    """
    if robot.command.type != JOINTS and not is_car(vehicle):
        has = ", ".join(vehicle.controls)
        problem = f"takes {' and '.join(CAR_CONTROLS)}, but {vehicle.name} has {has}"
        expected = "expected a model with these controls, or the type sensor_msgs/msg/JointState"
        raise InputError([robot.source.diagnostic("command.type", problem, expected, code=Code.MISMATCH)])


class CommandCodec:
    """Controls of a vehicle as messages of a robot, and back; the model is that before any adaptation."""

    def __init__(self, robot: Robot, vehicle: Vehicle) -> None:
        self._command, self._vehicle = robot.command, vehicle
        self.names = tuple(vehicle.controls)
        self._car = CarModel(vehicle) if is_car(vehicle) else None

    def message(self, time: int, control: Floats) -> Any:
        """Message at `time` (ns since 1970) for a control (nu,)."""
        if self._car is None or self._command.type == JOINTS:
            return joints(time, self.names, control)
        throttle, steering = (float(control[self.names.index(name)]) for name in CAR_CONTROLS)
        speed = self._car.steady_speed(throttle) if self._command.speed.unit == "m/s" else throttle
        angle = self._command.steering.scale * steering + math.radians(self._command.steering.offset_deg)
        drive = {"speed": self._command.speed.scale * speed, "steering_angle": angle}
        if self._command.type == ACKERMANN:
            return make(ACKERMANN, header=header(time, self._command.frame), drive=drive)
        return make(self._command.type, **drive)

    def control(self, message: Any) -> Floats | None:
        """Control (nu,) of a message, as the simulated robot understands it; None if it holds no such numbers."""
        if self._command.type == JOINTS:
            held = dict(zip(message.name, np.asarray(message.position).tolist(), strict=False))
            if not set(self.names) <= set(held):
                return None
            found = np.array([held[name] for name in self.names])
        else:
            assert self._car is not None, "it was checked"
            drive = message.drive if self._command.type == ACKERMANN else message
            speed, steered = float(drive.speed) / self._command.speed.scale, float(drive.steering_angle)
            if not math.isfinite(speed):  # the table of the speeds has a throttle for that, too
                return None
            throttle = self._car.throttle_for(speed) if self._command.speed.unit == "m/s" else speed
            angle = steered - math.radians(self._command.steering.offset_deg)
            found = np.zeros(len(self.names))
            found[self.names.index("throttle")] = throttle
            found[self.names.index("steering")] = angle / self._command.steering.scale
        return found if np.isfinite(found).all() else None
