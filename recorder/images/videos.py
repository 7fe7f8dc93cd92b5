"""Images of videos, decoded by PyAV (FFmpeg), as gray or coloured images.

Gray is the luma that a video stores, for the bits of FFmpeg's colour conversion depend on the
processor. Only videos without luma are converted from their colours.
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

# Images that a decoder holds at most if they depend on one another: 16 and its own (H.264).
_HELD: Final = 17

_FULL_RANGE: Final = 2
_LUMA: Final = ("yuv", "yuvj", "gray", "nv12", "nv21")

# Luma of limited range as full range, a value for each byte.
_STRETCH: Final = bytes((((np.arange(256) - 16) * 510 + 219) // 438).clip(0, 255).astype(np.uint8))

_BT709: Final = 1

# Weights of BT.709 and BT.601: red by Cr, green by Cb and by Cr, blue by Cb.
_WEIGHTS: Final = {
    True: (1.5748, -0.187324, -0.468124, 1.8556),
    False: (1.402, -0.344136, -0.714136, 1.772),
}

# Start of a unit of H.264 or H.265, and the first byte of its header.
_UNIT: Final = re.compile(b"\0\0\1(.)", re.DOTALL)


def frame_gray(frame: Any) -> ByteArray:
    """Return the luma of a frame of PyAV, or the gray of its colours, upright, (height, width)."""
    return _upright(_luma(frame), frame)


def frame_colors(frame: Any) -> ByteArray:
    """Return the colours of a frame of PyAV, upright, (height, width, 3), or else its luma."""
    return _upright(_colors(frame), frame)


def _upright(pixels: ByteArray, frame: Any) -> ByteArray:
    """Turn pixels by quarters, and mirror them, as the display matrix of their frame states.

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


def _is_planar(frame: Any, *names: str) -> bool:
    """Return whether the planes of a frame have a byte for each pixel, and names of formats."""
    form = frame.format
    return bool(form.name.startswith(names) and form.components[0].bits == 8 and form.is_planar)


def _plane(plane: Any, height: int, width: int) -> ByteArray:
    return raw_image(memoryview(plane), height, width, "mono8", plane.line_size)


def _luma(frame: Any) -> ByteArray:
    if not _is_planar(frame, *_LUMA):
        colors = frame.to_ndarray(format="rgb24")
        return raw_image(colors.tobytes(), colors.shape[0], colors.shape[1], "rgb8")
    luma = _plane(frame.planes[0], frame.height, frame.width)
    if _is_full(frame):
        return luma
    return np.frombuffer(luma.tobytes().translate(_STRETCH), np.uint8).reshape(luma.shape)


