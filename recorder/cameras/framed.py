"""Cameras whose images are frames: all of one size, which the first camera gives or the user."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cdmisfa.core.errors import UsageError
from recorder.cameras.camera import Camera
from recorder.images.framing import Fit, Framing, Size, default_size, size_of
from recorder.images.pixels import Bytes


@dataclass
class _Frames:
    """What cameras share: the size of their frames, once it is known, and how images get it."""

    size: Size | None
    fit: Fit


def framed(
    cameras: Sequence[Camera],
    size: Size | None,
    fit: Fit,
    *,
    say: Callable[[str], None] = lambda line: None,
) -> list[FramedCamera]:
    """Cameras whose images are frames.

    Without a size it is the `default_size` of the first camera's first image; images that come
    before are passed over.

    Args:
        cameras: each is read in a thread of its own.
        size: (height, width) of a frame, or None.
        fit: see `fitted`.
        say: told in a line what is cut or added, and when a camera's images change their size.
    """
    frames = _Frames(size, fit)
    return [FramedCamera(camera, frames, say, gives=not n) for n, camera in enumerate(cameras)]


class FramedCamera:
    """A camera whose images are frames; see `framed`."""

    def __init__(
        self, camera: Camera, frames: _Frames, say: Callable[[str], None], *, gives: bool
    ) -> None:
        self.name, self.finite = camera.name, camera.finite
        self._camera, self._frames, self._say, self._gives = camera, frames, say, gives
        self._framing: Framing | None = None
        self._changed = False

    @property
    def rate(self) -> float | None:
        """See `Camera`."""
        return self._camera.rate

    def pictures(self) -> Iterator[tuple[int, Bytes]]:
        """See `Camera`.

        Raises:
            UsageError: an image is smaller than a frame.
        """
        for age, image in self._camera.pictures():
            framing = self._framing = self._framing or self._begun(size_of(image))
            if framing is None:
                continue
            if not self._changed and (change := framing.change(image)):
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

    def _begun(self, first: Size) -> Framing | None:
        """How its images become frames; None as long as the size of frames is not known."""
        frames = self._frames
        if frames.size is None and self._gives:
            frames.size = default_size(first)
        if frames.size is None:
            return None
        framing = Framing(first, frames.size, frames.fit)
        if first != frames.size:
            self._say(f"{self.name}: {framing}")
        return framing
