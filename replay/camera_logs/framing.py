"""What of an image a frame shows: how large it is, and what is cut or added at its sides."""

from __future__ import annotations

from typing import Final

import numpy as np

from recorder.images.pixels import shrink
from replay.camera_logs.options import Fit
from replay.mcap.records import Bytes

FRAME_PIXELS: Final = 48 * 128
"""Most pixels of a frame where no size is given: those of the paper's."""

Size = tuple[int, int]
"""(height, width) in pixels."""


def default_size(image: Size) -> Size:
    """An image's size divided by the least whole number that leaves `FRAME_PIXELS` or fewer."""
    height, width = image
    divisor = 1
    while max(height // divisor, 1) * max(width // divisor, 1) > FRAME_PIXELS:
        divisor += 1
    return max(height // divisor, 1), max(width // divisor, 1)


def fitted(image: Bytes, size: Size, fit: Fit, *, enlarge: bool = False) -> Bytes:
    """Make an image a frame.

    Args:
        image: (height, width) uint8.
        size: of the frame.
        fit: where the ratio of the sides is another: "crop" cuts two sides, as much of each,
            "pad" puts black at them, "stretch" changes the ratio.
        enlarge: take a smaller image, too.

    Raises:
        UsageError: the image is smaller.
    """
    if image.shape == size:
        return image
    if fit == "crop":
        image = _middle(image, _largest_within((image.shape[0], image.shape[1]), size))
    if fit != "pad":
        return shrink(image, *size, enlarge=enlarge)
    inner = _largest_within(size, (image.shape[0], image.shape[1]))
    frame = np.zeros(size, np.uint8)
    _middle(frame, inner)[:] = shrink(image, *inner, enlarge=enlarge)
    return frame


def cut_or_added(image: Size, size: Size, fit: Fit) -> str:
    """What a frame lacks of an image, or has besides it, in words; "" if it is all of it."""
    if fit == "crop":
        height, width = _largest_within(image, size)
        return "" if (height, width) == image else f"cropped to {width}x{height}"
    height, width = _largest_within(size, image)
    if (height, width) == size:
        return ""
    return f"padded from {width}x{height}" if fit == "pad" else "stretched"


def _largest_within(outer: Size, ratio: Size) -> Size:
    """The largest size within another that has the ratio of the sides of a third."""
    if outer[0] * ratio[1] > outer[1] * ratio[0]:
        return max(round(outer[1] * ratio[0] / ratio[1]), 1), outer[1]
    return outer[0], max(round(outer[0] * ratio[1] / ratio[0]), 1)


def _middle(image: Bytes, size: Size) -> Bytes:
    top, left = ((have - want) // 2 for have, want in zip(image.shape, size, strict=True))
    return image[top : top + size[0], left : left + size[1]]
