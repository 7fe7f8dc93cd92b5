"""Pictures in a folder, or in a video file, as a stream of images.

Videos are decoded through PyAV, FFmpeg, on one thread.
"""

from __future__ import annotations

import contextlib
import re
from array import array
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.core.untrusted import check_regular, data_bytes, read_regular
from recorder.images.compressed import check_png, compressed_image
from recorder.images.options import VIDEO_RECIPE
from recorder.images.pixels import MAX_PIXELS, MalformedImage
from recorder.images.videos import frame_colors, frame_gray, pyav
from recorder.mcap.records import MalformedRecord, Problem
from replay.camera_logs.containers import extent_of
from replay.camera_logs.stream import ImageStream, UnreadableError, begun, explained, sorted_times

PICTURES: Final = (".jpeg", ".jpg", ".png")

MAX_PICTURE: Final = 64 * 1024 * 1024
"""Largest file that is read as a picture."""


VIDEOS: Final = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".webm", ".wmv")
_UNTIMED: Final = ("avi", "asf")
_UNSURE: Final = ("mpeg", "mpegts")
"""Containers without an index, in which FFmpeg may find a place behind the one that is sought."""

_BEGIN: Final = -(2**40)
_NOWHERE: Final = 2**62
_FORWARD: Final = 256
"""Frames that are decoded and passed over rather than sought."""


class FolderImages(ImageStream):
    """The pictures of a folder, in the order of their names, numbers by value."""

    def __init__(self, path: Path, topic: str | None, *, color: bool = False) -> None:
        self.path, self._color = path, color
        self.topic = path.resolve().name
        if topic not in (None, self.topic):
            raise UsageError(f"{path}: a folder of pictures has no topics, leave {topic} out")
        self._files = sorted(
            (p for p in path.iterdir() if p.suffix.lower() in PICTURES), key=by_number
        )
        for file in self._files:
            check_regular(file, MAX_PICTURE)
        self.encoding = " ".join(sorted({p.suffix.lower()[1:] for p in self._files}))
        if self.encoding != "png":
            self.remarks = [f"{path}: a JPEG has no checksums, damaged pixels may go unnoticed"]
        self.times = np.empty(0, np.uint64)

    @property
    def count(self) -> int:
        return len(self._files)

    def begin(self, row: int, threads: Executor) -> Future[ByteArray] | None:
        try:
            data = read_regular(self._files[row], MAX_PICTURE)
        except CdmisfaError:
            return None
        return begun(threads, data, color=self._color)

    def image(self, row: int) -> ByteArray:
        try:
            data = read_regular(self._files[row], MAX_PICTURE)
        except UsageError as error:
            raise LogDamagedError(f"it was a picture when it was found: {error}") from None
        return compressed_image(data, color=self._color)

    def where(self, row: int) -> str:
        return str(self._files[row])

    def broken(self, most: int) -> list[Problem] | None:
        """Check the checksums of PNGs, without decoding any.

        Args:
            most: bytes that are read.

        Returns:
            What is wrong; None where there are pictures without checksums, or more bytes.

        Raises:
            LogDamagedError: the disk does not give a file.
        """
        if self.encoding != "png" or sum(file.stat().st_size for file in self._files) > most:
            return None
        found = []
        for file in self._files:
            try:
                if not check_png(read_regular(file, MAX_PICTURE)):
                    return None
            except MalformedImage as error:
                found.append(Problem(str(file), str(error)))
        return found


