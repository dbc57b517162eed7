"""Schema of a robot file: the transport, the topics in and out, units and signs, limits and the watchdog."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import Field, PrivateAttr, StringConstraints, model_validator
from pydantic_core import PydanticCustomError

from kraft.config import bundled
from kraft.config.schema import Angle, Name, Positive, StrictModel, is_number, read_model, refuse
from kraft.config.source import Source
from kraft.driving.control_settings import Rate
from kraft.errors import Code

Topic = Annotated[str, StringConstraints(pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)+$")]
Frame = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_/]*$")]
Seconds = Annotated[float, Field(gt=0, le=60)]
PoseRate = Annotated[float, Field(ge=1, le=500)]
Offset = Annotated[float, Field(ge=-10, le=10)]
POSE_RATE: Final = 30.0
"""Poses per second, Hz, ..."""
POSE_AGE, COMMAND_TIMEOUT = 0.4, 0.2
"""... age of a pose (s) from which the vehicle stops, and time after the last command, where a file states none."""
Factor = Annotated[float, Field(ge=-1000, le=1000)]


class Ros2(StrictModel):
    """DDS, as ROS 2 nodes on the same network speak it; needs the extra `[ros2]`."""

    kind: Literal["ros2"]
    """which transport"""
    domain: Annotated[int, Field(ge=0, le=232)] | None = None
    """DDS domain; that of the environment variable ROS_DOMAIN_ID if left out, else 0"""
    interface: Annotated[str, StringConstraints(min_length=1)] | None = None
    """network interface, such as lo or wlan0; chosen by DDS if left out"""


class Rosbridge(StrictModel):
    """JSON over a websocket, to a rosbridge server on the robot; ROS 1 or ROS 2; needs the extra `[rosbridge]`."""

    kind: Literal["rosbridge"]
    """which transport"""
    url: Annotated[str, StringConstraints(pattern=r"^wss?://[^/ ]+(/.*)?$")] = "ws://localhost:9090"
    """address of the server, ws://HOST:PORT"""
    ros: Literal[1, 2] = 2
    """version of ROS behind the server"""


class Loopback(StrictModel):
    """Messages stay on this machine: in one process, or between processes through a socket; needs no extra."""

    kind: Literal["loopback"]
    """which transport"""
    socket: Annotated[str, StringConstraints(min_length=1, max_length=100)] | None = None
    """file of the socket that the robot's end makes; without one messages stay in the process"""


TransportSettings = Annotated[Ros2 | Rosbridge | Loopback, Field(discriminator="kind")]


class TrackedPoint(StrictModel):
    """Where on the vehicle the tracked point is, in the frame midway between the axles, x forward, y left."""

    x: Offset = 0.0
    """m; negative for the rear axle"""
    y: Offset = 0.0
    """m"""
    heading_deg: Angle = 0.0
    """direction in which the tracked frame points, degrees from the vehicle's"""

    def body_pose(self, x: float, y: float, theta: float) -> tuple[float, float, float]:
        """Pose of the vehicle's body (m, rad) where the tracked frame has a pose."""
        heading = theta - math.radians(self.heading_deg)
        c, s = math.cos(heading), math.sin(heading)
        return x - c * self.x + s * self.y, y - s * self.x - c * self.y, math.remainder(heading, math.tau)

    def tracked_pose(self, x: float, y: float, theta: float) -> tuple[float, float, float]:
        """Inverse of `body_pose`."""
        c, s = math.cos(theta), math.sin(theta)
        heading = math.remainder(theta + math.radians(self.heading_deg), math.tau)
        return x + c * self.x - s * self.y, y + s * self.x + c * self.y, heading


class PoseInput(StrictModel):
    """Where the vehicle's pose comes from."""

    topic: Topic
    """topic of the poses, /pf/pose/odom"""
    type: Literal[
        "nav_msgs/msg/Odometry",
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "geometry_msgs/msg/TransformStamped",
    ]
    """type of the messages"""
    frame: Frame = "map"
    """frame of the poses: that of the scenario"""
    stamp: Literal["header", "arrival"] = "header"
    """clock of the poses: the header's stamp, or the time of arrival"""
    rate_hz: PoseRate = POSE_RATE
    """poses per second that are expected"""
    reliable: bool = False
    """ask DDS to send lost poses again"""
    tracked_point: TrackedPoint = TrackedPoint()
    """{x, y, heading_deg} of the tracked point on the vehicle"""
    level_camera: bool = False
    """the poses come from the scenario's camera: it takes the floor as level, and errs by the place of the marker"""


