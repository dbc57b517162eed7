"""Obstacles as plain geometry, in metres and radians, x forward, y left; and the reader of occupancy maps.

Maps have the format of ROS's map_server: a YAML file and a PGM or PNG image.
"""

from __future__ import annotations

import math
import os
import struct
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from pydantic import BeforeValidator, Field
from pydantic_core import PydanticCustomError

from kraft.config.schema import LENGTH_MIN, Angle, Coordinate, Probability, StrictModel, is_number, refuse, valid
from kraft.config.source import Source
from kraft.config.yaml_reader import read_document
from kraft.errors import Code, InputError, Problems
from kraft.files import path_from
from ompl_ext.memory import available_memory, in_words
from ompl_ext.obstacles import OccupancyGrid

Vec2: TypeAlias = tuple[float, float]


@dataclass(frozen=True)
class Box:
    """Rectangle of full ``size`` (length, width) in m, turned by ``yaw`` rad about its ``center``."""

    center: Vec2
    size: Vec2
    yaw: float = 0.0
    height: float = 0.2
    name: str | None = None

    @property
    def corners(self) -> tuple[Vec2, Vec2, Vec2, Vec2]:
        """Four corners, counter-clockwise."""
        (x, y), (length, width) = self.center, self.size
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        a, b = length / 2, width / 2
        q0, q1, q2, q3 = ((x + c * u - s * v, y + s * u + c * v) for u, v in ((a, b), (-a, b), (-a, -b), (a, -b)))
        return q0, q1, q2, q3


@dataclass(frozen=True)
class Circle:
    """Disc."""

    center: Vec2
    radius: float
    height: float = 0.2
    name: str | None = None


