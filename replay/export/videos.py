"""A recording's views as video files: H.264 in MP4, written by PyAV (the extra [video]).

Gray goes into the luma channel at its full range, so that a decoder gives back the very
values that were encoded; only the compression itself loses something, and with `lossless`
it does not either.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import CdmisfaError, UsageError
from replay.export.images import pieces, view_names
from replay.recordings.source import RecordedSource

LOSSY = {"crf": "18", "preset": "medium"}
"""Compression at which a difference is hardly seen."""

EXACT = {"qp": "0", "preset": "medium"}
"""Compression that keeps every value."""

NEUTRAL = 128
"""Chroma of gray."""

FULL_RANGE = 2
"""FFmpeg's number for luma from 0 to 255."""


class Film:
    """A video file that is being written.

    Args:
        file: where to; replaced.
        shape: height and width of a frame.
        fps: frames per second.
        lossless: keep every value.
        key_every: frames from one that can be decoded alone to the next; 0 leaves it open.
        about: facts that go into the file's comment, as JSON.

    Raises:
        UsageError: PyAV is not installed.
        CdmisfaError: the file cannot be written.
    """

    def __init__(
        self,
        file: Path,
        shape: tuple[int, int],
        fps: float,
        *,
        lossless: bool = False,
        key_every: int = 0,
        about: Mapping[str, Any] | None = None,
    ) -> None:
        self._av = _library()
        self._file, self._shape = file, shape
        self._planes = np.full(_planes(shape), NEUTRAL, dtype=np.uint8)
        rate = Fraction(fps).limit_denominator(1001)
        self._tick = 1 / rate
        options = {**(EXACT if lossless else LOSSY), **({"g": str(key_every)} if key_every else {})}
        try:
            self._container = self._av.open(str(file), "w", format="mp4")
            self._container.metadata["comment"] = json.dumps(about or {})
            self._stream = self._container.add_stream("libx264", rate=rate, options=options)
            self._stream.height, self._stream.width = shape
            self._stream.pix_fmt = self._format()
            self._stream.max_b_frames = 0  # each frame's place in the file is its place in time
            self._stream.codec_context.color_range = FULL_RANGE
        except (OSError, ValueError, self._av.FFmpegError) as error:
            raise self._failed(error) from error
        self._count = 0

    def add(self, frame: NDArray[np.uint8]) -> None:
        """Append a gray frame, (height, width).

        Raises:
            CdmisfaError: it cannot be written.
        """
        rows = self._planes[0] if self._planes.ndim == 3 else self._planes
        rows[: self._shape[0]] = frame
        picture = self._av.VideoFrame.from_ndarray(self._planes, format=self._format())
        picture.pts, picture.time_base = self._count, self._tick
        picture.color_range = FULL_RANGE
        self._mux(picture)
        self._count += 1

    def close(self) -> None:
        """Write what is waiting, and the index.

        Raises:
            CdmisfaError: it cannot be written.
        """
        self._mux(None)
        self._end()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._end()

    def _mux(self, picture: Any) -> None:
        try:
            self._container.mux(self._stream.encode(picture))
        except (OSError, ValueError, self._av.FFmpegError) as error:
            raise self._failed(error) from error

    def _end(self) -> None:
        try:
            self._container.close()
        except (OSError, ValueError, self._av.FFmpegError) as error:
            raise self._failed(error) from error

    def _format(self) -> str:
        """Half the chroma, which every player knows, needs even sides."""
        return "yuv444p" if self._planes.ndim == 3 else "yuv420p"

    def _failed(self, error: Exception) -> CdmisfaError:
        return CdmisfaError(f"{self._file} cannot be written: {error}")


def write_films(source: RecordedSource, folder: Path, *, lossless: bool = False) -> int:
    """Write each view as VIEW.mp4.

    Returns:
        How many frames, of all views.

    Raises:
        UsageError: PyAV is not installed.
        CdmisfaError: a file cannot be written.
    """
    for stream, name in enumerate(view_names(source.spec)):
        write_film(source, stream, folder / f"{name}.mp4", lossless=lossless)
    return source.frames * len(source.spec.streams)


def write_film(
    source: RecordedSource, stream: int, file: Path, *, lossless: bool = False, key_every: int = 0
) -> None:
    """Write one view as a video of the recording's frame rate.

    The file's comment holds, as JSON, the view, its first frame and that frame's log time,
    and what was recorded.
    """
    spec = source.spec
    about = {
        "view": spec.streams[stream],
        "first_frame": source.first_frame,
        "first_time_ns": spec.time_ns(source.first_frame),
        **source.scene(),
    }
    height, width = spec.frame_shape
    with Film(
        file, (height, width), spec.fps, lossless=lossless, key_every=key_every, about=about
    ) as film:
        for block in pieces(source, stream):
            for frame in block.frames:
                film.add(frame)


def _planes(shape: tuple[int, int]) -> tuple[int, ...]:
    """Shape of a picture's channels as FFmpeg lays them out."""
    height, width = shape
    if height % 2 or width % 2:
        return 3, height, width
    return height * 3 // 2, width


def _library() -> Any:
    try:
        import av
        import av.error
    except ImportError as error:
        raise UsageError(
            "writing videos needs PyAV, which is not installed: pip install 'cdmisfa[video]'"
        ) from error
    return av
