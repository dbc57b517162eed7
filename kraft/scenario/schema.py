"""Schema of a scenario file with its sections `sensing` and `trial`; `kraft.scenario.loader` has the result."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, ClassVar, Final, Literal

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, StringConstraints
from pydantic_core import PydanticCustomError

from kraft.config.schema import (
    LENGTH_MIN,
    Angle,
    Coordinate,
    Length,
    Name,
    Point,
    Probability,
    Size,
    Span,
    StrictModel,
    is_number,
    refuse,
)
from kraft.errors import Code
from kraft.scenario.geometry import crossing_edges, signed_area
from kraft.scenario.planning import Planning
from kraft.scenario.truth import Truth, misordered

Delay = Annotated[float, Field(ge=0, le=10)]
Timeout = Annotated[float, Field(gt=0, le=86_400)]

CAMERA_HEIGHT: Final = 5.0
"""Height of the camera above the floor, where a scenario does not state its place, m."""
MARKER_HEIGHT: Final = 0.2
"""Height of the marker above the floor while the robot stands, m."""


class Sensing(StrictModel):
    """Camera and marker that the pose comes from, and the radio that commands go through."""

    preset: Literal["planar", "single-tag", "rendered"] = "single-tag"
    """noise of the marker pose: `planar` knows the marker's height, `single-tag` does not; `rendered` renders frames"""
    camera: Annotated[
        tuple[Coordinate, Coordinate, Coordinate], Field(json_schema_extra=lambda schema: schema.pop("default"))
    ] = (1.0, 3.0, CAMERA_HEIGHT)
    """[x, y, z] of the camera, m; in a scenario that leaves it out 5 m above the middle of the bounds"""
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 30.0
    """poses per second"""
    latency: Delay = 0.0
    """age of a pose when it arrives, s"""
    dropout: Probability | None = None
    """fraction of poses that never arrive; the preset's own if not given"""
    noise_scale: Annotated[float, Field(ge=0, le=100)] = 1.0
    """factor on all of the preset's errors"""
    correlation_time: Annotated[float, Field(ge=0, le=1000)] | None = None
    """time constant of a frame's errors, s; 0 for independent frames; the preset's own correlation if not given"""
    communication_delay: Delay = 0.0
    """time that a plan or a contingency takes from the replanner to the vehicle's controller, s"""
    message_loss: Probability = 0.0
    """share of the messages from the replanner to the vehicle's controller that never arrive, except the first one"""
    command_delay: Delay = 0.0
    """time between a command of the controller and its effect, s"""

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Check that rendered frames have no errors that are drawn."""
        usual = {"dropout": None, "noise_scale": 1.0, "correlation_time": None}
        if content.get("preset") == "rendered":
            for key in (key for key, value in usual.items() if content.get(key, value) != value):
                problem = "is given, but the errors of rendered frames are not drawn"
                yield refuse(problem, "expected no such key, or another preset", (key,), Code.CONFLICT)


class Score(StrictModel):
    """Score of a drive by its time, as the BARN challenge defines it.

    A collision or a timeout scores 0, a success the optimal time over the drive's, which counts as two optimal times if
    it is shorter and as eight if it is longer: from 0.125 to 0.5.
    """

    label: Annotated[str, StringConstraints(min_length=1, max_length=100)]
    """what the score is of, for tables"""
    optimal_time: Timeout
    """time in which the shortest path is driven at top speed, s"""

    def of(self, time: float | None) -> float:
        """Score of a successful drive that took `time` (s), or of another one (None)."""
        return 0.0 if time is None else self.optimal_time / min(max(time, 2 * self.optimal_time), 8 * self.optimal_time)


class Trial(StrictModel):
    """When a trial counts as timed out, and how it is scored."""

    timeout: Timeout = 60.0
    """time limit of methods that replan, s"""
    oneshot_timeout: Timeout = 30.0
    """time limit of methods that plan once, s"""
    score: Score | None = None
    """score of imported worlds {label, optimal_time}"""


VERTICES_MAX = 1000
THINNEST: Final = 1e-3 * LENGTH_MIN
"""Smallest area of a polygon over its longest edge, m: far from the origin, rounding gives vertices on a line one."""
Component = Annotated[float, Field(ge=-1e6, le=1e6)]


class Bounds(StrictModel):
    """The workspace. The footprint may not leave it."""

    x: Span
    """[low, high], m"""
    y: Span
    """[low, high], m"""

    def outside(self, x: float, y: float) -> str | None:
        """Coordinate of a point that lies outside (``x`` or ``y``), or None."""
        for axis, value, (low, high) in (("x", x, self.x), ("y", y, self.y)):
            if not low <= value <= high:
                return axis
        return None


class BoxFile(StrictModel):
    """A rectangle."""

    center: Point
    """[x, y] of the centre, m"""
    size: Size
    """[length, width] before turning by yaw_deg, m"""
    yaw_deg: Angle = 0.0
    """rotation, degrees"""
    height: Length = 0.2
    """height in the physics world, m"""


class CircleFile(StrictModel):
    """A disc."""

    center: Point
    """[x, y] of the centre, m"""
    radius: Length
    """radius, m"""
    height: Length = 0.2
    """height in the physics world, m"""


def _simple(vertices: tuple[Point, ...]) -> tuple[Point, ...]:
    if vertices[0] == vertices[-1]:
        problem = "the last vertex repeats the first"
        raise refuse(problem, "expected each vertex once (it closes by itself)", (len(vertices) - 1,), Code.GEOMETRY)
    seen: dict[Point, int] = {}
    for i, vertex in enumerate(vertices):
        if vertex in seen:
            raise refuse(f"repeats vertex {seen[vertex]}", "expected each vertex once", (i,), Code.GEOMETRY)
        seen[vertex] = i
    array = np.array(vertices, dtype=np.float64)
    edges = np.linalg.norm(np.roll(array, -1, axis=0) - array, axis=1)
    if edges.min() < LENGTH_MIN:
        problem = f"the edge to the next vertex is {edges.min():g} m long"
        raise refuse(problem, f"expected at least {LENGTH_MIN:g} m", (int(edges.argmin()),), Code.GEOMETRY)
    if np.linalg.matrix_rank(array - array[0]) < 2:
        raise refuse("the polygon has no area", "expected vertices that are not on one line", code=Code.GEOMETRY)
    if crossing := crossing_edges(array):
        problem = f"the polygon intersects itself: edge {crossing[0]} and edge {crossing[1]}"
        raise refuse(problem, "expected a simple polygon (edge i runs from vertex i to the next)", code=Code.GEOMETRY)
    if abs(signed_area(array)) < THINNEST * edges.max():
        raise refuse(
            "the polygon has hardly any area", "expected vertices that are not on one line", code=Code.GEOMETRY
        )
    return vertices


class PolygonFile(StrictModel):
    """A simple polygon, convex or not."""

    vertices: Annotated[tuple[Point, ...], Field(min_length=3, max_length=VERTICES_MAX), AfterValidator(_simple)]
    """[[x, y], ...] in order, m"""
    height: Length = 0.2
    """height in the physics world, m"""


class MapFile(StrictModel):
    """An occupancy map in the format of ROS's map_server. Unknown cells count as occupied."""

    file: str
    """path of the map's YAML file, relative to this file"""
    height: Length = 0.2
    """height in the physics world, m"""
    outside: Literal["occupied", "free"] | None = None
    """what is beyond the map inside the bounds: occupied (unknown), or free; if left out free, with a warning"""