class SpeedCommand(StrictModel):
    """How a throttle of the model becomes the speed of a command."""

    unit: Literal["throttle", "m/s"] = "throttle"
    """`throttle`: the number is the model's throttle; `m/s`: it is the model's steady speed at that throttle"""
    scale: Factor = 1.0
    """factor on the number; negative if the robot counts backwards as positive"""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.scale == 0.0:
            raise refuse("is 0", "expected another factor", ("scale",))
        return self


class SteeringCommand(StrictModel):
    """How a steering angle of the model becomes that of a command."""

    scale: Factor = 1.0
    """factor on the steering angle; negative if the robot counts to the right as positive"""
    offset_deg: Annotated[float, Field(ge=-45, le=45)] = 0.0
    """added after the factor, degrees"""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.scale == 0.0:
            raise refuse("is 0", "expected another factor", ("scale",))
        return self


JOINT_STATE: Final = "sensor_msgs/msg/JointState"


class CommandOutput(StrictModel):
    """Where the commands go."""

    topic: Topic
    """topic of the commands, /drive"""
    type: Literal[
        "ackermann_msgs/msg/AckermannDriveStamped", "ackermann_msgs/msg/AckermannDrive", "sensor_msgs/msg/JointState"
    ] = "ackermann_msgs/msg/AckermannDriveStamped"
    """type of the messages; JointState has the controls of any vehicle by name"""
    frame: Frame = "base_link"
    """frame of the vehicle"""
    speed: SpeedCommand = SpeedCommand()
    """{unit, scale} of the speed"""
    steering: SteeringCommand = SteeringCommand()
    """{scale, offset_deg} of the steering angle"""
    timeout: Annotated[float, Field(gt=0, le=5)] = COMMAND_TIMEOUT
    """time after the last command when the robot's multiplexer stops it, s"""


class DeadMan(StrictModel):
    """Switch that a person holds while the vehicle may drive."""

    topic: Topic
    """topic of the switch, /joy"""
    type: Literal["std_msgs/msg/Bool", "sensor_msgs/msg/Joy"]
    """type of the messages"""
    button: Annotated[int, Field(ge=0, le=100)] | None = None
    """number of the button of a Joy, counted from 0"""
    timeout: Seconds = 0.5
    """time after the last message when the switch counts as released, s"""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.button is None) != (self.type == "std_msgs/msg/Bool"):
            problem = "is given with a Bool" if self.button is not None else "is missing"
            raise refuse(problem, "expected it for a Joy alone", ("button",), Code.CONFLICT)
        return self


class TopicInput(StrictModel):
    """A topic that may be absent."""

    topic: Topic
    """topic"""


class GoalInput(TopicInput):
    """Topic of goals."""

    heading_tolerance_deg: Annotated[float, Field(gt=0, le=180)] | None = None
    """largest deviation from the heading of such a goal at which it is reached, degrees; of any heading if left out"""

    @property
    def heading_tolerance(self) -> float | None:
        """The tolerance, rad."""
        return None if self.heading_tolerance_deg is None else math.radians(self.heading_tolerance_deg)


class Limits(StrictModel):
    """Limits that plans and commands keep, beside those of the vehicle."""

    speed: Annotated[float, Field(gt=0, le=100)] | None = None
    """largest speed forwards, m/s"""
    steering_deg: Annotated[float, Field(gt=0, le=90)] | None = None
    """largest steering angle to either side, degrees"""


class Watchdog(StrictModel):
    """When a pose is not believed, and when the vehicle stops by itself."""

    pose_age: Annotated[float, Field(ge=0.05, le=5)] = POSE_AGE
    """age of the newest believed pose at which the vehicle stops, s"""
    jump: Positive = 0.75
    """distance from the prediction, and from where the commands led, beyond which a pose is not believed, m"""
    jump_deg: Annotated[float, Field(gt=0, le=180)] = 60.0
    """deviation from these two headings beyond which a pose is not believed, degrees"""
    clock: Annotated[float, Field(gt=0, le=60)] = 0.5
    """change of the difference between the clocks beyond which a pose is not believed, s"""
    start: Positive = 0.5
    """distance from the scenario's start beyond which the drive does not begin, m"""
    start_deg: Annotated[float, Field(gt=0, le=180)] = 30.0
    """deviation from the start's heading beyond which the drive does not begin, degrees"""
    lost: Annotated[float, Field(gt=0, le=1)] = 0.25
    """share of the poses of the last seconds that may be missing before the vehicle stops"""
    late: Annotated[float, Field(gt=0, le=1)] = 0.25
    """share of the last seconds' commands, and of the last four decisions, that may be late before the vehicle stops"""
    give_up: Annotated[float, Field(gt=0, le=3600)] = 10.0
    """time for which the vehicle waits until it may drive again before the drive ends, s"""


