"""A recording's frames piece by piece, as PNG files, and as videos: H.264 in MP4, by PyAV.

Gray goes into the luma channel at its full range, so that a decoder gives back the very
values that were encoded; only the compression itself loses something, and with `lossless`
it does not either.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from cdmisfa.core.blocks import Block
from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.names import stream_names
from recorder.images.videos import pyav
from replay.inputs import Logged
from replay.recordings.view_file import intersection
from replay.stored import Span

PIECE = 1000
"""Most frames that are held at once."""

PIECE_BYTES = 64 * 2**20
"""Most bytes of frames that are held at once, unless one frame has more."""

LOSSY = {"crf": "18", "preset": "medium"}
"""Compression at which a difference is hardly seen."""

EXACT = {"qp": "0", "preset": "medium"}
"""Compression that keeps every value."""

NEUTRAL = 128
"""Chroma of gray."""

FULL_RANGE = 2
"""FFmpeg's number for luma from 0 to 255."""


def pieces(source: Logged, stream: int, spans: Sequence[Span] | None = None) -> Iterator[Block]:
    """The frames of one view in order: all that it has, or those of some spans.

    The source's clock is moved.
    """
    frame = math.prod(source.spec.frame_shape) * np.dtype(source.spec.dtype).itemsize
    size = max(1, min(PIECE, PIECE_BYTES // max(1, frame)))
    for low, high in _held(source, stream) if spans is None else spans:
        for t in range(low, high, size):
            source.seek(t)
            yield source.take(stream, min(size, high - t))


def count(source: Logged) -> int:
    """Frames of all views."""
    streams = range(len(source.spec.streams))
    return sum(high - low for stream in streams for low, high in _held(source, stream))


def shared_spans(source: Logged) -> list[Span]:
    """The unbroken stretches of frames that every view has; one of a source without gaps.

    Raises:
        UsageError: there is none.
    """
    held = [_held(source, stream) for stream in range(len(source.spec.streams))]
    shared = functools.reduce(intersection, held)
    if not shared:
        raise UsageError("its views have gaps, and no frame in common: export each by itself")
    return shared


def _held(source: Logged, stream: int) -> list[Span]:
    first = source.first_frame
    return source.spans(stream, first, first + source.frames)


def write_images(source: Logged, folder: Path) -> int:
    """Write every frame of every view as VIEW/FRAME.png, and return how many there are."""
    for stream, name in enumerate(stream_names(source.spec.streams)):
        (folder / name).mkdir(parents=True)
        for block in pieces(source, stream):
            for i, frame in enumerate(block.frames):
                Image.fromarray(frame).save(folder / name / f"{block.t + i:08d}.png")
    return count(source)


def write_films(source: Logged, folder: Path, *, lossless: bool) -> int:
    """Write each view as VIEW.mp4, see `write_film`, and return how many frames they have."""
    folder.mkdir()
    for stream, name in enumerate(stream_names(source.spec.streams)):
        write_film(source, stream, folder / f"{name}.mp4", lossless=lossless)
    return count(source)


def write_film(
    source: Logged,
    stream: int,
    file: Path,
    *,
    lossless: bool,
    key_every: int = 0,
    spans: Sequence[Span] | None = None,
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
        spans: write these frames one after the other; by default all, each at its time.

    Raises:
        UsageError: PyAV is not installed.
        CdmisfaError: the file cannot be written.
    """
    av, spec = pyav("writing videos"), source.spec
    first = source.first_frame if spans is None else spans[0][0]
    about = {
        "view": spec.streams[stream],
        "first_frame": first,
        "first_time_ns": spec.time_ns(first),
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
            for number, (t, picture) in enumerate(_pictures(av, source, stream, spans)):
                picture.pts = t - first if spans is None else number
                picture.time_base = 1 / rate
                container.mux(video.encode(picture))
            container.mux(video.encode(None))
    except (OSError, ValueError, av.FFmpegError) as error:
        raise CdmisfaError(f"{file} cannot be written: {error}") from error


def _pictures(
    av: Any, source: Logged, stream: int, spans: Sequence[Span] | None
) -> Iterator[tuple[int, Any]]:
    """The frames of a view with their numbers, as PyAV's, in one buffer."""
    height, width = source.spec.frame_shape
    kind = pixel_format(source.spec.frame_shape)
    shape = (3, height, width) if kind == "yuv444p" else (height * 3 // 2, width)
    planes = np.full(shape, NEUTRAL, dtype=np.uint8)
    luma = planes[0] if planes.ndim == 3 else planes[:height]
    for block in pieces(source, stream, spans):
        for t, frame in enumerate(block.frames, start=block.t):
            luma[:] = frame
            picture = av.VideoFrame.from_ndarray(planes, format=kind)
            picture.color_range = FULL_RANGE
            yield t, picture


def pixel_format(shape: tuple[int, ...]) -> str:
    """A video's pixels: half the chroma, which every player knows, needs even sides."""
    return "yuv444p" if shape[0] % 2 or shape[1] % 2 else "yuv420p"
