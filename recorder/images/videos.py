"""Pictures of videos, decoded by PyAV (FFmpeg), as gray or coloured images.

Gray is the luma that a video stores, so that no colour conversion of FFmpeg, whose bits depend
on the processor, comes between; only videos without luma are taken by their colours.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.errors import UsageError
from cdmisfa.core.untrusted import BUDGET
from recorder.images.pixels import MAX_PIXELS, MalformedImage, raw_image

HELD: Final = 17
"""Pictures that a decoder holds at most, where they are made from one another: 16 and its own."""

_FULL_RANGE: Final = 2
_LUMA: Final = ("yuv", "yuvj", "gray", "nv12", "nv21")
_STRETCH: Final = bytes((((np.arange(256) - 16) * 510 + 219) // 438).clip(0, 255).astype(np.uint8))
"""Luma of limited range as full range, a value for each byte."""

_BT709: Final = 1
_WEIGHTS: Final = {
    True: (1.5748, -0.187324, -0.468124, 1.8556),
    False: (1.402, -0.344136, -0.714136, 1.772),
}
"""Of BT.709 and BT.601: red by Cr, green by Cb and by Cr, blue by Cb."""

_UNIT: Final = re.compile(b"\0\0\1(.)", re.DOTALL)
"""Where a unit of H.264 or H.265 begins, and the first byte of its header."""


def frame_gray(frame: Any) -> ByteArray:
    """The luma of a picture of PyAV, or the gray of its colours, upright, (height, width) uint8."""
    return _upright(_luma(frame), frame)


def frame_colors(frame: Any) -> ByteArray:
    """The colours of a picture of PyAV, upright, (height, width, 3) uint8; else its luma."""
    return _upright(_colors(frame), frame)


def _upright(pixels: ByteArray, frame: Any) -> ByteArray:
    """Pixels turned by quarters, and mirrored, as the display matrix of their picture says.

    Source: FFmpeg's libavutil/display.h. A point (x, y) is shown at (a x + c y, b x + d y).
    """
    stated = frame.side_data.get("DISPLAYMATRIX")
    if stated is None:
        return pixels
    a, b, _, c, d = np.frombuffer(stated, np.int32)[:5].tolist()
    if abs(b) > abs(a):
        pixels = pixels.swapaxes(0, 1)
        right, down = c, b
    else:
        right, down = a, d
    return np.ascontiguousarray(pixels[:: -1 if down < 0 else 1, :: -1 if right < 0 else 1])


def _is_full(frame: Any) -> bool:
    stated = frame.color_range == _FULL_RANGE
    return bool(stated or frame.format.name.startswith(("yuvj", "gray")))


def _colors(frame: Any) -> ByteArray:
    form = frame.format
    if form.name.startswith("gray"):
        return _luma(frame)
    luma_first = form.name.startswith("yuv") and len(form.components) >= 3
    if not luma_first or form.components[0].bits != 8 or not form.is_planar:
        colours: ByteArray = frame.to_ndarray(format="rgb24")
        return colours
    luma = _luma(frame).astype(np.int32) << 16
    height, width = luma.shape
    chroma = []
    for plane in frame.planes[1:3]:
        values = raw_image(memoryview(plane), plane.height, plane.width, "mono8", plane.line_size)
        rows, columns = -(-height // plane.height), -(-width // plane.width)
        large = values.repeat(rows, axis=0).repeat(columns, axis=1)[:height, :width]
        chroma.append(large.astype(np.int32) - 128)
    scale = (1 if _is_full(frame) else 255 / 224) * 65536
    weights = (round(weight * scale) for weight in _WEIGHTS[frame.colorspace == _BT709])
    red, green_cb, green_cr, blue = weights
    cb, cr = chroma
    colors = (luma + red * cr, luma + green_cb * cb + green_cr * cr, luma + blue * cb)
    return np.stack([((c + 32768) >> 16).clip(0, 255).astype(np.uint8) for c in colors], axis=2)


def _luma(frame: Any) -> ByteArray:
    form = frame.format
    if not form.name.startswith(_LUMA) or form.components[0].bits != 8 or not form.is_planar:
        colours = frame.to_ndarray(format="rgb24")
        height, width = colours.shape[:2]
        return raw_image(colours.tobytes(), height, width, "rgb8")
    plane = frame.planes[0]
    luma = raw_image(memoryview(plane), frame.height, frame.width, "mono8", plane.line_size)
    if _is_full(frame):
        return luma
    return np.frombuffer(luma.tobytes().translate(_STRETCH), np.uint8).reshape(luma.shape)


class Packet(NamedTuple):
    """One picture of a video: its data, and the name of its codec as the message has it."""

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
        _, begins = _codec(packet.codec)
        return bool(packet.data) and begins(packet.data)

    def forget(self) -> None:
        """Reset the decoder: the next message does not follow the last."""
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
        name, _ = _codec(packet.codec)
        if name != self._codec:
            self._codec, self._context = name, av.CodecContext.create(name, "r")
            self._context.thread_count = 1
            most = most_pixels(None, self._context.codec)
            self._context.options = {"err_detect": "explode", "max_pixels": str(most)}
        try:
            frames = self._context.decode(av.Packet(packet.data))
        except (OSError, ValueError, av.FFmpegError) as error:
            raise MalformedImage(f"its video is broken there ({type(error).__name__})") from None
        if not frames and self._context.has_b_frames:
            raise UsageError(
                "a picture of its video waits for later ones (B-frames), which messages of one "
                "picture each rule out: encode it without them, or take it as an .mp4 file"
            )
        if len(frames) > 1:
            raise MalformedImage(f"its message holds {len(frames)} pictures of its video, not 1")
        if not frames or frames[0].is_corrupt:
            raise MalformedImage("a picture of its video is broken there, or one that it needs")
        return self._shown(frames[0])


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
    """Import PyAV.

    Raises:
        UsageError: it is missing.
    """
    try:
        import av
    except ImportError:
        raise UsageError(f"{what} needs PyAV: pip install 'cdmisfa[video]'") from None
    av.logging.set_level(None)
    return av


def _codec(named: str) -> tuple[str, Callable[[bytes], bool]]:
    """FFmpeg's name of a codec, by that of the message, as h265 or hevc_nvenc;yuv420p."""
    name = named.partition(";")[0].lower()
    for part, codec in _CODECS.items():
        if part in name:
            return codec
    raise MalformedImage(f"a video in {named!r} is not read: h264, h265, vp9 and av1 are")


