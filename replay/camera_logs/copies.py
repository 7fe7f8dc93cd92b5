"""Streams of different logs that show the same: one is a copy of the other."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from cdmisfa.core.errors import LogDamagedError, UsageError
from replay.camera_logs.selected import BROKEN
from replay.camera_logs.stream import ImageStream

IMAGES: Final = 9
"""Images of two streams that are compared, from the first to the last."""

NUMBERS: Final = 256
"""As many where they are numbers, of which few can be the same by chance."""


def copies(streams: Sequence[ImageStream]) -> Iterator[str]:
    """A line for each stream that shows the same as one before it, of another log.

    Their times are the same, and some of their images.
    """
    counts = Counter(stream.count for stream in streams)
    known: dict[tuple[int, bytes], list[ImageStream]] = {}
    for stream in streams:
        if counts[stream.count] < 2 or (first := _shown(stream, 0)) is None:
            continue
        alike = known.setdefault((stream.count, first), [])
        other = next((other for other in alike if _same(other, stream)), None)
        if other is None:
            alike.append(stream)
        else:
            yield (
                f"{stream.path}: {stream.topic} shows the same as {other.topic} of {other.path}, "
                "as a copy does"
            )


def _same(one: ImageStream, two: ImageStream) -> bool:
    if one.path == two.path or not np.array_equal(one.times, two.times):
        return False
    most = NUMBERS if one.fields else IMAGES
    rows = np.unique(np.linspace(0, one.count - 1, most).astype(int)).tolist()
    pairs = ((_shown(one, row), _shown(two, row)) for row in rows)
    return all(first is not None and first == second for first, second in pairs)


def _shown(stream: ImageStream, row: int) -> bytes | None:
    """What identifies an image, None of one that cannot be read."""
    try:
        image = stream.image(row)
    except (*BROKEN, LogDamagedError, UsageError):
        return None
    return hashlib.sha256(repr(image.shape).encode() + image.tobytes()).digest()
