"""MP4 file that appears at its path only when it is complete."""

from __future__ import annotations

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
SETTINGS: Final = {"preset": "veryfast", "crf": "20"}


class Mp4Writer:
    """Writes H.264 in yuv420p beside `path`; `finish` moves the file to `path`, `discard` removes it."""

    def __init__(self, path: Path, size: tuple[int, int], fps: int) -> None:
        """Open the file; `size` is width and height, px, both even.

        Raises:
            InputError: if it cannot be written.
        """
        self._path, self._file = path, Replacement(path)
        self._container: Any = av.open(str(self._file.temporary), "w", format="mp4", options={"movflags": "faststart"})
        stream: Any = self._container.add_stream("libx264", rate=fps, options=SETTINGS)
        stream.width, stream.height = size
        stream.pix_fmt, stream.time_base = "yuv420p", Fraction(1, fps)
        coding = stream.codec_context
        coding.color_range, coding.colorspace = ColorRange.MPEG, Colorspace.ITU709
        coding.color_primaries = coding.color_trc = BT709
        self._stream, self.frames = stream, 0

    def add(self, image: Image) -> None:
        """Append a picture, uint8 (height, width, 3)."""
        picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        frame = picture.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG)
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