def by_number(path: Path) -> list[tuple[int, str]]:
    """Sort key that puts 9.png before 10.png."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(p) if p.isdecimal() else -1, p) for p in parts]


class VideoImages(ImageStream):
    """The frames of a video's first stream, at its presentation times.

    Raises:
        UsageError: PyAV is missing, it is no topic of the file, or its frames have no times.
        LogDamagedError: it is no video, or a broken one.
    """

    recipe = VIDEO_RECIPE

    def __init__(self, path: Path, topic: str | None, *, color: bool = False) -> None:
        self.path = path
        self._shown = frame_colors if color else frame_gray
        self.topic = path.stem
        self._av = pyav(f"{path} is a video, which")
        self._next = _NOWHERE
        self._cut = _NOWHERE  # time of the last frame of a file that was cut, which may be a part
        self._frames: Iterator[Any] = iter(())
        self._container: Any = None
        if topic not in (None, self.topic):
            raise UsageError(f"{path}: a video has no topics, leave {topic} out")
        extent = extent_of(path)
        self.missing = extent.missing
        try:
            before = data_bytes()
            with explained(path, "FFmpeg"):
                self._container = self._av.open(str(path))
                self._open()
            self._held = data_bytes() - before
        except UnreadableError:
            self.close()
            if not self.missing:
                raise
            raise LogDamagedError(f"{path}: cut short: {self.missing}") from None
        except BaseException:
            self.close()
            raise
        remarks = ["a video has no checksums, damaged pixels may go unnoticed"]
        said = [self.missing] if self.missing else []
        if not self.missing and not extent.stated:
            remarks.append("it does not state where it ends, a missing end would go unnoticed")
        last, stated = int(self.times[-1]) / NANOSECONDS, self._stated_seconds
        if stated > last + 1:
            said.append(f"it states {stated:g} s, its last frame is at {last:g} s")
        self.warnings = [f"{path}: {line}" for line in said]
        self.remarks = [f"{path}: {line}" for line in remarks]

    def image(self, row: int) -> ByteArray:
        stamp = int(self._stamps[row])
        with explained(self.path, "FFmpeg", held=self._held):
            found, at, self._next = None, self._next, _NOWHERE
            if at <= row < at + _FORWARD:
                with contextlib.suppress(self._av.FFmpegError):  # of a frame that this needs not
                    found = self._forward(row)
            if found is None:
                try:
                    found = self._from(stamp, row)
                except self._av.FFmpegError:
                    if not self._unsure:
                        raise
            if found is None and self._unsure:
                found = self._from(_BEGIN, row)
            if found is None:
                raise MalformedRecord("the video is broken, no frame can be decoded")
            self._next = row + 1
            return self._shown(found)

    def _waits(self) -> bool:
        """Whether a container without times holds pictures that wait for later ones (B-frames)."""
        context, form = self._stream.codec_context, self._container.format.name
        return form in _UNTIMED and context.name in ("h264", "hevc") and context.has_b_frames

    def _untimed(self) -> UsageError:
        return UsageError(
            f"{self.path}: its frames have no times; copy it into an .mp4 file with some "
            "(ffmpeg -fflags +genpts -i ... -c copy)"
        )

    def _decoded(self) -> Iterator[Any]:
        for packet in self._container.demux(self._stream):
            if packet.pts != self._cut:
                yield from packet.decode()

    def _from(self, place: int, row: int) -> Any:
        """Decode a frame from the whole picture before a place on; see `_forward`."""
        self._container.seek(place, stream=self._stream, backward=True)
        self._frames = self._decoded()
        return self._forward(row)

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
        found = self._container.streams.video
        if not found or found[0].codec_context is None:
            raise LogDamagedError(f"{self.path}: there is no video in it")
        self._stream = stream = found[0]
        stream.thread_type = "NONE"
        stream.codec_context.thread_count = 1
        stream.codec_context.options = {"err_detect": "explode"}  # rather than made up pixels
        pixels = stream.codec_context.width * stream.codec_context.height
        if not 0 < pixels <= MAX_PIXELS:
            raise LogDamagedError(f"{self.path}: images of {pixels} pixels are not read")
        self.encoding = str(stream.codec_context.name)
        self._unsure = self._container.format.name in _UNSURE
        self._tick = Fraction(stream.time_base)
        stamps = array("q")
        for packet in self._container.demux(stream):
            if packet.size == 0 or packet.is_discard:
                continue
            if packet.pts is None:
                raise self._untimed()
            stamps.append(packet.pts)
        if self._waits() and (np.diff(stamps) >= 0).all():
            raise self._untimed()
        if self.missing and stamps:
            self._cut = stamps.pop()
        if not stamps:
            why = f", cut short: {self.missing}" if self.missing else ""
            raise LogDamagedError(f"{self.path}: there is no frame in it{why}")
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
