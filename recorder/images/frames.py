"""Decoded frames of videos and cameras as gray images.

Grey is the luma that a video stores, so that no colour conversion of FFmpeg, whose bits depend
on the processor, comes between; only videos without luma are taken by their colours.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from cdmisfa.core.arrays import ByteArray
from recorder.images.pixels import RECIPE, raw_image

VIDEO_RECIPE: Final = (
    f"{RECIPE}; of a video the stored luma, 16 to 235 stretched to 0 to 255 as "
    "((Y - 16) * 510 + 219) // 438 where its range is limited, by the nearest quarter turns of its "
    "display matrix"
)
"""How a frame of a video becomes a frame, for the record."""

_FULL_RANGE: Final = 2
_LUMA: Final = ("yuv", "yuvj", "gray", "nv12", "nv21")
_STRETCH: Final = bytes((((np.arange(256) - 16) * 510 + 219) // 438).clip(0, 255).astype(np.uint8))
"""Luma of limited range as full range, a value for each byte."""


COLOR_RECIPE: Final = (
    "red, green and blue beside one another, each as gray is; of a Bayer pattern green is the mean "
    "of two; of a video by BT.709 or, where it states another or none, BT.601, in 16 bit whole "
    "numbers, with each chroma pixel repeated"
)
"""How any image becomes a frame in colours, for the record."""

_BT709: Final = 1
_WEIGHTS: Final = {
    True: (1.5748, -0.187324, -0.468124, 1.8556),
    False: (1.402, -0.344136, -0.714136, 1.772),
}
"""Of BT.709 and BT.601: red by Cr, green by Cb and by Cr, blue by Cb."""


def frame_colors(frame: Any) -> ByteArray:
    """The colours of a frame of PyAV, (height, width, 3) uint8, or the luma of one without.

    It is turned upright, as `frame_gray` is.
    """
    return _upright(_colors(frame), frame)


def frame_gray(frame: Any) -> ByteArray:
    """The luma of a frame of PyAV, or the grey of its colours, (height, width) uint8.

    It is turned by quarters and mirrored, as a telephone says how it was held.
    """
    return _upright(_luma(frame), frame)


def _upright(pixels: ByteArray, frame: Any) -> ByteArray:
    """Pixels turned by quarters, and mirrored, as the display matrix of their frame says.

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


def _colors(frame: Any) -> ByteArray:
    form = frame.format
    if form.name.startswith("gray"):
        return _luma(frame)
    luma_first = form.name.startswith("yuv") and len(form.components) >= 3
    if not luma_first or form.components[0].bits != 8 or not form.is_planar:
        colours: ByteArray = frame.to_ndarray(format="rgb24")
        return colours
    luma = _luma(frame).astype(np.int32) << 16
    full = form.name.startswith("yuvj") or frame.color_range == _FULL_RANGE
    height, width = luma.shape
    chroma = []
    for plane in frame.planes[1:3]:
        values = raw_image(memoryview(plane), plane.height, plane.width, "mono8", plane.line_size)
        rows, columns = -(-height // plane.height), -(-width // plane.width)
        large = values.repeat(rows, axis=0).repeat(columns, axis=1)[:height, :width]
        chroma.append(large.astype(np.int32) - 128)
    scale = (1 if full else 255 / 224) * 65536
    red, green_cb, green_cr, blue = (
        round(weight * scale) for weight in _WEIGHTS[frame.colorspace == _BT709]
    )
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
    full = form.name.startswith(("yuvj", "gray")) or frame.color_range == _FULL_RANGE
    if full:
        return luma
    return np.frombuffer(luma.tobytes().translate(_STRETCH), np.uint8).reshape(luma.shape)
