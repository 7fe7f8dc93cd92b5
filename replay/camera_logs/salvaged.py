"""Streams of which some images are broken, each shown by a whole one near it."""

from __future__ import annotations

import itertools
from typing import Final

from cdmisfa.core.errors import LogDamagedError
from recorder.images.pixels import MalformedImage, Shown
from recorder.mcap.records import MalformedRecord
from replay.camera_logs.stream import ImagesOf, ImageStream, UnreadableError

BROKEN = (MalformedImage, MalformedRecord, UnreadableError)
"""What is raised of one image, behind which there may be whole ones."""

SALVAGE: Final = "learn and convert pass over what is broken with --salvage"
"""What to do about it."""


class WholeImages(ImagesOf):
    """A stream's images, for a broken one the last whole one before it, else the first of all.

    Which one that is depends on the log alone, not on what was asked for before.

    Attributes:
        broken: the rows of the broken images that were met, each with what is wrong with it.
    """

    def __init__(self, images: ImageStream) -> None:
        super().__init__(images, images.times)
        self.broken: dict[int, LogDamagedError] = {}
        self._last: tuple[int, Shown] | None = None

    @property
    def count(self) -> int:
        return self._images.count

    def image(self, row: int) -> Shown:
        """Decode an image, or that which stands for it; raises what is wrong if none is whole."""
        for near in itertools.chain(range(row, -1, -1), range(row + 1, self.count)):
            if near in self.broken:
                continue
            if self._last is not None and self._last[0] == near:
                return self._last[1]
            try:
                self._last = near, self._images.image(near)
                return self._last[1]
            except BROKEN as error:
                self.broken[near] = error
        raise self.broken[row]

    def distances(self) -> bool:
        try:
            return self._images.distances()
        except BROKEN:
            return True  # the image that would tell is broken

    def said(self) -> str | None:
        """That images are broken, as far as they were met; None where none was."""
        if not self.broken:
            return None
        first = min(self.broken)
        what = "messages" if self.fields else "images"
        return (
            f"{self.where(first)}: {self.broken[first]}: {len(self.broken)} broken of {self.count} "
            f"{what}: the last whole one is taken instead"
        )
