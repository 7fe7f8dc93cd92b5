"""What a camera is to those who read it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, Protocol

from recorder.images.pixels import Shown


class Picture(NamedTuple):
    """One image of a camera.

    Attributes:
        time_ns: when it was taken or came, by the clock that all cameras share.
        image: gray, (height, width) uint8, or in colours, (height, width, 3); or numbers, (I,)
            float64.
    """

    time_ns: int
    image: Shown


class Camera(Protocol):
    """A stream of images from outside, opened and read in a thread of its own.

    Attributes:
        name: of its stream.
        finite: whether its end is an end, and not a loss to recover from.
        rate: images a second that it states; None where it states none, or is not open yet.
    """

    name: str
    finite: bool

    @property
    def rate(self) -> float | None:
        """See above."""

    def pictures(self) -> Iterator[tuple[int, Shown]]:
        """Open it and give its images as they come, until it ends.

        Yields:
            How many nanoseconds ago the image was taken, 0 where only its coming is known; and
            the image at its own size, gray, (height, width) uint8, or in colours, (height, width,
            3) uint8; or numbers, (I,) float64, finite and as many each time.

        Raises:
            Exception: it cannot be opened, or is gone.
        """

    def describe(self) -> Mapping[str, Any]:
        """What identifies it, as JSON values, without secrets."""