@dataclass(frozen=True)
class Polygon:
    """Simple polygon, convex or not; ``vertices`` run counter-clockwise and do not repeat the first."""

    vertices: tuple[Vec2, ...]
    height: float = 0.2
    name: str | None = None


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """Grid of square cells.

    Attributes:
        occupied: read-only bool array [ny, nx]; row 0 lies at the origin, x grows with the column.
            Unknown cells are occupied.
        resolution: side of a cell, m.
        origin: pose (x, y, yaw) of the outer corner of cell [0, 0], m and rad.
        states_outside: whether its scenario says what is beyond the map inside the bounds.
    """

    occupied: NDArray[np.bool_]
    resolution: float
    origin: tuple[float, float, float]
    height: float = 0.2
    name: str | None = None
    states_outside: bool = field(default=False, compare=False)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, OccupancyMap):
            return NotImplemented
        mine = (self.resolution, self.origin, self.height, self.name)
        theirs = (other.resolution, other.origin, other.height, other.name)
        return mine == theirs and np.array_equal(self.occupied, other.occupied)

    def __hash__(self) -> int:
        return hash((self.occupied.tobytes(), self.occupied.shape, self.resolution, self.origin))

    def cropped(self, x: Vec2, y: Vec2) -> OccupancyMap:
        """Part of the map that holds a rectangle from x[0], y[0] to x[1], y[1] m; a cell outside of it if none does."""
        x0, y0, yaw = self.origin
        c, s = math.cos(yaw), math.sin(yaw)
        corners = [(px - x0, py - y0) for px in x for py in y]
        columns = _cells([c * dx + s * dy for dx, dy in corners], self.resolution, self.occupied.shape[1])
        rows = _cells([c * dy - s * dx for dx, dy in corners], self.resolution, self.occupied.shape[0])
        u, v = columns.start * self.resolution, rows.start * self.resolution
        origin = (x0 + c * u - s * v, y0 + s * u + c * v, yaw)
        return OccupancyMap(self.occupied[rows, columns], self.resolution, origin, self.height, self.name)

    def occupied_at(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether the cells at points (n, 2) in m are occupied; outside of the map none is."""
        x0, y0, yaw = self.origin
        c, s = math.cos(yaw), math.sin(yaw)
        column, row = np.floor((points - (x0, y0)) @ np.array([[c, -s], [s, c]]) / self.resolution).astype(int).T
        rows, columns = self.occupied.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        found: NDArray[np.bool_] = inside & self.occupied[row.clip(0, rows - 1), column.clip(0, columns - 1)]
        return found

    @property
    def corners(self) -> NDArray[np.float64]:
        """Corners (4, 2) of the whole map, counter-clockwise from its origin, m."""
        rows, columns = self.occupied.shape
        return self._placed(np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]]))

    @property
    def occupied_centres(self) -> NDArray[np.float64]:
        """Centres (n, 2) of the occupied cells, m."""
        rows, columns = np.nonzero(self.occupied)
        return self._placed(np.column_stack([columns, rows]) + 0.5)

    def _placed(self, cells: NDArray[np.floating | np.integer]) -> NDArray[np.float64]:
        """Points (n, 2) in m that are so many cells (n, 2) along the columns and the rows."""
        x0, y0, yaw = self.origin
        c, s = math.cos(yaw), math.sin(yaw)
        placed: NDArray[np.float64] = (cells * self.resolution) @ np.array([[c, s], [-s, c]]) + (x0, y0)
        return placed

    @property
    def grid(self) -> OccupancyGrid:
        """Grid for the planner."""
        return OccupancyGrid(self.occupied, self.resolution, self.origin)

    def boxes(self) -> tuple[Box, ...]:
        """Few disjoint rectangles that cover exactly the occupied cells."""
        return tuple(self._box(*cells) for cells in self.grid.rectangles())

    def _box(self, row: int, column: int, rows: int, columns: int) -> Box:
        x0, y0, yaw = self.origin
        u, v = (column + columns / 2) * self.resolution, (row + rows / 2) * self.resolution
        c, s = math.cos(yaw), math.sin(yaw)
        size = (columns * self.resolution, rows * self.resolution)
        return Box((x0 + c * u - s * v, y0 + s * u + c * v), size, yaw, self.height, self.name)


def _cells(along: Sequence[float], resolution: float, count: int) -> slice:
    """Cells of a row of `count` that hold all places (m from its beginning), at least one."""
    first = min(max(math.floor(min(along) / resolution), 0), count - 1)
    return slice(first, min(max(math.ceil(max(along) / resolution), first + 1), count))


Obstacle: TypeAlias = Box | Circle | Polygon | OccupancyMap


def signed_area(vertices: NDArray[np.float64]) -> float:
    """Area of a polygon [n, 2] in m^2, positive when it runs counter-clockwise."""
    local = vertices - vertices[0]  # far from the origin of the world the products would lose digits
    x, y = local[:, 0], local[:, 1]
    return float(0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def crossing_edges(vertices: NDArray[np.float64]) -> tuple[int, int] | None:
    """Two edges of a polygon [n, 2] that intersect, or None if it is simple.

    Edge i runs from vertex i to i + 1. Neighbours share one point; if they share more (fold back), they intersect.
    """
    n = len(vertices)
    a, b = vertices, np.roll(vertices, -1, axis=0)
    for i in range(n):
        following = (i + 1) % n
        along, onward = b[i] - a[i], b[following] - a[following]
        if along[0] * onward[1] == along[1] * onward[0] and along @ onward < 0:
            return i, following
        others = np.arange(i + 2, n - (i == 0))
        hit = _meet(a[i], b[i], a[others], b[others])
        if hit.any():
            return i, int(others[np.argmax(hit)])
    return None


def _meet(
    p: NDArray[np.float64], q: NDArray[np.float64], r: NDArray[np.float64], s: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether the segment pq intersects each segment rs [m, 2]; touching counts."""

    def side(o: NDArray[np.float64], d: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.float64]:
        u, v = d - o, t - o
        return np.sign(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])

    straddle = (side(p, q, r) * side(p, q, s) <= 0) & (side(r, s, p) * side(r, s, q) <= 0)
    overlap = (np.minimum(p, q) <= np.maximum(r, s)) & (np.minimum(r, s) <= np.maximum(p, q))
    return np.asarray(straddle & overlap.all(axis=-1), dtype=np.bool_)


