"""Videos, decoded through PyAV (FFmpeg) on one thread."""

from __future__ import annotations

import contextlib
from array import array
from collections.abc import Iterator
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.untrusted import data_bytes
from recorder.images.options import VIDEO_RECIPE, InputOptions
from recorder.images.pixels import MAX_PIXELS
from recorder.images.videos import frame_colors, frame_gray, pyav
from recorder.mcap.records import MalformedRecord
from replay.logs.formats.containers import extent_of
from replay.logs.formats.messages import check_topics
from replay.logs.stream import LogStream, UnreadableError, limited

ENDINGS: Final = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".webm", ".wmv")
_UNTIMED: Final = ("avi", "asf")

# Containers without an index, in which a seek of FFmpeg may end after the requested time.
_UNSURE: Final = ("mpeg", "mpegts")

_BEGIN: Final = -(2**40)
_NOWHERE: Final = 2**62

# Frames ahead that are decoded and dropped, as seeking to the next key frame would take longer.
_FORWARD: Final = 256


def streams(
    path: Path, options: InputOptions, opened: ExitStack, *, skip_damaged: bool = False
) -> list[LogStream]:
    """Open the frames of a video's first stream, at its presentation times.

    Raises:
        UsageError: PyAV is missing, or its frames have no times.
        LogDamagedError: the file is not a video, or is damaged.
    """
    check_topics(path, path.stem, options.topics)
    video = VideoFile(path, options.color is True)
    opened.callback(video.close)
    stream = LogStream(
        path=path,
        topic=path.stem,
        count=len(video.times),
        times=video.times,
        decode=video.image,
        memory_bytes=lambda: video.memory_bytes,
        program="FFmpeg",
        where=lambda row: f"{path}: at {float(int(video.stamps[row]) * video.tick):g} s",
        encoding=video.encoding,
        recipe=VIDEO_RECIPE,
        warnings=[f"{path}: {line}" for line in video.warnings],
        remarks=[f"{path}: {line}" for line in video.remarks],
        missing=video.missing,
    )
    return [stream]


class VideoFile:
    """The frames of a video by their number.

    Attributes:
        times: (n,) presentation times, nanoseconds.
        stamps: (n,) the same, in ticks.
        tick: length of a tick, in seconds.
        memory_bytes: bytes of memory that the open file takes.
        encoding: name of the codec.
        missing: the missing part of a truncated file, or "".
        warnings: a line for each thing that it lacks.
        remarks: a line for each thing that nothing proves.
    """

    def __init__(self, path: Path, color: bool = False) -> None:
        self.path = path
        self._to_pixels = frame_colors if color else frame_gray
        self._av = pyav()
        self._next = _NOWHERE
        self._cut = _NOWHERE  # time of the last frame of a file that was cut, which may be a part
        self._frames: Iterator[Any] = iter(())
        self._container: Any = None
        extent = extent_of(path)
        self.missing = extent.missing
        before = data_bytes()
        try:
            with limited(path, "FFmpeg"):
                self._container = self._av.open(str(path))
                self._open()
        except BaseException as error:
            self.close()
            if isinstance(error, UnreadableError) and self.missing:
                raise LogDamagedError(f"{path}: cut short: {self.missing}") from None
            raise
        self.memory_bytes = data_bytes() - before
        self.warnings = [self.missing] if self.missing else []
        if (tracks := len(self._container.streams.video)) > 1:
            self.warnings.append(f"it has {tracks} video tracks: only the first is read")
        self.remarks = ["a video has no checksums, so damaged pixels may be undetected"]
        if not self.missing and not extent.stated:
            self.remarks.append("it does not state its length, so a missing end cannot be detected")
        last = int(self.times[-1]) / NANOSECONDS
        stated = (self._container.duration or 0) / self._av.time_base
        if stated > last + 1:
            self.warnings.append(
                f"its stated length is {stated:g} s, but its last frame is at {last:g} s"
            )

    def _open(self) -> None:
        """Find the times of all frames, without decoding one."""
        videos = self._container.streams.video
        if not videos or videos[0].codec_context is None:
            raise LogDamagedError(f"{self.path}: the file has no video stream")
        self._stream = stream = videos[0]
        stream.thread_type = "NONE"
        context = stream.codec_context
        context.thread_count = 1
        # Else FFmpeg conceals errors with invented pixels.
        context.options = {"err_detect": "explode"}
        if not 0 < context.width * context.height <= MAX_PIXELS:
            size = f"{context.width}x{context.height}"
            raise LogDamagedError(f"{self.path}: images of {size} pixels are not supported")
        self.encoding = str(context.name)
        container = self._container.format.name
        self._unsure = container in _UNSURE
        self.tick = Fraction(stream.time_base)
        stamps = array("q")
        timed = True
        for packet in self._container.demux(stream):
            if packet.size and not packet.is_discard:
                timed &= packet.pts is not None
                stamps.append(packet.pts or 0)
        # A container without times may have B-frames, which are not stored in order of display.
        waits = container in _UNTIMED and context.name in ("h264", "hevc") and context.has_b_frames
        if not timed or (waits and (np.diff(stamps) >= 0).all()):
            raise UsageError(
                f"{self.path}: its frames have no times; add them with "
                "ffmpeg -fflags +genpts -i INPUT -c copy OUTPUT.mp4"
            )
        if self.missing and stamps:
            self._cut = stamps.pop()
        if not stamps:
            why = f", cut short: {self.missing}" if self.missing else ""
            raise LogDamagedError(f"{self.path}: the video has no frames{why}")
        self.stamps = np.sort(np.array(stamps, np.int64))
        if (np.diff(self.stamps) == 0).any():
            raise LogDamagedError(f"{self.path}: two frames have the same time")
        # From the video's beginning, or its first frame if that is before.
        first = min(int(self.stamps[0]), 0)
        exact = (round((int(stamp) - first) * self.tick * NANOSECONDS) for stamp in self.stamps)
        self.times = np.fromiter(exact, np.int64, len(self.stamps))
        self._container.seek(0, stream=stream, backward=True)

    def image(self, row: int) -> ByteArray:
        """Decode a frame; a `MalformedRecord` if it is broken, and FFmpeg's own errors."""
        stamp = int(self.stamps[row])
        frame, at, self._next = None, self._next, _NOWHERE
        if at <= row < at + _FORWARD:
            with contextlib.suppress(self._av.FFmpegError):  # of a frame that this does not need
                frame = self._forward(stamp)
        if frame is None:
            try:
                frame = self._from(stamp, stamp)
            except self._av.FFmpegError:
                if not self._unsure:
                    raise
        if frame is None and self._unsure:
            frame = self._from(_BEGIN, stamp)
        if frame is None:
            raise MalformedRecord("the video is broken, no frame can be decoded")
        self._next = row + 1
        return self._to_pixels(frame)

    def _decoded(self) -> Iterator[Any]:
        for packet in self._container.demux(self._stream):
            if packet.pts != self._cut:
                yield from packet.decode()

    def _from(self, place: int, stamp: int) -> Any:
        """Decode a frame from the whole image before a place on; see `_forward`."""
        self._container.seek(place, stream=self._stream, backward=True)
        self._frames = self._decoded()
        return self._forward(stamp)

    def _forward(self, stamp: int) -> Any:
        """Decode on to a frame; None if it is broken or not there."""
        frame = next((f for f in self._frames if f.pts is None or f.pts >= stamp), None)
        return None if frame is None or frame.pts != stamp or frame.is_corrupt else frame

    def close(self) -> None:
        """Close the file; harmless when called twice."""
        container, self._container = self._container, None
        self._frames = iter(())
        if container is not None:
            container.close()