SHAPES = ("box", "circle", "polygon", "map")


class ObstacleFile(StrictModel):
    """One obstacle: exactly one shape, and perhaps a name."""

    model_config = ConfigDict(json_schema_extra={"oneOf": [{"required": [shape]} for shape in SHAPES]})

    synonyms: ClassVar[Mapping[str, str]] = {
        "disc": "circle",
        "disk": "circle",
        "cylinder": "circle",
        "rectangle": "box",
    }

    name: str | None = None
    """name for messages and pictures"""
    box: BoxFile | None = None
    """a rectangle {center, size, yaw_deg, height}"""
    circle: CircleFile | None = None
    """a disc {center, radius, height}"""
    polygon: PolygonFile | None = None
    """a simple polygon {vertices, height}"""
    map: MapFile | None = None
    """an occupancy map {file, height}"""

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Check that there is one shape; a key that is unknown may be meant as one, and is reported anyway."""
        given = [shape for shape in SHAPES if content.get(shape) is not None]
        if len(given) > 1 or not (given or set(content) - set(cls.model_fields)):
            problem = f"holds {' and '.join(given)}" if given else "holds no shape"
            code = Code.CONFLICT if given else Code.MISSING
            yield refuse(problem, "expected exactly one of box, circle, polygon, map", code=code)


class StartFile(StrictModel):
    """Where the vehicle starts."""

    x: Coordinate
    """m"""
    y: Coordinate
    """m"""
    heading_deg: Angle
    """heading, degrees from +x"""
    speed: Annotated[float, Field(ge=-100, le=100)] = 0.0
    """forward speed, m/s"""


class GoalFile(StrictModel):
    """Where the vehicle has to arrive."""

    center: Point
    """[x, y] of the centre, m"""
    radius: Length
    """distance from the centre that counts as arrived, m"""
    heading_deg: Angle | None = None
    """heading on arrival, degrees from +x"""
    heading_tolerance_deg: Annotated[float, Field(gt=0, le=180)] | None = None
    """deviation from that heading, to either side, that counts as arrived, degrees"""
    limits: dict[str, tuple[Component, Component]] = Field(default_factory=dict)
    """lowest and highest value on arrival of further components of the vehicle's state, {v: [-0.05, 0.05]}, SI units"""

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Check that heading and tolerance are given together, and the order of each interval."""
        heading, tolerance = "heading_deg", "heading_tolerance_deg"
        for given, other in ((heading, tolerance), (tolerance, heading)):
            if content.get(given) is not None and content.get(other) is None:
                yield refuse(f"is given without {other}", "expected both or none", (given,), Code.CONFLICT)
        limits = content.get("limits")
        for name, interval in limits.items() if isinstance(limits, Mapping) else ():
            low, high = interval if isinstance(interval, Sequence) and len(interval) == 2 else (None, None)
            if is_number(low) and is_number(high) and low >= high:
                problem = f"the interval [{low:g}, {high:g}] is empty or inverted"
                yield refuse(problem, "expected [low, high] with low < high", ("limits", str(name)))


class ScenarioFile(StrictModel):
    """Scene with start and goal, and the true world that the planner does not know."""

    name: Name
    """short name of letters, digits, - and _"""
    description: str = ""
    """one sentence for `kraft list scenarios`"""
    bounds: Bounds
    """the workspace {x: [low, high], y: [low, high]}"""
    obstacles: tuple[ObstacleFile, ...] = ()
    """static obstacles, known to the planner"""
    start: StartFile
    """{x, y, heading_deg, speed}"""
    goal: GoalFile
    """{center: [x, y], radius, heading_deg, heading_tolerance_deg, limits}"""
    vehicle: str = "mushr"
    """a vehicle's name, the path of its YAML file, module:attribute or file.py:attribute"""
    planning: Planning = Planning()
    """how to plan"""
    truth: Truth = Truth()
    """what is true and the planner does not know"""
    sensing: Sensing = Field(default_factory=Sensing)
    """how poses are observed and commands delivered"""
    trial: Trial = Trial()
    """when a trial ends"""

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Check the order of all changes of the truth."""
        truth = content.get("truth")
        changes = truth.get("changes") if isinstance(truth, Mapping) else None
        if isinstance(changes, Sequence) and not isinstance(changes, str):
            times = [change.get("time") if isinstance(change, Mapping) else None for change in changes]
            yield from misordered(times, ("truth", "changes"))