def _begins_h264(data: bytes) -> bool:
    return any(unit[1][0] & 31 == 5 for unit in _UNIT.finditer(data))  # an IDR picture


def _begins_h265(data: bytes) -> bool:
    return any(16 <= unit[1][0] >> 1 & 63 < 24 for unit in _UNIT.finditer(data))  # an IRAP picture


def _begins_vp9(data: bytes) -> bool:
    head = data[0]
    last = 1 if head >> 4 & 3 == 3 else 2  # the fourth profile has a bit more
    # no frame shown again, and none that changes others
    return head >> 6 == 2 and head >> last & 3 == 0


def _begins_av1(data: bytes) -> bool:
    """Whether one of its units, before the first that states no size, is a sequence header."""
    at = 0
    while at < len(data):
        kind, longer, sized = data[at] >> 3 & 15, data[at] >> 2 & 1, data[at] >> 1 & 1
        if kind == 1:
            return True
        if not sized:
            return False
        at += 1 + longer
        size = shift = 0
        more = True
        while more and at < len(data) and shift < 56:
            size |= (data[at] & 127) << shift
            more = data[at] > 127
            shift, at = shift + 7, at + 1
        at += size
    return False


_CODECS: Final = {
    "264": ("h264", _begins_h264),
    "265": ("hevc", _begins_h265),
    "hevc": ("hevc", _begins_h265),
    "vp9": ("vp9", _begins_vp9),
    "av1": ("libdav1d", _begins_av1),
}
"""By a part of its name: FFmpeg's name of a codec, and whether a picture needs none before it."""
