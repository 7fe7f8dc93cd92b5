"""Frames of recordings and logs in pieces, as PNG files, and as videos: H.264 in MP4, by PyAV.

Gray values become luma at its full range, so that a decoder returns the values that were encoded.
Colors become BT.601, and stay red, green and blue with `lossless`, which loses nothing.
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
from numpy.typing import NDArray
from PIL import Image

from cdmisfa.core.blocks import Block
from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.names import stream_names
from recorder.images.videos import pyav
from replay.logs.clock import intersection
from replay.logs.source import LoggedSource
from replay.stored_source import Span

# Most frames and bytes in memory at once, unless one frame is larger.
PIECE, PIECE_BYTES = 1000, 8 * 2**20

# x264's quality at which a difference is hardly visible.
LOSSY = {"crf": "18", "preset": "superfast"}

# x264's lossless mode.
EXACT = {"qp": "0", "preset": "ultrafast"}

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
    """Return the spans of frames without gaps in any stream of images, or of numbers.

    Raises:
        UsageError: the streams have no common frame.
    """
    shapes = [shape for shape, _ in map(source.spec.kind, range(len(source.spec.streams)))]
    streams = [i for i, shape in enumerate(shapes) if len(shape) > 1] or range(len(shapes))
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
            for t, image in enumerate(images_of(source, stream, block), start=block.t):
                pixels = image if image.shape[2] == 3 else image[:, :, 0]
                Image.fromarray(pixels).save(folder / name / f"{t:08d}.png")
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
    stats: Sequence[Any] = (),
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
        stats: for each of the spans an object whose `add` gets its images.

    Raises:
        UsageError: PyAV is not installed.
        CdmisfaError: the file cannot be written.
    """
    av, spec, count = pyav(), source.spec, 0
    shape = image_shape(source, stream)
    first = source.first_frame if spans is None else spans[0][0]
    comment = {
        "view": spec.streams[stream],
        "first_frame": first,
        "first_time_ns": spec.time_ns(first),
        **source.scene(),
    }
    rate = Fraction(spec.fps).limit_denominator(1001)
    kind = pixel_format(shape, lossless=lossless)
    options = (EXACT if lossless else LOSSY) | ({"g": str(KEY_EVERY)} if spans else {})
    try:
        with av.open(str(file), "w", format="mp4") as container:
            container.metadata["comment"] = json.dumps(comment)
            codec = "libx264rgb" if kind == "gbrp" else "libx264"
            video = container.add_stream(codec, rate=rate, options=options)
            video.height, video.width = shape[:2]
            video.pix_fmt = "rgb24" if kind == "gbrp" else kind
            video.max_b_frames = 0  # the file's order is the order of display
            if shape[2] == 1:
                video.codec_context.color_range = FULL_RANGE
            for number, span in enumerate(_spans(source, stream) if spans is None else spans):
                for block in pieces(source, stream, [span]):
                    images = images_of(source, stream, block)
                    if stats:
                        stats[number].add(images)
                    for t, image in enumerate(_video_frames(av, images, kind), start=block.t):
                        image.pts = t - first if spans is None else count
                        image.time_base = 1 / rate
                        container.mux(video.encode(image))
                        count += 1
            container.mux(video.encode(None))
    except (OSError, ValueError, av.FFmpegError) as error:
        raise CdmisfaError(f"{file} cannot be written: {error}") from error
    return count


def _video_frames(av: Any, images: NDArray[Any], kind: str) -> Iterator[Any]:
    """Yield images (n, height, width, 1 or 3) as PyAV's frames; gray ones in one buffer."""
    height, width, channels = images.shape[1:]
    if channels == 3:
        yield from (av.VideoFrame.from_ndarray(image, format="rgb24") for image in images)
        return
    shape = (3, height, width) if kind == "yuv444p" else (height * 3 // 2, width)
    planes = np.full(shape, 128, dtype=np.uint8)  # 128 is the chroma of gray
    luma = planes[0] if planes.ndim == 3 else planes[:height]
    for image in images:
        luma[:] = image[:, :, 0]
        frame = av.VideoFrame.from_ndarray(planes, format=kind)
        frame.color_range = FULL_RANGE
        yield frame


def images_of(source: LoggedSource, stream: int, block: Block) -> NDArray[Any]:
    """Return the images (n, height, width, 1 or 3) of a block, which a recording has in planes."""
    height, width, channels = image_shape(source, stream)
    planes = block.frames.reshape(len(block), height, channels, width).transpose(0, 1, 3, 2)
    return planes if source.recorded else block.frames


def image_shape(source: LoggedSource, stream: int) -> tuple[int, int, int]:
    """Return height, width and channels of the images that a stream shows."""
    height, width, *channels = source.spec.kind(stream)[0]
    if channels:
        return height, width, channels[0]
    color = "color" in source.origin()
    return (height, width // 3, 3) if color else (height, width, 1)


def pixel_format(shape: tuple[int, int, int], *, lossless: bool) -> str:
    """Return yuv420p, which every player knows but which needs even sides, else one that fits."""
    if lossless and shape[2] == 3:
        return "gbrp"
    return "yuv444p" if shape[0] % 2 or shape[1] % 2 else "yuv420p"
