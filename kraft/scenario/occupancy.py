"""Reader of occupancy maps in the format of ROS's map_server: a YAML file and a PGM or PNG image.

A cell is free only if its occupancy is below ``free_thresh``: unknown cells, cells between the thresholds and
transparent cells are occupied. The yaw of ``origin`` (rad, as in ROS) is applied.
"""

from __future__ import annotations

import os
import struct
import warnings
import zlib
from pathlib import Path
from typing import Annotated, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from pydantic import BeforeValidator, Field, model_validator

from kraft.config.schema import LENGTH_MIN, Angle, Coordinate, Probability, StrictModel, read_model, refuse
from kraft.config.source import Source
from kraft.errors import Code, InputError
from kraft.scenario.geometry import OccupancyMap
from ompl_ext.memory import available_memory, in_words

CELLS_MAX: Final = 80_000_000
BYTES_PER_PIXEL: Final = 24  # while an image is read

_FORMATS: Final = ("PPM", "PNG")  # Pillow reads PGM as a kind of PPM
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

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.free_thresh >= self.occupied_thresh:
            problem = f"is {self.free_thresh:g}, not below occupied_thresh"
            raise refuse(problem, f"expected less than {self.occupied_thresh:g}", ("free_thresh",), Code.CONFLICT)
        return self


def read_map(path: Path, *, height: float, name: str | None) -> OccupancyMap:
    """Read a map's YAML file and its image.

    Raises:
        InputError: if either is missing or invalid; problems of the image are reported at the ``image`` key.
    """
    settings, document = read_model(path, MapServerFile)
    brightness, opaque = _read_image(path.parent / settings.image, document.source)
    if settings.mode == "raw":  # the brightness is the occupancy in percent, above 100 is unknown
        free = np.round(brightness * 255) < settings.free_thresh * 100
    else:
        free = (brightness if settings.negate else 1.0 - brightness) < settings.free_thresh
    occupied = np.flipud(~(free & opaque)).copy()
    occupied.setflags(write=False)
    return OccupancyMap(occupied, settings.resolution, settings.origin, height, name)


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
        pixels = np.asarray(image, dtype=np.float64) / 65535.0
        return pixels, np.ones(pixels.shape, dtype=np.bool_)
    if image.mode == "L" and "transparency" not in image.info:
        return np.asarray(image) / 255.0, np.ones((image.height, image.width), dtype=np.bool_)
    rgba = np.asarray(image.convert("RGBA"))
    return rgba[..., :3].mean(axis=-1) / 255.0, rgba[..., 3] == 255
