"""Frames of recordings and logs in pieces, as PNG files, and as videos: H.264 in MP4, by PyAV.

Gray values become luma at its full range, so that a decoder returns the values that were encoded.
Only the compression loses something, and with `lossless` nothing.
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
from replay.logs.clock import intersection
from replay.logs.source import LoggedSource
from replay.stored_source import Span

# Most frames and bytes in memory at once, unless one frame is larger.
PIECE, PIECE_BYTES = 1000, 64 * 2**20

# x264's quality at which a difference is hardly visible.
LOSSY = {"crf": "18", "preset": "medium"}

# x264's lossless mode.
EXACT = {"qp": "0", "preset": "medium"}

# Frames of a dataset from one key frame to the next, as in LeRobot: training reads single frames.
KEY_EVERY = 2

# FFmpeg's AVCOL_RANGE_JPEG: luma from 0 to 255.
FULL_RANGE = 2


def pieces(
    source: LoggedSource, stream: int, spans: Sequence[Span] | None = None
) -> Iterator[Block]:
    """Yield the frames of one stream in order: all that it has, or those of some spans.

    This moves the clock of the source.
    """
    shape, dtype = source.spec.kind(stream)
    frame = math.prod(shape) * np.dtype(dtype).itemsize
    size = max(1, min(PIECE, PIECE_BYTES // max(1, frame)))
    for low, high in _spans(source, stream) if spans is None else spans:
        for t in range(low, high, size):
            source.seek(t)
            yield source.take(stream, min(size, high - t))


def shared_spans(source: LoggedSource) -> list[Span]:
    """Return the spans of frames without gaps in any stream.

    Raises:
        UsageError: the streams have no common frame.
    """
    streams = range(len(source.spec.streams))
    shared = functools.reduce(intersection, (_spans(source, stream) for stream in streams))
    if not shared:
        raise UsageError("the streams have gaps and no common frame: export each stream separately")
    return shared


def _spans(source: LoggedSource, stream: int) -> list[Span]:
    first = source.first_frame
    return source.spans(stream, first, first + source.frames)


def write_images(source: LoggedSource, folder: Path) -> int:
    """Write every frame of every stream as STREAM/FRAME.png, and return their number."""
    count = 0
    for stream, name in enumerate(stream_names(source.spec.streams)):
        (folder / name).mkdir(parents=True)
        for block in pieces(source, stream):
            for t, frame in enumerate(block.frames, start=block.t):
                Image.fromarray(frame).save(folder / name / f"{t:08d}.png")
                count += 1
    return count


def write_videos(source: LoggedSource, folder: Path, *, lossless: bool) -> int:
    """Write each stream as STREAM.mp4, and return the number of frames; see `write_video`."""
    folder.mkdir()
    names = stream_names(source.spec.streams)
    return sum(
        write_video(source, stream, folder / f"{name}.mp4", lossless=lossless)
        for stream, name in enumerate(names)
    )


def write_video(
    source: LoggedSource,
    stream: int,
    file: Path,
    *,
    lossless: bool,
    spans: Sequence[Span] | None = None,
) -> int:
    """Write one stream as a video at the frame rate of its source, and return its frames.

    The comment of the file holds, as JSON, the name of the stream, its first frame with its log
    time, and the scene.

    Args:
        source: the recording or log.
        stream: number of the stream.
        file: the new file.
        lossless: keep every value.
        spans: write these frames for a dataset, without pauses and with a key frame every
            `KEY_EVERY`; by default all, each at its time.

    Raises:
        UsageError: PyAV is not installed.
        CdmisfaError: the file cannot be written.
    """
    av, spec, count = pyav(), source.spec, 0
    shape, _ = spec.kind(stream)
    first = source.first_frame if spans is None else spans[0][0]
    comment = {
        "view": spec.streams[stream],
        "first_frame": first,
        "first_time_ns": spec.time_ns(first),
        **source.scene(),
    }
    rate = Fraction(spec.fps).limit_denominator(1001)
    options = (EXACT if lossless else LOSSY) | ({"g": str(KEY_EVERY)} if spans else {})
    try:
        with av.open(str(file), "w", format="mp4") as container:
            container.metadata["comment"] = json.dumps(comment)
            video = container.add_stream("libx264", rate=rate, options=options)
            video.height, video.width = shape
            video.pix_fmt = pixel_format(shape)
            video.max_b_frames = 0  # the file's order is the order of display
            video.codec_context.color_range = FULL_RANGE
            for t, image in _video_frames(av, source, stream, spans):
                image.pts = t - first if spans is None else count
                image.time_base = 1 / rate
                container.mux(video.encode(image))
                count += 1
            container.mux(video.encode(None))
    except (OSError, ValueError, av.FFmpegError) as error:
        raise CdmisfaError(f"{file} cannot be written: {error}") from error
    return count


def _video_frames(
    av: Any, source: LoggedSource, stream: int, spans: Sequence[Span] | None
) -> Iterator[tuple[int, Any]]:
    """Yield the frames of a stream with their numbers, as PyAV's, in one buffer."""
    height, width = size = source.spec.kind(stream)[0]
    kind = pixel_format(size)
    shape = (3, height, width) if kind == "yuv444p" else (height * 3 // 2, width)
    planes = np.full(shape, 128, dtype=np.uint8)  # 128 is the chroma of gray
    luma = planes[0] if planes.ndim == 3 else planes[:height]
    for block in pieces(source, stream, spans):
        for t, frame in enumerate(block.frames, start=block.t):
            luma[:] = frame
            image = av.VideoFrame.from_ndarray(planes, format=kind)
            image.color_range = FULL_RANGE
            yield t, image


def pixel_format(shape: tuple[int, ...]) -> str:
    """Return yuv420p, which every player knows but which needs even sides, or else yuv444p."""
    return "yuv444p" if shape[0] % 2 or shape[1] % 2 else "yuv420p"
