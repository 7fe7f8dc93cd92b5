"""Decoded frames of videos and cameras as gray images.

Grey is the luma that a video stores, so that no colour conversion of FFmpeg, whose bits depend
on the processor, comes between; only videos without luma are taken by their colours.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from recorder.images.pixels import RECIPE, Bytes, gray

VIDEO_RECIPE: Final = (
    f"{RECIPE}; of a video the stored luma, 16 to 235 stretched to 0 to 255 as "
    "((Y - 16) * 510 + 219) // 438 where its range is limited"
)
"""How a frame of a video becomes a frame, for the record."""

_FULL_RANGE: Final = 2
_LUMA: Final = ("yuv", "yuvj", "gray", "nv12", "nv21")
_STRETCH: Final[Bytes] = (((np.arange(256) - 16) * 510 + 219) // 438).clip(0, 255).astype(np.uint8)
"""Luma of limited range as full range, a value for each byte, (256,)."""


def frame_gray(frame: Any) -> Bytes:
    """The luma of a frame of PyAV, or the grey of its colours, (height, width) uint8."""
    form = frame.format
    if not form.name.startswith(_LUMA) or form.components[0].bits != 8 or not form.is_planar:
        colours = frame.to_ndarray(format="rgb24")
        height, width = colours.shape[:2]
        return gray(colours.tobytes(), height, width, "rgb8")
    plane = frame.planes[0]
    luma = gray(memoryview(plane), frame.height, frame.width, "mono8", plane.line_size)
    full = form.name.startswith(("yuvj", "gray")) or frame.color_range == _FULL_RANGE
    return luma if full else _STRETCH[luma]