CELLS_MAX: Final = 80_000_000
"""Most cells of a map: what Pillow reads without a warning of a decompression bomb (89 million), rounded down."""
BYTES_PER_PIXEL: Final = 24
"""Memory while an image is read, bytes."""

SAVED_UNKNOWN: Final = 205
"""Brightness out of 255 of unknown cells in the maps of ROS' map_saver."""
SAVED_GREYS: Final = {0, SAVED_UNKNOWN, 254, 255}
"""Brightness out of 255 of the cells that map_saver writes: occupied, unknown and free (white in PNG)."""

NOT_AN_IMAGE: Final = "expected the map's YAML file, whose key `image` names the image"
_PNG: Final = b"\x89PNG\r\n\x1a\n"
_PGM: Final = tuple(b"P%d%c" % (kind, space) for kind in range(1, 7) for space in b" \t\r\n#")
"""First bytes of images in the formats of PPM, none of which begins a YAML file of a map."""
_FORMATS: Final = ("PPM", "PNG")
"""Formats of images, as Pillow names them: it reads PGM as a kind of PPM."""
_LEVELS: Final = {"L;2": 85, "L;4": 17}
"""Brightness out of 255 of the first grey above black in a PNG of two or four bits, by Pillow's name for its pixels."""
_BROKEN: Final = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    IndexError,
    struct.error,
    zlib.error,
    OverflowError,
)
"""Exceptions of Pillow for truncated or corrupt images."""


def _as_flag(value: object) -> object:
    return int(value) if isinstance(value, bool) else value


class MapServerFile(StrictModel):
    """The YAML file of a map."""

    image: Annotated[str, Field(min_length=1)]
    """path of the image, relative to this file"""
    resolution: Annotated[float, Field(ge=LENGTH_MIN, le=100)]
    """side of a cell, m"""
    origin: tuple[Coordinate, Coordinate, Angle]
    """[x, y, yaw] of the lower left corner, m and rad"""
    negate: Annotated[Literal[0, 1], BeforeValidator(_as_flag)] = 0
    """1 if white means occupied"""
    occupied_thresh: Probability = 0.65
    """occupancy above which a cell is occupied"""
    free_thresh: Probability = 0.196
    """occupancy below which a cell is free"""
    mode: Literal["trinary", "scale", "raw"] = "trinary"
    """how map_server turns brightness into occupancy"""

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Check the order of the thresholds, and that programs agree about the meaning of the image."""
        free, occupied = (content.get(key, cls.model_fields[key].default) for key in ("free_thresh", "occupied_thresh"))
        if is_number(free) and is_number(occupied) and free >= occupied:
            problem = f"is {free:g}, not below occupied_thresh"
            yield refuse(problem, f"expected less than {occupied:g}", ("free_thresh",), Code.CONFLICT)
        if content.get("mode") == "raw" and content.get("negate") in (1, True):  # map_server of ROS 1 and 2 differ
            problem = "is 1, which some programs apply in mode raw and others do not"
            yield refuse(problem, "expected 0, or another mode", ("negate",), Code.CONFLICT)


def read_map(path: Path, *, height: float, name: str | None) -> OccupancyMap:
    """Read a map's YAML file and its image.

    Raises:
        InputError: if either is missing or invalid; problems of the image are reported at the ``image`` key.
    """
    if is_image(path):
        raise InputError.of(str(path), "is an image", NOT_AN_IMAGE, Code.MISMATCH)
    document, problems = read_document(path), Problems()
    settings = problems.of(partial(valid, MapServerFile, document))
    image = document.data.get("image") if isinstance(document.data, dict) else None
    pixels = None
    if isinstance(image, str) and image:  # also if other keys are wrong
        pixels = problems.of(lambda: _read_image(path_from(path.parent, image), document.source))
    problems.check()
    assert settings is not None, "every problem was raised"
    assert pixels is not None, "every problem was raised"
    brightness, opaque = pixels
    if settings.mode == "raw":  # the brightness is the occupancy in percent, above 100 is unknown
        free = np.round(brightness * 255) < settings.free_thresh * 100
    else:
        free = (brightness if settings.negate else 1.0 - brightness) < settings.free_thresh
        unknown_is_free = settings.free_thresh > 1.0 - SAVED_UNKNOWN / 255
        if unknown_is_free and settings.mode == "trinary" and not settings.negate:
            free &= ~_saved_as_unknown(brightness)
    occupied = np.flipud(~(free & opaque)).copy()
    occupied.setflags(write=False)
    return OccupancyMap(occupied, settings.resolution, settings.origin, height, name)


def _saved_as_unknown(brightness: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Cells [rows, columns] that map_saver wrote as unknown: of the middle one in an image of its three greys alone.

    Its occupancy of 0.196 is below the free_thresh of 0.25 that the map_saver of ROS 2 writes beside it.
    """
    grey = np.round(brightness * 255).astype(np.uint8)
    found = np.flatnonzero(np.bincount(grey.ravel(), minlength=256))
    unknown: NDArray[np.bool_] = (grey == SAVED_UNKNOWN) & (set(found.tolist()) <= SAVED_GREYS)
    return unknown