class Robot(StrictModel):
    """A robot file."""

    name: Name
    """short name of letters, digits, - and _"""
    description: str = ""
    """one sentence for `kraft list robots`"""
    transport: TransportSettings
    """how messages travel: `ros2`, `rosbridge` or `loopback`"""
    rate_hz: Rate | None = None
    """commands per second; the rate of the method's controller if left out"""
    pose: PoseInput
    """{topic, type, frame, stamp, rate_hz, reliable, tracked_point, level_camera}"""
    command: CommandOutput
    """{topic, type, frame, speed, steering, timeout}"""
    dead_man: DeadMan | None = None
    """{topic, type, button, timeout} of a switch that must be held; none if left out"""
    goal: GoalInput | None = None
    """{topic, heading_tolerance_deg} of goals as PoseStamped, which replace the scenario's"""
    map: TopicInput | None = None
    """{topic} of an OccupancyGrid, which is added to the scenario's obstacles"""
    clock: TopicInput | None = None
    """{topic} of the time of a simulation (rosgraph_msgs/Clock), as `use_sim_time` of ROS; the machine's if left out"""
    simulated: bool = False
    """whether it is a robot of kraft world: no person holds a switch, and its model needs no identification"""
    display: Annotated[str, StringConstraints(pattern=r"^((/[A-Za-z_][A-Za-z0-9_]*)+)?$")] = "/kraft"
    """topic under which plan, contingency, footprint and markers are sent; empty for none"""
    limits: Limits = Limits()
    """{speed, steering_deg}"""
    watchdog: Watchdog = Watchdog()
    """{pose_age, jump, jump_deg, clock, start, start_deg, lost, late, give_up}"""

    _source: Source = PrivateAttr(default_factory=Source)

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Topics that are named twice, and units and signs that the type of the commands does not have."""
        places: dict[str, str] = {}
        for part in ("pose", "command", "dead_man", "goal", "map", "clock"):
            section = content.get(part)
            topic = section.get("topic") if isinstance(section, Mapping) else None
            if not isinstance(topic, str):
                continue
            if topic in places:
                problem = f"is {topic}, as {places[topic]}.topic is"
                yield refuse(problem, "expected a topic for each", (part, "topic"), Code.DUPLICATE)
            places.setdefault(topic, part)
        command = content.get("command")
        if isinstance(command, Mapping) and command.get("type") == JOINT_STATE:
            for key, default in (("speed", SpeedCommand()), ("steering", SteeringCommand())):
                if command.get(key, default.model_dump()) not in (default, default.model_dump()):
                    problem = f"is given with {JOINT_STATE}, which takes the controls of the model as they are"
                    expected = "expected it for the other types alone"
                    yield refuse(problem, expected, ("command", key), Code.CONFLICT)
        yield from cls._rates(content)

    @classmethod
    def _rates(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Rates of commands and poses that are too slow for the timeouts."""

        def number(section: str, key: str, default: float) -> float | None:
            part = content.get(section, {})
            value = part.get(key, default) if isinstance(part, Mapping) else None
            return float(value) if is_number(value) and value > 0 else None

        rate, timeout = content.get("rate_hz"), number("command", "timeout", COMMAND_TIMEOUT)
        if is_number(rate) and rate > 0 and timeout is not None and (late := _too_slow(rate, timeout)):
            yield refuse(f"is {rate:g}, {late[0]}", late[1], ("rate_hz",), Code.CONFLICT)
        poses, age = number("pose", "rate_hz", POSE_RATE), number("watchdog", "pose_age", POSE_AGE)
        if poses is not None and age is not None and 2.0 / poses > age:
            problem = f"is {age:g}, shorter than it takes for two poses to arrive"
            yield refuse(problem, f"expected at least {2.0 / poses:.3g}", ("watchdog", "pose_age"), Code.CONFLICT)

    def too_slow(self, rate: float) -> tuple[str, str] | None:
        """What is wrong with commands at a rate (Hz) that the multiplexer does not wait for, and what is expected."""
        return _too_slow(rate, self.command.timeout)

    @property
    def source(self) -> Source:
        """Position of each value in the file."""
        return self._source


def _too_slow(rate: float, timeout: float) -> tuple[str, str] | None:
    """What is wrong with commands at a rate (Hz) beside a timeout (s), and what is expected; None if nothing is."""
    if 2.0 / rate <= timeout:
        return None
    return f"two commands apart more than the timeout of {timeout:g} s", f"expected at least {2.0 / timeout:g}"


def load_robot(name_or_path: str | Path) -> Robot:
    """Load a bundled robot (``f1tenth``) or a robot file.

    Raises:
        InputError: with every problem of the file, or if there is no such name or file.
    """
    robot, document = read_model(bundled.find("robot", name_or_path), Robot)
    robot._source = document.source  # frozen fields stay as they are; this is where they came from
    return robot
