"""`VideoCamera`: devices, network streams, videos and FFmpeg's test images, opened by PyAV."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.errors import CdmisfaError, UsageError, one_line
from cdmisfa.core.untrusted import BUDGET, budget
from recorder.cameras.live import Steady
from recorder.images.options import VIDEO_RECIPE
from recorder.images.pixels import MAX_PIXELS
from recorder.images.videos import frame_colors, frame_gray, most_pixels, pyav

# Seconds that opening or reading a network stream can take.
TIMEOUT: Final = 10.0

# Largest number of pixels by which FFmpeg pads width and height before it checks the size.
PADDED: Final = 64

# FFmpeg's flag AVFMT_NOTIMESTAMPS of formats without times, for which it invents times at 25 Hz.
_TIMELESS: Final = 0x80

_NETWORK: Final = re.compile(r"[a-z][a-z0-9+]+://", re.IGNORECASE)
_SECRET: Final = re.compile(r"(?<=://)[^/@]*@")


class VideoCamera:
    """A device, a network stream or a file that PyAV opens.

    Images are delivered no earlier than their presentation times, so that a file plays at its own
    speed. A network stream in a format without times, such as MJPEG, states no rate, and its images
    count as taken when they arrive.

    Args:
        word: `camera:DEVICE`, `av:FORMAT:ADDRESS`, `av:ADDRESS`, or a URL.
        name: name of the stream.
        color: True to decode colors.

    Raises:
        UsageError: the device does not exist.
    """

    recipe = VIDEO_RECIPE

    def __init__(self, word: str, name: str, *, color: bool = False) -> None:
        self.name = name
        self.rate: float | None = None
        self._av = pyav()
        self._public_word = _SECRET.sub("", word)
        self._form: str | None = None
        self._address = word
        head, _, rest = word.partition(":")
        form, _, address = rest.partition(":")
        if head == "camera":
            if not Path(rest).exists():
                raise UsageError(f"{rest}: this device does not exist")
            self._form, self._address = "v4l2" if rest.startswith("/dev/video") else None, rest
        elif head == "av":
            stated = address and not address.startswith("//") and form in self._av.formats_available
            self._form, self._address = (form, address) if stated else (None, rest)
        self._remote = _NETWORK.match(self._address) is not None
        # A path in /dev/shm is a regular file.
        device = self._address.startswith("/dev/") and not Path(self._address).is_file()
        self.finite = not self._remote and not device
        self._convert = frame_colors if color else frame_gray

    def images(self) -> Iterator[tuple[int, ByteArray]]:
        """Open the camera, and yield its images; see `Camera`."""
        with self._open() as container:
            if not container.streams.video:
                raise CdmisfaError(f"{self._public_word} has no video: name another source")
            video = container.streams.video[0]
            context = video.codec_context
            self._check_size(context, context.codec)
            padded = (context.width + PADDED) * (context.height + PADDED)
            limit = max(most_pixels(context.format, context.codec), padded)
            context.options = {"max_pixels": str(limit)}
            context.thread_count = 1  # each camera has a thread of its own already
            timed = not (self._remote and container.format.flags & _TIMELESS)
            stated = timed and (video.average_rate or video.guessed_rate)
            self.rate = float(stated) if stated else None
            steady, start = Steady(), None
            try:
                for frame in container.decode(video):
                    self._check_size(frame, context.codec)
                    presented = frame.time if timed else None
                    if presented is not None and not self._remote:
                        now = time.monotonic()
                        start = now - presented if start is None else start
                        time.sleep(max(start + presented - now, 0))
                    yield steady.age(time.monotonic(), presented), self._convert(frame)
            except (OSError, ValueError, self._av.FFmpegError) as error:
                raise CdmisfaError(f"{self.name} is lost: {_reason(error)}") from None

    def describe(self) -> Mapping[str, Any]:
        """Return the word that names the camera, without a password."""
        return {"camera": self._public_word}

    def _open(self) -> Any:
        """Open the container within the memory budget; decoding runs in threads, without it."""
        options = {"max_pixels": str(2 * MAX_PIXELS)}  # twice, because a decoder may pad images
        if self._address.startswith("rtsp"):
            options["rtsp_transport"] = "tcp"
        if self._remote:
            options["fflags"] = "nobuffer"
        timeout = TIMEOUT if self._remote else None
        try:
            with budget():
                opening = {"format": self._form, "options": options, "timeout": timeout}
                return self._av.open(self._address, **opening)
        except (OSError, ValueError, MemoryError, self._av.FFmpegError) as error:
            raise CdmisfaError(f"{self._public_word} cannot be opened: {_reason(error)}") from None

    def _check_size(self, image: Any, codec: Any) -> None:
        """Check that images do not take too much memory, by width, height and format."""
        limit = most_pixels(image.format, codec)
        if not 0 < image.width * image.height <= limit:
            raise CdmisfaError(
                f"{self._public_word}: images of {image.width}x{image.height}: live images of this "
                f"kind can have 1 to {limit} pixels"
            )


def _reason(error: Exception) -> str:
    """Return the text of an FFmpeg error without the address, which can contain a password."""
    if isinstance(error, MemoryError):
        return f"it takes more than {BUDGET >> 20} MiB of memory, the limit"
    if type(error).__name__ == "ExitError":  # FFmpeg's error for a read that timed out
        return "it did not answer in time"
    return str(getattr(error, "strerror", None) or _SECRET.sub("", one_line(error)))