def is_image(path: Path) -> bool:
    """Whether a file begins as an image of a map does."""
    try:
        with path.open("rb") as stream:
            return stream.read(len(_PNG)).startswith((_PNG, *_PGM))
    except OSError:
        return False  # reading its YAML reports it


def _read_image(path: Path, source: Source) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Brightness in [0, 1] and opacity of each pixel, both [rows, columns] from the top."""

    def wrong(problem: str, expected: str, code: Code = Code.VALUE) -> InputError:
        return InputError([source.diagnostic("image", problem, expected, code=code)])

    if not os.path.isfile(path):
        raise wrong(f"there is no image {path}", "expected the path of a PGM or PNG file", Code.NOT_FOUND)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path, formats=_FORMATS) as image:
                if image.width * image.height > CELLS_MAX:
                    size = f"{image.width} x {image.height}"
                    raise wrong(f"the image {path} is {size}", f"expected at most {CELLS_MAX} pixels")
                needed, available = BYTES_PER_PIXEL * image.width * image.height, available_memory()
                if needed > available:
                    problem = f"the image {path} needs {in_words(needed)} of memory"
                    raise wrong(problem, f"expected at most {in_words(available)}, which are available")
                if image.mode == "F":  # Pillow reads PFM, whose brightness has no range, as a kind of PPM too
                    raise UnidentifiedImageError
                levels = _LEVELS.get(str(image.tile[0][3]), 1) if image.tile else 1
                if isinstance(colour := image.info.get("transparency"), int):
                    image.info["transparency"] = levels * colour  # Pillow scales the pixels alone
                image.load()
                return _brightness(image)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise wrong(f"the image {path} is too large", f"expected at most {CELLS_MAX} pixels") from error
    except UnidentifiedImageError as error:
        raise wrong(f"{path} is neither PGM nor PNG", "expected a PGM or PNG file", Code.SYNTAX) from error
    except _BROKEN as error:
        problem = f"the image {path} cannot be read ({error})"
        raise wrong(problem, "expected a complete PGM or PNG file", Code.UNREADABLE) from error


def _brightness(image: Image.Image) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    if image.mode in ("I", "I;16", "I;16B", "I;16L"):
        pixels = np.asarray(image, dtype=np.float64)
        return pixels / 65535.0, pixels != image.info.get("transparency", -1)
    if image.mode == "L" and "transparency" not in image.info:
        return np.asarray(image) / 255.0, np.ones((image.height, image.width), dtype=np.bool_)
    rgba = np.asarray(image.convert("RGBA"))
    return rgba[..., :3].mean(axis=-1) / 255.0, rgba[..., 3] == 255
