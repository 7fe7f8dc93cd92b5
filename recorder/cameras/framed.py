"""Cameras whose images are frames: all of one size, which the first camera gives or the user."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cdmisfa.core.errors import UsageError
from recorder.cameras.camera import Camera
from recorder.images.fields import rounded
from recorder.images.framing import Framing, Vector, framings, size_of
from recorder.images.pixels import Shown
from recorder.images.reading import Fit, Size


@dataclass
class _Frames:
    """What cameras share: the size of their frames, once it is known, and how images get it.

    Of numbers the size is how many there are.
    """

    size: Size | None
    fit: Fit
    color: bool = False
    numbers: Vector | None = None


def framed(
    cameras: Sequence[Camera],
    size: Size | None,
    fit: Fit,
    *,
    color: bool = False,
    say: Callable[[str], None] = lambda line: None,
) -> list[FramedCamera]:
    """Cameras whose images are frames.

    Without a size it is the `default_size` of the first camera's first image; images that come
    before are passed over.

    Args:
        cameras: each is read in a thread of its own.
        size: (height, width) of a frame, or None.
        fit: see `fitted`.
        color: show red, green and blue beside one another.
        say: told in a line what is cut or added, and when a camera's images change their size.
    """
    frames = _Frames(size, fit, color)
    return [FramedCamera(camera, frames, say, gives=not n) for n, camera in enumerate(cameras)]


class FramedCamera:
    """A camera whose images are frames; see `framed`."""

    def __init__(
        self, camera: Camera, frames: _Frames, say: Callable[[str], None], *, gives: bool
    ) -> None:
        self.name, self.finite = camera.name, camera.finite
        self._camera, self._frames, self._say, self._gives = camera, frames, say, gives
        self._framing: Framing | Vector | None = None
        self._changed = False

    @property
    def rate(self) -> float | None:
        """See `Camera`."""
        return self._camera.rate

    @property
    def distances(self) -> bool | None:
        """Whether its first image holds distances; None where that is not known."""
        return getattr(self._camera, "distances", None)

    def pictures(self) -> Iterator[tuple[int, Shown]]:
        """See `Camera`.

        Raises:
            UsageError: an image is smaller than a frame.
        """
        for age, image in self._camera.pictures():
            framing = self._framing = self._framing or self._begun(image)
            if framing is None:
                continue
            if not self._changed and (change := framing.change(image.shape) or _rounded(image)):
                self._changed = True
                self._say(f"{self.name}: {change}")
            try:
                frame = framing.frame(image)
            except UsageError as error:
                raise UsageError(f"{self.name}: {error}") from None
            yield age, frame

    def describe(self) -> Mapping[str, Any]:
        """See `Camera`."""
        return self._camera.describe()

    def _begun(self, first: Shown) -> Framing | Vector | None:
        """How its images become frames; None as long as the size of frames is not known."""
        frames = self._frames
        if first.ndim > 1 and frames.size is None and not self._gives:
            return None
        framing = framings([first], frames.size, frames.fit, color=frames.color)[0]
        if isinstance(framing, Framing):
            frames.size = framing.size
            if size_of(first) != framing.size:
                self._say(f"{self.name}: {framing}")
        else:
            frames.numbers = frames.numbers or framing
            frames.numbers.frame(first)
        return framing


def _rounded(image: Shown) -> str:
    """What the user should know of numbers that are held rounded; "" of images."""
    return rounded((), image) if image.ndim == 1 else ""
