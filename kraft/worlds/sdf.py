"""Gazebo worlds (SDF): outlines of the static shapes on the floor, with the line of each model."""

from __future__ import annotations

import gzip
import math
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from xml.parsers import expat

from kraft.errors import Code, Diagnostic, InputError
from kraft.text import counted

UPRIGHT: Final = 1e-3
"""Largest roll and pitch of an upright shape, rad."""
SIZE_MAX: Final = 200_000_000
"""Largest size of an unpacked file, bytes."""
DEPTH_MAX: Final = 100
"""Most elements within each other; worlds of models in models have some ten."""
Pose = tuple[float, float, float, float, float, float]
"""x, y, z (m), roll, pitch, yaw (rad)."""
ORIGIN: Final[Pose] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass
class Element:
    """Element of an XML file with its position; lines and columns are counted from 1."""

    tag: str
    attributes: dict[str, str]
    line: int
    column: int
    text: str = ""
    children: list[Element] = field(default_factory=list)

    def each(self, tag: str) -> Iterator[Element]:
        """Children with a tag."""
        return (child for child in self.children if child.tag == tag)

    def first(self, tag: str) -> Element | None:
        """First child with a tag."""
        return next(self.each(tag), None)


@dataclass(frozen=True)
class Shapes:
    """Obstacles of a world as a scenario file has them, what was left out, and where the world begins."""

    obstacles: tuple[dict[str, Any], ...]
    skipped: Counter[str]
    line: int
    column: int

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Lowest and highest x, lowest and highest y of all obstacles, m."""
        found = [_extent(obstacle) for obstacle in self.obstacles]
        low_x, high_x, low_y, high_y = zip(*found, strict=True)
        return min(low_x), max(high_x), min(low_y), max(high_y)


def _extent(obstacle: dict[str, Any]) -> tuple[float, float, float, float]:
    """Lowest and highest x, lowest and highest y of an obstacle, m."""
    if "circle" in obstacle:
        (x, y), a = obstacle["circle"]["center"], obstacle["circle"]["radius"]
        return x - a, x + a, y - a, y + a
    (x, y), (length, width) = obstacle["box"]["center"], obstacle["box"]["size"]
    c, s = (abs(f(math.radians(obstacle["box"]["yaw_deg"]))) for f in (math.cos, math.sin))
    a, b = (c * length + s * width) / 2, (s * length + c * width) / 2
    return x - a, x + a, y - b, y + b


def read_sdf(path: Path, *, skip: bool = False) -> Shapes:
    """Read the shapes of a world.

    Args:
        path: SDF file, perhaps compressed by gzip.
        skip: leave out shapes that cannot be obstacles, instead of refusing the world.

    Raises:
        InputError: if the file cannot be read, is no SDF, or has other shapes and they are not to be skipped.
    """
    root = parse_xml(content_of(path), str(path))
    reader = _Reader(str(path))
    world, *others = [root] if root.tag == "world" else [*root.each("world")] or [root]
    if root.tag not in ("sdf", "world"):
        expected = "expected <sdf> with a <world>"
        raise InputError([reader.diagnostic(root, "is no Gazebo world", expected, Code.MISMATCH)])
    if not any(child.tag in ("model", "include") for child in world.children):
        raise InputError([reader.diagnostic(world, "has no model", "expected a <world> with models", Code.MISMATCH)])
    for other in others[:1]:  # Gazebo simulates each world of a file apart
        reader.problem(other, "is a second world", "expected a file with one world", Code.DUPLICATE)
    reader.world(world)
    problems = reader.problems if skip else reader.problems + reader.unknown()
    if problems:
        raise InputError(problems)
    kinds = Counter(kind for kind, _ in reader.others)
    return Shapes(tuple(reader.obstacles), kinds, world.line, world.column)


def content_of(path: Path) -> bytes:
    """Bytes of a file, unpacked if its name ends in ``.gz``.

    Raises:
        InputError: if it cannot be read or unpacked, or is too large.
    """
    expected = "expected a file that can be read"
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            content = file.read(SIZE_MAX + 1)
    except FileNotFoundError:
        raise InputError.of(str(path), "there is no such file", expected, Code.NOT_FOUND) from None
    except (OSError, EOFError, zlib.error) as error:
        problem = f"cannot be read: {getattr(error, 'strerror', None) or error}"
        raise InputError.of(str(path), problem, expected, Code.UNREADABLE) from None
    if len(content) > SIZE_MAX:
        raise InputError.of(str(path), "is too large", f"expected at most {SIZE_MAX} bytes", Code.UNREADABLE)
    return content


def parse_xml(content: bytes, file: str) -> Element:
    """Parse an XML file into elements with their positions.

    Raises:
        InputError: at the first error, for a file that declares entities, and for one with too deep a nesting.
    """
    parser = expat.ParserCreate()
    top = Element("", {}, 1, 1)
    path = [top]

    def refuse(problem: str, expected: str) -> None:
        at = parser.CurrentLineNumber, parser.CurrentColumnNumber + 1
        raise InputError([Diagnostic(file, problem, expected, *at, code=Code.SYNTAX)])

    def start(tag: str, attributes: dict[str, str]) -> None:
        line, column = parser.CurrentLineNumber, parser.CurrentColumnNumber + 1
        path[-1].children.append(Element(tag, attributes, line, column))
        path.append(path[-1].children[-1])
        if len(path) > DEPTH_MAX:
            refuse(f"is the {DEPTH_MAX}th element within another", "expected a world with fewer")

    def text(data: str) -> None:
        path[-1].text += data

    def entity(*_: object) -> None:
        refuse("declares an entity", "expected XML without a document type")

    parser.StartElementHandler, parser.EndElementHandler = start, lambda _: path.pop()
    parser.CharacterDataHandler, parser.EntityDeclHandler = text, entity
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        problem = f"not valid XML ({expat.ErrorString(error.code)})"
        at = Diagnostic(file, problem, "expected an SDF file", error.lineno, error.offset + 1, code=Code.SYNTAX)
        raise InputError([at]) from None
    return top.children[0]


class _Reader:
    """Collects obstacles, shapes that are none, and problems of one file."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.obstacles: list[dict[str, Any]] = []
        self.others: list[tuple[str, Element]] = []
        self.problems: list[Diagnostic] = []

    def world(self, world: Element) -> None:
        """Read all models.

        Gazebo moves models and links to the poses of the first state, which it writes when it saves a world.
        """
        state = world.first("state")
        moved = self.state(state) if state is not None else {}
        for child in world.children:
            if child.tag == "model":
                self.model(child, ORIGIN, "", moved)
            elif child.tag in ("include", "actor", "population", "road"):
                self.others.append((child.tag, child))

    def state(self, state: Element) -> dict[str, Pose]:
        """Poses in the world of models and links by their full names, as in ``table/leg`` and ``table/leg::link``."""
        for tag in ("insertions", "deletions"):
            if (changes := state.first(tag)) is not None and changes.children:
                self.problem(changes, "changes the models", "expected a world without such changes", Code.UNKNOWN)
        return {name: pose for model in state.each("model") for name, pose in self.states(model, "")}

    def states(self, model: Element, prefix: str) -> Iterator[tuple[str, Pose]]:
        """Poses in the world in the state of a model."""
        name = prefix + model.attributes.get("name", "")
        scale = model.first("scale")
        if scale is not None and any(value != 1.0 for value in self.read(scale, 3) if not math.isnan(value)):
            self.problem(
                scale, f"is {' '.join(scale.text.split())}", "expected 1 1 1, and shapes of that size", Code.VALUE
            )
        if model.first("pose") is not None:
            yield name, self.pose(model)
        for link in model.each("link"):
            if link.first("pose") is not None:
                yield f"{name}::{link.attributes.get('name', '')}", self.pose(link)
        for child in model.each("model"):
            yield from self.states(child, f"{name}/")

    def model(self, model: Element, at: Pose, prefix: str, moved: Mapping[str, Pose]) -> None:
        """Add the shapes of a model in a parent at a pose; `moved` has the poses in the world of what was moved."""
        name = prefix + model.attributes.get("name", "")
        if frame := model.attributes.get("placement_frame"):
            self.problem(
                model, f"is placed by its frame {frame!r}", "expected a pose of the model itself", Code.UNKNOWN
            )
        stated = _placed(at, self.pose(model, "__model__" if prefix else "world"))
        pose = moved.get(name, stated)
        for link in model.each("link"):
            link_name = link.attributes.get("name", "")
            on = moved.get(f"{name}::{link_name}", _placed(pose, self.pose(link, "__model__")))
            for collision in link.each("collision"):
                place = _placed(on, self.pose(collision, link_name))
                geometry = collision.first("geometry")
                shape = geometry.children[0] if geometry is not None and geometry.children else None
                if shape is None:
                    self.problem(collision, "has no geometry", "expected a shape", Code.MISSING)
                else:
                    self.shape(shape, place, name)
        for child in model.children:
            if child.tag == "model":
                self.model(child, pose, f"{name}/", moved)
            elif child.tag == "include":
                self.others.append(("include", child))

    def shape(self, shape: Element, at: Pose, name: str) -> None:
        if shape.tag == "plane" and max(abs(at[3]), abs(at[4])) <= UPRIGHT and self._faces_up(shape):
            return
        if shape.tag not in ("cylinder", "box", "sphere"):
            self.others.append((shape.tag, shape))
        elif shape.tag != "sphere" and max(abs(at[3]), abs(at[4])) > UPRIGHT:
            self.others.append((f"tilted {shape.tag}", shape))
        else:
            self.upright(shape, at, name)

    def upright(self, shape: Element, at: Pose, name: str) -> None:
        """Add the outline of a shape, unless it is below the floor."""
        center = [at[0], at[1]]
        if shape.tag == "box":
            length, width, tall = self.numbers(shape, "size", 3)
            outline = {"box": {"center": center, "size": [length, width], "yaw_deg": round(math.degrees(at[5]), 6)}}
        else:
            (radius,) = self.numbers(shape, "radius", 1)
            tall = 2 * radius if shape.tag == "sphere" else self.numbers(shape, "length", 1)[0]
            outline = {"circle": {"center": center, "radius": radius}}
        top = at[2] + tall / 2
        if math.isfinite(top) and top > 0.0:
            for values in outline.values():
                values["height"] = round(max(top, 0.001), 6)
            self.obstacles.append({"name": name, **outline})

    def _faces_up(self, plane: Element) -> bool:
        normal = plane.first("normal")
        if normal is None:
            return True
        x, y, z = self.read(normal, 3)
        return z > 0.0 and math.hypot(x, y) <= UPRIGHT * z

    def pose(self, element: Element, parent: str = "") -> Pose:
        """Pose of an element in its parent, to which it may be relative by its name."""
        pose = element.first("pose")
        if pose is None:
            return ORIGIN
        for key in ("relative_to", "frame"):
            if (frame := pose.attributes.get(key, "")) not in ("", parent):
                self.problem(pose, f"is relative to {frame!r}", "expected a pose in its parent", Code.UNKNOWN)
                return ORIGIN
        if not pose.text.strip():
            return ORIGIN
        rotation = pose.attributes.get("rotation_format", "euler_rpy")
        if rotation != "euler_rpy":
            self.problem(pose, f"has the rotation format {rotation!r}", "expected euler_rpy", Code.UNKNOWN)
            return ORIGIN
        x, y, z, *angles = self.read(pose, 6)
        if pose.attributes.get("degrees", "").strip().lower() in ("true", "1"):
            angles = [math.radians(angle) for angle in angles]
        roll, pitch, yaw = angles
        return x, y, z, roll, pitch, yaw

    def numbers(self, element: Element, tag: str, count: int) -> list[float]:
        found = element.first(tag)
        if found is None:
            self.problem(element, f"has no <{tag}>", f"expected <{tag}> with {counted(count, 'number')}", Code.MISSING)
            return [math.nan] * count
        values = self.read(found, count)
        if any(not value > 0.0 for value in values) and not any(map(math.isnan, values)):
            self.problem(found, f"is {found.text.strip()}", "expected lengths above 0 m", Code.VALUE)
        return values

    def read(self, element: Element, count: int) -> list[float]:
        """Numbers of an element's text; nan after a report if there are no such numbers."""
        try:
            values = [float(word) for word in element.text.split()]
        except ValueError:
            values = []
        if len(values) != count or not all(map(math.isfinite, values)):
            given = " ".join(element.text.split())[:60]
            self.problem(element, f"is {given!r}", f"expected {counted(count, 'finite number')}", Code.VALUE)
            return [math.nan] * count
        return values

    def problem(self, element: Element, problem: str, expected: str, code: Code) -> None:
        self.problems.append(self.diagnostic(element, problem, expected, code))

    def diagnostic(self, element: Element, problem: str, expected: str, code: Code) -> Diagnostic:
        """Problem of an element, at its place."""
        return Diagnostic(self.file, problem, expected, element.line, element.column, f"<{element.tag}>", code)

    def unknown(self) -> list[Diagnostic]:
        """One problem for each kind of shape that cannot be an obstacle, at the first one."""
        counts = Counter(kind for kind, _ in self.others)
        first: dict[str, Element] = {}
        for kind, element in self.others:
            first.setdefault(kind, element)
        expected = "expected upright cylinders, boxes and spheres, or `skip` to leave out all others"
        return [
            self.diagnostic(element, f"{counts[kind]} x {kind} cannot be an obstacle", expected, Code.UNKNOWN)
            for kind, element in first.items()
        ]


def _placed(parent: Pose, child: Pose) -> Pose:
    """Pose of a child in the frame of its parent's parent."""
    rotation = _product(_matrix(parent), _matrix(child))
    x, y, z = (parent[k] + sum(_matrix(parent)[k][j] * child[j] for j in range(3)) for k in range(3))
    roll = math.atan2(rotation[2][1], rotation[2][2])
    pitch = math.asin(max(-1.0, min(1.0, -rotation[2][0])))
    return x, y, z, roll, pitch, math.atan2(rotation[1][0], rotation[0][0])


def _matrix(pose: Pose) -> list[list[float]]:
    """Rotation about the fixed axes x, y, z, in this order."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(angle), math.sin(angle)) for angle in pose[3:])
    return [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]


def _product(a: list[list[float]], b: list[list[float]]) -> list[list[float]]:
    return [[sum(a[i][k] * b[k][j] for k in range(3)) for j in range(3)] for i in range(3)]
