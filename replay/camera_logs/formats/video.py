"""A video file as a stream of images, through PyAV: FFmpeg on one thread.

Grey is the luma that a video stores, so that no colour conversion of FFmpeg, whose bits depend
on the processor, comes between; only videos without luma are taken by their colours.
"""

from __future__ import annotations

import contextlib
from array import array
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.untrusted.memory import data_bytes
from recorder.images.pixels import MAX_PIXELS
from recorder.images.videos import VIDEO_RECIPE, frame_colors, frame_gray, pyav
from recorder.mcap.records import MalformedRecord
from replay.camera_logs.stream import ImageStream, explained, sorted_times

VIDEOS: Final = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".webm", ".wmv")
_NOWHERE: Final = 2**62
_FORWARD: Final = 256
"""Frames that are decoded and passed over rather than sought."""


class VideoImages(ImageStream):
    """The frames of a video's first stream, at its presentation times.

    Raises:
        UsageError: PyAV is missing, or it is no topic of the file.
        LogDamagedError: it is no video, or a broken one.
    """

    recipe = VIDEO_RECIPE

    def __init__(self, path: Path, topic: str | None, *, color: bool = False) -> None:
        self.path = path
        self._shown = frame_colors if color else frame_gray
        self.topic = path.stem
        self._av = pyav(f"{path} is a video, which")
        self._next = _NOWHERE
        self._frames: Iterator[Any] = iter(())
        self._container: Any = None
        if topic not in (None, self.topic):
            raise UsageError(f"{path}: a video has no topics, leave {topic} out")
        try:
            before = data_bytes()
            with explained(path, "FFmpeg"):
                self._container = self._av.open(str(path))
                self._open()
            self._held = data_bytes() - before
        except BaseException:
            self.close()
            raise
        unsure = f"{path}: a video has no checksums, damaged pixels may go unnoticed"
        last, stated = int(self.times[-1]) / NANOSECONDS, self._stated_seconds
        short = f"{path}: it states {stated:g} s, its last frame is at {last:g} s"
        self.warnings = [unsure, short] if stated > last + 1 else [unsure]

    def image(self, row: int) -> ByteArray:
        stamp = int(self._stamps[row])
        with explained(self.path, "FFmpeg", held=self._held):
            found, at, self._next = None, self._next, _NOWHERE
            if at <= row < at + _FORWARD:
                with contextlib.suppress(self._av.FFmpegError):  # of a frame that this needs not
                    found = self._forward(row)
            if found is None:
                self._container.seek(stamp, stream=self._stream, backward=True)
                self._frames = self._container.decode(self._stream)
                found = self._forward(row)
            if found is None:
                raise MalformedRecord("the video is broken, no frame can be decoded")
            self._next = row + 1
            return self._shown(found)

    def _forward(self, row: int) -> Any:
        """Decode on to a frame; None if it is broken or not there."""
        stamp = int(self._stamps[row])
        found = next((f for f in self._frames if f.pts is None or f.pts >= stamp), None)
        return None if found is None or found.pts != stamp or found.is_corrupt else found

    def where(self, row: int) -> str:
        return f"{self.path}: at {float(int(self._stamps[row]) * self._tick):g} s"

    def close(self) -> None:
        container, self._container = self._container, None
        self._frames = iter(())
        if container is not None:
            container.close()

    def _open(self) -> None:
        """Find the times of all frames, without decoding one."""
        if not self._container.streams.video:
            raise LogDamagedError(f"{self.path}: there is no video in it")
        self._stream = stream = self._container.streams.video[0]
        stream.thread_type = "NONE"
        stream.codec_context.thread_count = 1
        stream.codec_context.options = {"err_detect": "explode"}  # rather than made up pixels
        pixels = stream.codec_context.width * stream.codec_context.height
        if not 0 < pixels <= MAX_PIXELS:
            raise LogDamagedError(f"{self.path}: images of {pixels} pixels are not read")
        self.encoding = str(stream.codec_context.name)
        self._tick = Fraction(stream.time_base)
        stamps = array("q")
        packets = 0
        for packet in self._container.demux(stream):
            packets += packet.size > 0
            if packet.size == 0 or packet.is_discard:
                continue
            if packet.pts is None:
                raise LogDamagedError(
                    f"{self.path}: its frames have no times; copy it into an .mp4 or .mkv file"
                )
            stamps.append(packet.pts)
        if not stamps:
            raise LogDamagedError(f"{self.path}: there is no frame in it")
        if stream.frames not in (0, packets):
            raise LogDamagedError(
                f"{self.path}: it states {stream.frames} frames, {packets} are there"
            )
        self._stamps = np.sort(np.array(stamps, np.int64))
        if (np.diff(self._stamps) == 0).any():
            raise LogDamagedError(f"{self.path}: two of its frames have the same time")
        self._stated_seconds = (self._container.duration or 0) / self._av.time_base
        # From the video's beginning, or its first frame if that is before.
        first = min(int(self._stamps[0]), 0)
        exact = (round((int(stamp) - first) * self._tick * NANOSECONDS) for stamp in self._stamps)
        nanoseconds = np.fromiter(exact, np.int64, len(self._stamps))
        self.times = sorted_times(f"{self.path}: it", nanoseconds)
        self._container.seek(0, stream=stream, backward=True)