def _colors(frame: Any) -> ByteArray:
    if frame.format.name.startswith("gray"):
        return _luma(frame)
    if not _is_planar(frame, "yuv") or len(frame.format.components) < 3:
        return np.asarray(frame.to_ndarray(format="rgb24"))
    luma = _luma(frame).astype(np.int32) << 16
    height, width = luma.shape
    chroma = []
    for plane in frame.planes[1:3]:
        values = _plane(plane, plane.height, plane.width)
        rows, columns = -(-height // plane.height), -(-width // plane.width)
        large = values.repeat(rows, axis=0).repeat(columns, axis=1)[:height, :width]
        chroma.append(large.astype(np.int32) - 128)
    # Whole numbers of 16 bits after the point: the same bits on every processor.
    scale = (1 if _is_full(frame) else 255 / 224) * 65536
    weights = (round(weight * scale) for weight in _WEIGHTS[frame.colorspace == _BT709])
    red, green_cb, green_cr, blue = weights
    cb, cr = chroma
    colors = (luma + red * cr, luma + green_cb * cb + green_cr * cr, luma + blue * cb)
    return np.stack([((c + 32768) >> 16).clip(0, 255).astype(np.uint8) for c in colors], axis=2)


class Packet(NamedTuple):
    """The data of one image of a video, and the name of its codec as the message states it."""

    data: bytes
    codec: str


class VideoPackets:
    """The decoder of messages that hold one image of a video each, called with them in order.

    Most images need those before them, back to one that `begins`.

    Args:
        opened: returns the packet of a message; raises MalformedImage.
        color: return colours; see `raw_image`.
    """

    def __init__(
        self, opened: Callable[[bytes | memoryview], Packet], *, color: bool = False
    ) -> None:
        self._opened = opened
        self._pixels = frame_colors if color else frame_gray
        self._codec = ""
        self._context: Any = None

    def begins(self, message: bytes | memoryview) -> bool:
        """Return whether the image of a message needs none before it.

        Raises:
            MalformedImage: the message is malformed, or its codec is not supported.
        """
        data, codec = self._opened(message)
        name = _codec(codec)
        return bool(data) and _BEGINS[name](data)

    def forget(self) -> None:
        """Reset the decoder: the next message does not follow the last."""
        if self._context is not None:
            self._context.flush_buffers()

    def __call__(self, message: bytes | memoryview) -> ByteArray:
        """Decode the image of the next message, (height, width) uint8, or its colours.

        Raises:
            MalformedImage: the image cannot be decoded, or depends on one that is missing.
            UsageError: PyAV is missing, or images depend on later ones.
        """
        data, codec = self._opened(message)
        if not data:
            raise MalformedImage("its message is empty, without an image of its video")
        av = pyav("a video in messages")
        name = _codec(codec)
        if name != self._codec:
            self._codec, self._context = name, av.CodecContext.create(name, "r")
            self._context.thread_count = 1
            most = most_pixels(None, self._context.codec)
            self._context.options = {"err_detect": "explode", "max_pixels": str(most)}
        try:
            frames = self._context.decode(av.Packet(data))
        except (OSError, ValueError, av.FFmpegError) as error:
            raise MalformedImage(f"its video is broken there ({type(error).__name__})") from None
        if not frames and self._context.has_b_frames:
            raise UsageError(
                "an image of its video waits for later ones (B-frames), which messages of one "
                "image each rule out: encode it without them, or take it as an .mp4 file"
            )
        if len(frames) != 1 or frames[0].is_corrupt:
            raise MalformedImage("an image of its video is broken there, or one that it needs")
        return self._pixels(frames[0])


def most_pixels(form: Any, codec: Any) -> int:
    """Return the most pixels of an image with which all that a decoder holds fit the budget.

    Args:
        form: PyAV's format of its pixels; None if it is not known yet.
        codec: PyAV's codec.
    """
    held = 1 if codec.intra_only else _HELD
    bits = form.padded_bits_per_pixel if form is not None else 8
    return min(MAX_PIXELS, BUDGET * 8 // (held * bits))


def pyav(what: str) -> Any:
    """Import PyAV.

    Raises:
        UsageError: PyAV is not installed.
    """
    try:
        import av
    except ImportError:
        raise UsageError(f"{what} needs PyAV: pip install 'cdmisfa[video]'") from None
    av.logging.set_level(None)
    return av


# FFmpeg's decoder by a part of a codec's name, which may be h265 or hevc_nvenc;yuv420p.
_CODECS: Final = {"264": "h264", "265": "hevc", "hevc": "hevc", "vp9": "vp9", "av1": "libdav1d"}


def _codec(stated: str) -> str:
    for part, name in _CODECS.items():
        if part in stated.partition(";")[0].lower():
            return name
    raise MalformedImage(f"a video in {stated!r} is not read: h264, h265, vp9 and av1 are")


def _begins_vp9(data: bytes) -> bool:
    """Return whether a header states a key frame, and no frame that is shown again."""
    head = data[0]
    last = 1 if head >> 4 & 3 == 3 else 2  # the fourth profile has a bit more
    return head >> 6 == 2 and head >> last & 3 == 0


# By FFmpeg's decoder: whether the data of an image need no image before it.
_BEGINS: Final[dict[str, Callable[[bytes], bool]]] = {
    # a unit of an IDR picture; one of an IRAP picture
    "h264": lambda data: any(unit[1][0] & 31 == 5 for unit in _UNIT.finditer(data)),
    "hevc": lambda data: any(16 <= unit[1][0] >> 1 & 63 < 24 for unit in _UNIT.finditer(data)),
    "vp9": _begins_vp9,
    # a sequence header, behind the delimiter that FFmpeg puts before each image
    "libdav1d": lambda data: (data.removeprefix(b"\x12\0") or b"\0")[0] >> 3 & 15 == 1,
}
