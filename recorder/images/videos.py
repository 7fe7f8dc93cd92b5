"""Images of videos, decoded by PyAV (FFmpeg) to gray or color.

Gray is the luma that a video stores, because the bits of FFmpeg's color conversion depend on the
processor. Only videos without luma are converted from their colors.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.errors import UsageError
from cdmisfa.core.untrusted import BUDGET
from recorder.images.pixels import GRAY, MAX_PIXELS, MalformedImage, lost, raw_image

# Images that a decoder can hold if they depend on one another: 16 and the present one (H.264).
_MAX_HELD: Final = 17

_FULL_RANGE: Final = 2
_LUMA: Final = ("yuv", "yuvj", "gray", "nv12", "nv21")

# Maps a byte of luma in limited range to full range.
_STRETCH: Final = bytes((((np.arange(256) - 16) * 510 + 219) // 438).clip(0, 255).astype(np.uint8))

_BT709: Final = 1

# Weights of BT.709 (True) and BT.601 (False): red by Cr, green by Cb and by Cr, blue by Cb.
_WEIGHTS: Final = {
    True: (1.5748, -0.187324, -0.468124, 1.8556),
    False: (1.402, -0.344136, -0.714136, 1.772),
}

# Start code of a unit of H.264 or H.265, and the first byte of the unit's header.
_UNIT: Final = re.compile(b"\0\0\1(.)", re.DOTALL)


def frame_gray(frame: Any) -> ByteArray:
    """Return the luma of a PyAV frame, or the gray of its colors, upright, (height, width)."""
    lost(GRAY, lambda: _has_colors(frame))
    return _upright(_luma(frame), frame)


def frame_colors(frame: Any) -> ByteArray:
    """Return the colors of a PyAV frame, upright, (height, width, 3); its luma if it has none."""
    return _upright(_colors(frame), frame)


def _has_colors(frame: Any) -> bool:
    """Return whether the chroma of a frame is not neutral."""
    if not _is_planar(frame, "yuv"):
        return not frame.format.name.startswith("gray")
    return any((_plane(p, p.height, p.width) != 128).any() for p in frame.planes[1:3])


def _upright(pixels: ByteArray, frame: Any) -> ByteArray:
    """Turn and mirror pixels as the display matrix of their frame states.

    Source: FFmpeg's libavutil/display.h. A point (x, y) is displayed at (a x + c y, b x + d y).
    """
    bits = max(component.bits for component in frame.format.components)
    lost(f"{bits}-bit pixels are reduced to 8 bits", bits > 8)
    stated = frame.side_data.get("DISPLAYMATRIX")
    if stated is None:
        return pixels
    a, b, _, c, d = np.frombuffer(stated, np.int32)[:5].tolist()
    lost("images are turned upright as their display matrix states", b or a < 0 or d < 0)
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
    """Return whether a frame has one byte for each pixel of a plane, and one of the formats."""
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
    luma = _luma(frame).astype(np.int16)
    height, width = luma.shape
    planes = (_plane(plane, plane.height, plane.width) for plane in frame.planes[1:3])
    cb, cr = (values.astype(np.int32) - 128 for values in planes)
    # Fixed-point numbers with 16 fractional bits give the same bits on every processor.
    scale = (1 if _is_full(frame) else 255 / 224) * 65536
    weights = (round(weight * scale) for weight in _WEIGHTS[frame.colorspace == _BT709])
    red, green_cb, green_cr, blue = weights
    rows, columns = -(-height // cb.shape[0]), -(-width // cb.shape[1])
    colors = np.empty((height, width, 3), np.uint8)
    for channel, chroma in enumerate((red * cr, green_cb * cb + green_cr * cr, blue * cb)):
        # Luma is whole, so that only the chroma is rounded, before it is enlarged.
        whole = ((chroma + 32768) >> 16).astype(np.int16)
        large = whole.repeat(rows, axis=0).repeat(columns, axis=1)[:height, :width]
        colors[..., channel] = (luma + large).clip(0, 255)
    return colors


class Packet(NamedTuple):
    """Data of one image of a video, and the name of the codec in the message."""

    data: bytes
    codec: str


class VideoPackets:
    """Decoder of messages that hold one image of a video each; call it with them in order.

    Most images need earlier ones, back to one that `begins`.

    Args:
        packet_of: returns the packet of a message; raises MalformedImage.
        color: True to return colors; see `raw_image`.
    """

    def __init__(
        self, packet_of: Callable[[bytes | memoryview], Packet], *, color: bool = False
    ) -> None:
        self._packet_of = packet_of
        self._pixels = frame_colors if color else frame_gray
        self._codec = ""
        self._context: Any = None

    def begins(self, message: bytes | memoryview) -> bool:
        """Return whether the image of a message needs no earlier image.

        Raises:
            MalformedImage: the message is damaged, or its codec is not supported.
        """
        data, codec = self._packet_of(message)
        name = _codec(codec)
        return bool(data) and _BEGINS[name](data)

    def forget(self) -> None:
        """Reset the decoder, because the next message does not follow the last one."""
        if self._context is not None:
            self._context.flush_buffers()

    def __call__(self, message: bytes | memoryview) -> ByteArray:
        """Decode the image of the next message, (height, width) uint8, or (height, width, 3).

        Raises:
            MalformedImage: the image is damaged, or an earlier one that it needs is missing.
            UsageError: images depend on later ones.
        """
        data, codec = self._packet_of(message)
        if not data:
            raise MalformedImage("its message is empty, without an image of its video")
        av = pyav()
        name = _codec(codec)
        if name != self._codec:
            self._codec, self._context = name, av.CodecContext.create(name, "r")
            self._context.thread_count = 1
            limit = most_pixels(None, self._context.codec)
            self._context.options = {"err_detect": "explode", "max_pixels": str(limit)}
        try:
            frames = self._context.decode(av.Packet(data))
        except (OSError, ValueError, av.FFmpegError) as error:
            raise MalformedImage(f"its video is damaged there ({type(error).__name__})") from None
        if not frames and self._context.has_b_frames:
            raise UsageError(
                "an image of its video waits for later ones (B-frames), which is impossible with "
                "one image in a message: encode it without B-frames, or use an .mp4 file"
            )
        if len(frames) != 1 or frames[0].is_corrupt:
            raise MalformedImage("an image of its video, or one that it needs, is damaged there")
        return self._pixels(frames[0])


def most_pixels(form: Any, codec: Any) -> int:
    """Return the largest image with which everything that a decoder holds fits the memory budget.

    Args:
        form: PyAV's pixel format; None if it is not known yet.
        codec: PyAV's codec.

    Returns:
        The number of pixels.
    """
    images = 1 if codec.intra_only else _MAX_HELD
    bits = form.padded_bits_per_pixel if form is not None else 8
    return min(MAX_PIXELS, BUDGET * 8 // (images * bits))


def pyav() -> Any:
    """Import PyAV, which is slow."""
    import av

    av.logging.set_level(None)
    return av


# FFmpeg's decoder for a part of a codec's name, which can be h265 or hevc_nvenc;yuv420p.
_CODECS: Final = {"264": "h264", "265": "hevc", "hevc": "hevc", "vp9": "vp9", "av1": "libdav1d"}


def _codec(stated: str) -> str:
    for part, name in _CODECS.items():
        if part in stated.partition(";")[0].lower():
            return name
    raise MalformedImage(f"its codec {stated!r} is not supported: use h264, h265, vp9 or av1")


def _begins_vp9(data: bytes) -> bool:
    """Return whether a VP9 header states a key frame that is not a repeated frame."""
    head = data[0]
    last = 1 if head >> 4 & 3 == 3 else 2  # the fourth profile has a bit more
    return head >> 6 == 2 and head >> last & 3 == 0


# For FFmpeg's decoders: functions that tell whether an image needs no earlier one.
_BEGINS: Final[dict[str, Callable[[bytes], bool]]] = {
    # h264: a unit of an IDR picture; hevc: a unit of an IRAP picture
    "h264": lambda data: any(unit[1][0] & 31 == 5 for unit in _UNIT.finditer(data)),
    "hevc": lambda data: any(16 <= unit[1][0] >> 1 & 63 < 24 for unit in _UNIT.finditer(data)),
    "vp9": _begins_vp9,
    # av1: a sequence header, after the delimiter that FFmpeg writes before each image
    "libdav1d": lambda data: (data.removeprefix(b"\x12\0") or b"\0")[0] >> 3 & 15 == 1,
}
