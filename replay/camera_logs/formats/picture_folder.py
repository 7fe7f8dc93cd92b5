"""A folder of pictures as a stream of images."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import numpy as np

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.errors import UsageError
from cdmisfa.core.untrusted.regular import check_regular, opened_regular, read_regular
from recorder.images.options import Size
from recorder.images.pixels import compressed_image, picture_size
from replay.camera_logs.stream import ImageStream

PICTURES: Final = (".jpeg", ".jpg", ".png")

MAX_BYTES: Final = 64 * 1024 * 1024
"""Largest file that is read as a picture."""


class FolderImages(ImageStream):
    """The pictures of a folder, in the order of their names, numbers by value."""

    def __init__(self, path: Path, topic: str | None, *, color: bool = False) -> None:
        self.path, self._color = path, color
        self.topic = path.resolve().name
        if topic not in (None, self.topic):
            raise UsageError(f"{path}: a folder of pictures has no topics, leave {topic} out")
        self._files = sorted(
            (p for p in path.iterdir() if p.suffix.lower() in PICTURES), key=by_number
        )
        for file in self._files:
            check_regular(file, MAX_BYTES)
        self.encoding = " ".join(sorted({p.suffix.lower()[1:] for p in self._files}))
        self.times = np.empty(0, np.uint64)

    @property
    def count(self) -> int:
        return len(self._files)

    def image(self, row: int) -> ByteArray:
        return compressed_image(read_regular(self._files[row], MAX_BYTES), color=self._color)

    def stated_size(self, row: int) -> Size | None:
        with opened_regular(self._files[row], MAX_BYTES) as file:
            return picture_size(file)

    def where(self, row: int) -> str:
        return str(self._files[row])

    def close(self) -> None:
        """Do nothing: no file stays open."""


def by_number(path: Path) -> list[tuple[int, str]]:
    """Sort key that puts 9.png before 10.png."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(p) if p.isdecimal() else -1, p) for p in parts]
