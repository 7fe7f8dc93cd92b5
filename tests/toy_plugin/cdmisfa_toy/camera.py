"""A camera: bars that move, at 50 pictures a second, until so many were shown."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from cdmisfa.core.errors import UsageError
from recorder.cameras import CameraKind


class Bars:
    """What `bars:COUNT` names."""

    finite = True
    rate = 50.0

    def __init__(self, word: str, name: str) -> None:
        self.name = name
        count = word.partition(":")[2]
        if not count.isdecimal():
            raise UsageError(f"{word} is no camera of this kind: say how many pictures, bars:100")
        self.count = int(count)

    def pictures(self) -> Iterator[tuple[int, Any]]:
        """See `Camera`."""
        begin = time.monotonic()
        for i in range(self.count):
            time.sleep(max(0.0, begin + i / self.rate - time.monotonic()))
            image = np.zeros((48, 128), np.uint8)
            image[:, i % 128] = 255
            yield 0, image

    def describe(self) -> Mapping[str, Any]:
        """What identifies it."""
        return {"camera": f"bars:{self.count}"}


BARS = CameraKind(Bars)
