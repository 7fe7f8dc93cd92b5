"""How images become frames: their size, and what is cropped, padded or stretched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.errors import UsageError, are_for
from recorder.images.options import Fit, Size
from recorder.images.pixels import Shown, shrink

FRAME_PIXELS: Final = 48 * 128
"""Most pixels of a frame where no size is given: those of the paper's."""


@dataclass(frozen=True, slots=True)
class Framing:
    """How the images of one stream become frames.

    Attributes:
        first: size of its first image.
        size: of a frame.
        fit: see `fitted`.
        color: whether a frame shows red, green and blue beside one another.
    """

    first: Size
    size: Size
    fit: Fit
    color: bool = False

    def frame(self, image: ByteArray) -> ByteArray:
        """Make an image a frame; one of another size than the first may be smaller than a frame.

        Args:
            image: (height, width), or (height, width, 3) in colours.

        Raises:
            UsageError: the image is smaller, as the first is.
        """
        enlarge = size_of(image) != self.first
        if not self.color:
            return fitted(image, self.size, self.fit, enlarge=enlarge)
        planes = [image] if image.ndim == 2 else [image[:, :, c].copy() for c in range(3)]
        shown = [fitted(p, self.size, self.fit, enlarge=enlarge) for p in planes]
        return np.hstack(shown if len(shown) == 3 else shown * 3)

    def change(self, image: tuple[int, ...]) -> str:
        """A warning about an image of another shape; "" of one like the first."""
        size = image[0], image[1]
        if size == self.first:
            return ""
        before, now, frame = map(_in_words, (self.first, size, self.size))
        return f"images change from {before} to {now}; each is made a frame of {frame}"

    @property
    def shape(self) -> tuple[int, ...]:
        """Of a frame."""
        return self.size[0], self.size[1] * (3 if self.color else 1)

    @property
    def lossy(self) -> str:
        """How images of another ratio are made to fit; see `cut_or_added`."""
        return cut_or_added(self.first, self.size, self.fit)

    def __str__(self) -> str:
        """How an image becomes a frame, in words."""
        shown = "" if self.first == self.size else f"shown as {_in_words(self.size)}"
        return ", ".join(filter(None, [_in_words(self.first), self.lossy, shown]))


@dataclass(frozen=True, slots=True)
class Vector:
    """How the numbers of one stream become frames: as they are.

    Attributes:
        count: how many there are in each message.
    """

    count: int
    lossy = ""

    def frame(self, numbers: Shown) -> Shown:
        """The numbers of a message, (count,) float64.

        Raises:
            UsageError: it holds others.
        """
        if numbers.shape != self.shape:
            least = min(self.count, len(numbers))
            raise UsageError(
                f"a message holds {len(numbers)} numbers, and the first {self.count}: choose a "
                f"part of the field, as --field position[0:{least}]"
            )
        return numbers

    def change(self, numbers: tuple[int, ...]) -> str:
        """Nothing: see `frame`."""
        return ""

    @property
    def shape(self) -> tuple[int, ...]:
        """Of a frame."""
        return (self.count,)

    def __str__(self) -> str:
        """What a frame is, in words."""
        return "a number" if self.count == 1 else f"{self.count} numbers"


def framings(
    firsts: Sequence[Shown], size: Size | None, fit: Fit, *, color: bool = False
) -> Sequence[Framing | Vector]:
    """How the images or numbers of streams become frames, all of one shape.

    Args:
        firsts: what each stream shows first.
        size: (height, width) of a frame; None for the `default_size` of the first image.
        fit: see `fitted`.
        color: show red, green and blue beside one another.

    Raises:
        UsageError: some show images and some numbers, or not as many.
    """
    if all(first.ndim > 1 for first in firsts):
        size = size or default_size(size_of(firsts[0]))
        return [Framing(size_of(first), size, fit, color) for first in firsts]
    counts = [len(first) for first in firsts if first.ndim == 1]
    if len(counts) < len(firsts) or len(set(counts)) > 1:
        raise UsageError(
            "streams that are learned from together show frames of one shape, and these show "
            + " and ".join(dict.fromkeys(_shown_in_words(first) for first in firsts))
            + ": take as many numbers of each, as with --field position[0:6], or each apart"
        )
    given = {"--size": size is not None, "input.fit": fit != "crop", "--color": color}
    if refused := [option for option, said in given.items() if said]:
        raise UsageError(f"numbers are taken as they are: {are_for(refused, 'images')}")
    return [Vector(count) for count in counts]


def size_of(image: Shown) -> Size:
    """The size of an image, (height, width)."""
    return image.shape[0], image.shape[1]


def default_size(image: Size) -> Size:
    """An image's size divided by the least whole number that leaves `FRAME_PIXELS` or fewer."""
    height, width = image
    divisor = 1
    while max(height // divisor, 1) * max(width // divisor, 1) > FRAME_PIXELS:
        divisor += 1
    return max(height // divisor, 1), max(width // divisor, 1)


def fitted(image: ByteArray, size: Size, fit: Fit, *, enlarge: bool = False) -> ByteArray:
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
    whole = image.shape
    if fit == "crop":
        image = _middle(image, _largest_within(size_of(image), size))
    if fit != "pad":
        return shrink(image, *size, enlarge=enlarge, whole=whole)
    inner = _largest_within(size, size_of(image))
    frame = np.zeros(size, np.uint8)
    _middle(frame, inner)[:] = shrink(image, *inner, enlarge=enlarge)
    return frame


def cut_or_added(image: Size, size: Size, fit: Fit) -> str:
    """How an image of another ratio was made to fit, in words; "" of one of the same ratio."""
    if fit == "crop":
        height, width = _largest_within(image, size)
        return "" if (height, width) == image else f"cropped to {width}x{height}"
    height, width = _largest_within(size, image)
    if (height, width) == size:
        return ""
    return f"padded from {width}x{height}" if fit == "pad" else "stretched"


def _shown_in_words(shown: Shown) -> str:
    return "images" if shown.ndim > 1 else str(Vector(len(shown)))


def _in_words(size: Size) -> str:
    return f"{size[1]}x{size[0]}"


def _largest_within(outer: Size, ratio: Size) -> Size:
    """The largest size within another that has the ratio of the sides of a third."""
    if outer[0] * ratio[1] > outer[1] * ratio[0]:
        return max(round(outer[1] * ratio[0] / ratio[1]), 1), outer[1]
    return outer[0], max(round(outer[0] * ratio[1] / ratio[0]), 1)


def _middle(image: ByteArray, size: Size) -> ByteArray:
    top, left = ((have - want) // 2 for have, want in zip(image.shape, size, strict=True))
    return image[top : top + size[0], left : left + size[1]]
