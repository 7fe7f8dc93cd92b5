"""A folder of pictures as a stream of images."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from replay.camera_logs.pixels import RECIPE, compressed_gray, shrink
from replay.mcap.records import Bytes, MalformedRecord

PICTURES: Final = (".jpeg", ".jpg", ".png")


class FolderImages:
    """The pictures of a folder, in the order of their names, numbers by value.

    Args:
        path: the folder.
        topic: its name, or None.
        size: (height, width) of a frame.

    Raises:
        UsageError: it is no topic of the folder.
    """

    recipe = RECIPE
    warnings: Sequence[str] = ()

    def __init__(self, path: Path, topic: str | None, size: tuple[int, int]) -> None:
        self.path = path
        self._size = size
        self.topic = path.resolve().name
        if topic not in (None, self.topic):
            raise UsageError(f"{path}: a folder of pictures has no topics, leave {topic} out")
        self._files = sorted(
            (p for p in path.iterdir() if p.suffix.lower() in PICTURES), key=by_number
        )
        self.count = len(self._files)
        self.times = np.empty(0, np.uint64)

    def frame(self, row: int) -> Bytes:
        """Decode a picture into a frame, (height, width) uint8.

        Raises:
            LogDamagedError: it is no picture that is read.
            CdmisfaError: it cannot be opened.
        """
        file = self._files[row]
        try:
            return shrink(compressed_gray(file.read_bytes()), *self._size)
        except MalformedRecord as error:
            raise LogDamagedError(f"{file}: {error}") from None
        except OSError as error:
            raise CdmisfaError(f"{file}: {error.strerror}") from None

    def close(self) -> None:
        """Do nothing: no file stays open."""


def by_number(path: Path) -> list[tuple[int, str]]:
    """Sort key that puts 9.png before 10.png."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(p) if p.isdecimal() else -1, p) for p in parts]
