"""Videos of which each message holds one picture, decoded one after another through PyAV."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, Final, NamedTuple

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.errors import UsageError
from cdmisfa.core.untrusted.memory import BUDGET
from recorder.images.frames import frame_colors, frame_gray
from recorder.images.pixels import MAX_PIXELS, MalformedImage

HELD: Final = 17
"""Pictures that a decoder holds at most, where they are made from one another: 16 and its own."""

_UNIT: Final = re.compile(b"\0\0\1(.)", re.DOTALL)
"""Where a unit of H.264 or H.265 begins, and the first byte of its header."""

_H264_WHOLE: Final = 5
_H265_WHOLE: Final = range(16, 24)
_AV1_SEQUENCE: Final = 1


class Packet(NamedTuple):
    """What a message holds of a video.

    Attributes:
        data: one picture, as its codec has it.
        codec: as the message names it.
    """

    data: bytes
    codec: str


class VideoPackets:
    """The decoder of messages that hold one picture of a video each, called with them in order.

    Most pictures need those before them, back to one that `begins`.

    Args:
        opened: what a message holds; raises MalformedImage.
        color: give the colours; see `raw_image`.
    """

    def __init__(
        self, opened: Callable[[bytes | memoryview], Packet], *, color: bool = False
    ) -> None:
        self._opened = opened
        self._shown = frame_colors if color else frame_gray
        self._codec = ""
        self._context: Any = None

    def begins(self, message: bytes | memoryview) -> bool:
        """Whether the picture of a message needs none before it.

        Raises:
            MalformedImage: it is no such message, or of no codec that is read.
        """
        packet = self._opened(message)
        return bool(packet.data) and _BEGINS[_codec(packet.codec)](packet.data)

    def forget(self) -> None:
        """Be told that the next message does not follow the last."""
        if self._context is not None:
            self._context.flush_buffers()

    def __call__(self, message: bytes | memoryview) -> ByteArray:
        """The picture of the next message, (height, width) uint8, or its colours.

        Raises:
            MalformedImage: it cannot be decoded, or by itself shows no picture.
            UsageError: PyAV is missing, or its pictures wait for later ones.
        """
        packet = self._opened(message)
        if not packet.data:
            raise MalformedImage("its message is empty, without a picture of its video")
        av = pyav("a video in messages")
        context = self._of(_codec(packet.codec), av)
        try:
            frames = context.decode(av.Packet(packet.data))
        except (OSError, ValueError, av.FFmpegError) as error:
            raise MalformedImage(f"its video is broken there ({type(error).__name__})") from None
        if not frames and context.has_b_frames:
            raise UsageError(
                "a picture of its video waits for later ones (B-frames), which messages of one "
                "picture each rule out: encode it without them, or take it as an .mp4 file"
            )
        if len(frames) > 1:
            raise MalformedImage(f"its message holds {len(frames)} pictures of its video, not 1")
        if not frames or frames[0].is_corrupt:
            raise MalformedImage("a picture of its video is broken there, or one that it needs")
        return self._shown(frames[0])

    def _of(self, codec: str, av: Any) -> Any:
        if codec != self._codec:
            context = av.CodecContext.create(codec, "r")
            context.thread_count = 1
            most = most_pixels(None, context.codec)
            context.options = {"err_detect": "explode", "max_pixels": str(most)}
            self._codec, self._context = codec, context
        return self._context


def most_pixels(form: Any, codec: Any) -> int:
    """Most pixels of a picture, so that those its decoder holds fit into the budget.

    Args:
        form: PyAV's format of its pixels; None where it is not known yet.
        codec: PyAV's codec.
    """
    held = 1 if codec.intra_only else HELD
    bits = form.padded_bits_per_pixel if form is not None else 8
    return min(MAX_PIXELS, BUDGET * 8 // (held * bits))


def pyav(what: str) -> Any:
    """PyAV.

    Raises:
        UsageError: it is missing.
    """
    try:
        import av
    except ImportError:
        raise UsageError(f"{what} needs PyAV: pip install 'cdmisfa[video]'") from None
    av.logging.set_level(None)
    return av


def _codec(named: str) -> str:
    """FFmpeg's name of a codec, by that of the message, as h265 or hevc_nvenc;yuv420p."""
    name = named.partition(";")[0].lower()
    for part, codec in _NAMES.items():
        if part in name:
            return codec
    raise MalformedImage(f"a video in {named!r} is not read: h264, h265, vp9 and av1 are")


def _begins_h264(data: bytes) -> bool:
    return any(unit[1][0] & 31 == _H264_WHOLE for unit in _UNIT.finditer(data))


def _begins_h265(data: bytes) -> bool:
    return any(unit[1][0] >> 1 & 63 in _H265_WHOLE for unit in _UNIT.finditer(data))


def _begins_vp9(data: bytes) -> bool:
    head = data[0]
    if head >> 6 != 2:
        return False
    last = 1 if head >> 4 & 3 == 3 else 2  # the fourth profile has a bit more
    return head >> last & 3 == 0  # no frame shown again, and none that changes others


def _begins_av1(data: bytes) -> bool:
    at = 0
    while at < len(data):
        kind, longer, sized = data[at] >> 3 & 15, data[at] >> 2 & 1, data[at] >> 1 & 1
        if kind == _AV1_SEQUENCE:
            return True
        at += 1 + longer
        if not sized:
            return False
        size, shift = 0, 0
        while at < len(data) and shift < 56:
            size |= (data[at] & 127) << shift
            shift, at = shift + 7, at + 1
            if not data[at - 1] & 128:
                break
        at += size
    return False


_NAMES: Final = {"264": "h264", "265": "hevc", "hevc": "hevc", "vp9": "vp9", "av1": "libdav1d"}
_BEGINS: Final[dict[str, Callable[[bytes], bool]]] = {
    "h264": _begins_h264,
    "hevc": _begins_h265,
    "vp9": _begins_vp9,
    "libdav1d": _begins_av1,
}
"""Whether a picture needs none before it, by its codec."""
