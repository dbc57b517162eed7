"""Film, MP4 or animated WebP, that appears at its path only when it is complete."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, TypeAlias

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace
from numpy.typing import NDArray

from kraft.files import Replacement, unwritable

Image: TypeAlias = NDArray[np.uint8]

BT709: Final = 1
"""Code of ITU-R BT.709 for primaries and transfer (ITU-T H.273): the default of players at this size."""


@dataclass(frozen=True)
class Format:
    """Container and codec of a film, its frames per second, and the divisor of the pictures' size."""

    container: str
    codec: str
    fps: int
    divisor: int
    options: tuple[tuple[str, str], ...]
    settings: tuple[tuple[str, str], ...]


FORMATS: Final = {
    ".mp4": Format("mp4", "libx264", 30, 1, (("movflags", "faststart"),), (("preset", "veryfast"), ("crf", "20"))),
    ".webp": Format("webp", "libwebp_anim", 8, 2, (("loop", "0"),), (("quality", "50"), ("compression_level", "6"))),
}
"""Formats by suffix: H.264, and a small animation for pages, half as wide, which repeats without end."""


class FilmWriter:
    """Writes pictures in yuv420p beside `path`; `finish` moves the file to `path`, `discard` removes it.

    `fps` is the number of frames per second, `frames` that of the frames so far.
    """

    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        """Open the file; `size` is width and height of the pictures, px, both multiples of 4.

        Raises:
            InputError: if it cannot be written.
        """
        form = FORMATS[path.suffix.lower()]
        self._path, self._file, self.fps = path, Replacement(path), form.fps
        temporary = str(self._file.temporary)
        self._container: Any = av.open(temporary, "w", format=form.container, options=dict(form.options))
        stream: Any = self._container.add_stream(form.codec, rate=form.fps, options=dict(form.settings))
        stream.width, stream.height = self._size = size[0] // form.divisor, size[1] // form.divisor
        stream.pix_fmt, stream.time_base = "yuv420p", Fraction(1, form.fps)
        coding = stream.codec_context
        coding.color_range, coding.colorspace = ColorRange.MPEG, Colorspace.ITU709
        coding.color_primaries = coding.color_trc = BT709
        self._stream, self.frames = stream, 0

    def add(self, image: Image) -> None:
        """Append a picture, uint8 (height, width, 3)."""
        picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        width, height = self._size
        frame = picture.reformat(
            width, height, "yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
        )
        frame.pts = self.frames
        self.frames += 1
        self._mux(frame)

    def finish(self) -> None:
        """Complete the file and put it in its place.

        Raises:
            InputError: if there is no room for it.
        """
        try:
            self._mux(None)
            self._container.close()
        except OSError as error:
            raise unwritable(self._path, error) from error
        self._file.commit()

    def discard(self) -> None:
        """Close and remove what has been written; does nothing after `finish`."""
        self._container.close()
        self._file.discard()

    def _mux(self, frame: Any) -> None:
        try:
            for packet in self._stream.encode(frame):
                self._container.mux(packet)
        except OSError as error:
            raise unwritable(self._path, error) from error
