"""A recording's views as video files: H.264 in MP4, written by PyAV (the extra [video]).

Gray goes into the luma channel at its full range, so that a decoder gives back the very
values that were encoded; only the compression itself loses something, and with `lossless`
it does not either.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.errors import CdmisfaError
from recorder.images.videos import pyav
from replay.export.episodes import Stitched
from replay.export.images import count, file_names, pieces
from replay.inputs import Logged
from replay.stored import StoredSource

LOSSY = {"crf": "18", "preset": "medium"}
"""Compression at which a difference is hardly seen."""

EXACT = {"qp": "0", "preset": "medium"}
"""Compression that keeps every value."""

NEUTRAL = 128
"""Chroma of gray."""

FULL_RANGE = 2
"""FFmpeg's number for luma from 0 to 255."""


def write_films(source: Logged, folder: Path, *, lossless: bool) -> int:
    """Write each view as VIEW.mp4, see `write_film`, and return how many frames they have."""
    folder.mkdir()
    for stream, name in enumerate(file_names(source.spec)):
        write_film(source, stream, folder / f"{name}.mp4", lossless=lossless)
    return count(source)


def write_film(
    source: Logged | Stitched, stream: int, file: Path, *, lossless: bool, key_every: int = 0
) -> None:
    """Write one view as a video of the recording's frame rate.

    The file's comment holds, as JSON, the view, its first frame and that frame's log time,
    and what was recorded.

    Args:
        source: the recording.
        stream: the view.
        file: where to; replaced.
        lossless: keep every value.
        key_every: frames from one that can be decoded alone to the next; 0 leaves it open.

    Raises:
        UsageError: PyAV is not installed.
        CdmisfaError: the file cannot be written.
    """
    av, spec = pyav("writing videos"), source.spec
    about = {
        "view": spec.streams[stream],
        "first_frame": source.first_frame,
        "first_time_ns": spec.time_ns(source.first_frame),
        **source.scene(),
    }
    rate = Fraction(spec.fps).limit_denominator(1001)
    options = {**(EXACT if lossless else LOSSY), **({"g": str(key_every)} if key_every else {})}
    try:
        with av.open(str(file), "w", format="mp4") as container:
            container.metadata["comment"] = json.dumps(about)
            video = container.add_stream("libx264", rate=rate, options=options)
            video.height, video.width = spec.frame_shape
            video.pix_fmt = pixel_format(spec.frame_shape)
            video.max_b_frames = 0  # no B-frames: file order is display order
            video.codec_context.color_range = FULL_RANGE
            for picture in _pictures(av, source, stream):
                picture.time_base = 1 / rate
                container.mux(video.encode(picture))
            container.mux(video.encode(None))
    except (OSError, ValueError, av.FFmpegError) as error:
        raise CdmisfaError(f"{file} cannot be written: {error}") from error


def _pictures(av: Any, source: StoredSource, stream: int) -> Iterator[Any]:
    """The frames of a view as PyAV's, in one buffer."""
    height, width = source.spec.frame_shape
    kind = pixel_format(source.spec.frame_shape)
    shape = (3, height, width) if kind == "yuv444p" else (height * 3 // 2, width)
    planes = np.full(shape, NEUTRAL, dtype=np.uint8)
    luma = planes[0] if planes.ndim == 3 else planes[:height]
    for block in pieces(source, stream):
        for t, frame in enumerate(block.frames, start=block.t):
            luma[:] = frame
            picture = av.VideoFrame.from_ndarray(planes, format=kind)
            picture.pts, picture.color_range = t - source.first_frame, FULL_RANGE
            yield picture


def pixel_format(shape: tuple[int, ...]) -> str:
    """A video's pixels: half the chroma, which every player knows, needs even sides."""
    return "yuv444p" if shape[0] % 2 or shape[1] % 2 else "yuv420p"
