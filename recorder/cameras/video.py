"""Whatever PyAV opens as a camera: devices, network streams, videos, FFmpeg's test pictures."""

from __future__ import annotations

import errno
import os
import re
import time
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import CdmisfaError, UsageError, one_line
from cdmisfa.core.untrusted import BUDGET, budget
from recorder.images.pixels import MAX_PIXELS
from recorder.images.videos import frame_colors, frame_gray, most_pixels, pyav

DRIFT: Final = 1e-3
"""Seconds a second by which a camera's clock may be slow."""

JUMP: Final = 1.0
"""Seconds by which presentation times differ from what is due where they begin anew."""

LATE: Final = 60
"""Frames in a row that come later than that before they are taken to begin anew."""

_TIMELESS: Final = 0x80
"""FFmpeg's flag of formats that hold no times (AVFMT_NOTIMESTAMPS): it makes some up, at 25 Hz."""

PADDED: Final = 64
"""Pixels by which FFmpeg makes a picture wider and higher at most before it judges its size."""

_NETWORK: Final = re.compile(r"[a-z][a-z0-9+]+://", re.IGNORECASE)
_SECRET: Final = re.compile(r"(?<=://)[^/@]*@")


class VideoCamera:
    """A device, a network stream or a file that PyAV opens.

    Its pictures come no earlier than their presentation times say, so that a file plays at its
    own pace. A network stream of a format without times, as MJPEG of a web camera, states no rate,
    and its pictures were taken when they come.

    Args:
        word: `camera:DEVICE`, `av:FORMAT:ADDRESS`, `av:ADDRESS`, or a URL.
        name: of the stream.
        timeout: seconds that opening and reading may take of a network stream.
        color: show its colours.

    Raises:
        UsageError: PyAV is missing, or the word names nothing.
    """

    def __init__(self, word: str, name: str, *, timeout: float, color: bool = False) -> None:
        self.name = name
        self.rate: float | None = None
        self._word, self._timeout = word, timeout
        self._av = pyav(word)
        self._form, self._address = _form_and_address(word, self._av.formats_available)
        self._remote = _NETWORK.match(self._address) is not None
        # what is in /dev/shm is a file
        device = self._address.startswith("/dev/") and not Path(self._address).is_file()
        self.finite = not self._remote and not device
        self._convert = frame_colors if color else frame_gray

    def pictures(self) -> Iterator[tuple[int, ByteArray]]:
        """See `Camera`."""
        with self._open() as container:
            if not container.streams.video:
                raise CdmisfaError(f"{self._shown_word}: there is no video in it")
            video = container.streams.video[0]
            context = video.codec_context
            self._check(context, context.codec)
            most = most_pixels(context.format, context.codec)
            padded = (context.width + PADDED) * (context.height + PADDED)
            context.options = {"max_pixels": str(max(most, padded))}
            context.thread_count = 1  # of several cameras, each has a thread
            timed = not (self._remote and container.format.flags & _TIMELESS)
            stated = timed and (video.average_rate or video.guessed_rate)
            self.rate = float(stated) if stated else None
            steady = Steady()
            try:
                for frame in container.decode(video):
                    self._check(frame, context.codec)
                    presented = frame.time if timed else None
                    early = steady.early(time.monotonic(), presented)
                    if early > 0 and not self._remote:
                        time.sleep(early)
                    yield steady.age(time.monotonic(), presented), self._convert(frame)
            except (OSError, ValueError, self._av.FFmpegError) as error:
                reason = _reason(error)
                if getattr(error, "errno", None) == errno.EINVAL:  # all that FFmpeg says of it
                    reason += f", as where pictures come to have more than {most} pixels"
                raise CdmisfaError(f"{self.name} is gone: {reason}") from None

    def describe(self) -> Mapping[str, Any]:
        """The word, without what may be a password."""
        return {"camera": self._shown_word}

    @property
    def _shown_word(self) -> str:
        return _SECRET.sub("", self._word)

    def _open(self) -> Any:
        """Open it within the memory budget; decoding runs beside other cameras, without one."""
        options = {"max_pixels": str(2 * MAX_PIXELS)}  # twice, as a decoder may pad a picture
        if self._address.startswith("rtsp"):
            options["rtsp_transport"] = "tcp"
        if self._remote:
            options["fflags"] = "nobuffer"
        try:
            with budget():
                return self._av.open(
                    self._address,
                    format=self._form,
                    options=options,
                    timeout=self._timeout if self._remote else None,
                )
        except (OSError, ValueError, MemoryError, self._av.FFmpegError) as error:
            reason = _reason(error)
            if isinstance(error, MemoryError):
                reason = f"it takes more than {BUDGET >> 20} MiB of memory, the limit"
            raise CdmisfaError(f"{self._shown_word} cannot be opened: {reason}") from None

    def _check(self, shown: Any, codec: Any) -> None:
        """Refuse pictures that take too much memory, by a stated width, height and format."""
        most = most_pixels(shown.format, codec)
        if not 0 < shown.width * shown.height <= most:
            raise CdmisfaError(
                f"{self._shown_word}: images of {shown.width}x{shown.height}, live ones of this "
                f"kind have 1 to {most} pixels"
            )


class Steady:
    """When frames were taken, from presentation times, which do not jitter as arrivals do.

    A frame that came with the least delay so far sets how the two clocks stand to one another;
    that least delay is forgotten slowly, as clocks drift.
    """

    def __init__(self) -> None:
        self._begun: float | None = None
        self._offset = 0.0
        self._last = 0.0
        self._late = 0

    def early(self, now: float, presented: float | None) -> float:
        """Seconds until a frame is due by the first one's coming; of a file, its own pace."""
        if presented is None:
            return 0.0
        if self._begun is None:
            self._begun = now - presented
        return self._begun + presented - now

    def age(self, now: float, presented: float | None) -> int:
        """Nanoseconds ago at which a frame was taken that is there now; both in seconds."""
        if presented is None:
            return 0
        delay = now - presented
        drifted = self._offset + DRIFT * (now - self._last)
        self._late = self._late + 1 if delay > self._offset + JUMP else 0
        anew = self._last == 0.0 or delay < self._offset - JUMP or self._late > LATE
        self._offset = delay if anew else min(delay, drifted)
        self._last = now
        return round((delay - self._offset) * NANOSECONDS)


def _form_and_address(word: str, formats: Collection[str]) -> tuple[str | None, str]:
    """FFmpeg's format for a word (None: to be found out), and its address."""
    head, _, rest = word.partition(":")
    if head not in ("camera", "av"):
        return None, word
    if not rest:
        raise UsageError(f"{word} names no device: write {head}:/dev/video0, as it is")
    if head == "camera":
        if not os.path.exists(rest):
            raise UsageError(f"{rest}: there is no such device")
        return "v4l2" if rest.startswith("/dev/video") else None, rest
    known, _, address = rest.partition(":")
    if address and not address.startswith("//") and known in formats:
        return known, address
    return None, rest


def _reason(error: Exception) -> str:
    """Text of an error of FFmpeg without the address, which may hold a password."""
    if type(error).__name__ == "ExitError":  # of FFmpeg's reads that took too long
        return "it did not answer in time"
    return str(getattr(error, "strerror", None) or _SECRET.sub("", one_line(error)))
