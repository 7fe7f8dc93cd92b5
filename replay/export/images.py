"""A recording's frames piece by piece, and as PNG files."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from cdmisfa.core.blocks import Block, SourceSpec
from replay.inputs import Logged
from replay.stored import StoredSource

PIECE = 1000
"""Most frames that are held at once."""

PIECE_BYTES = 64 * 2**20
"""Most bytes of frames that are held at once, unless one frame has more."""

_UNSAFE = re.compile(r"[^\w.-]|^\.")


def pieces(source: StoredSource, stream: int) -> Iterator[Block]:
    """Every frame of one view, in order.

    The source's clock is moved.
    """
    frame = math.prod(source.spec.frame_shape) * np.dtype(source.spec.dtype).itemsize
    size = max(1, min(PIECE, PIECE_BYTES // max(1, frame)))
    end = source.first_frame + source.frames
    for low, high in source.spans(stream, source.first_frame, end):
        for t in range(low, high, size):
            source.seek(t)
            yield source.take(stream, min(size, high - t))


def count(source: Logged) -> int:
    """Frames of all views."""
    first, streams = source.first_frame, range(len(source.spec.streams))
    spans = [span for s in streams for span in source.spans(s, first, first + source.frames)]
    return sum(high - low for low, high in spans)


def file_names(spec: SourceSpec) -> tuple[str, ...]:
    """A name for each view that can be one of a file, no two of them the same.

    A log may come from anywhere, and call its view `../x`.
    """
    names: list[str] = []
    for view in spec.streams:
        name = _UNSAFE.sub("_", view)[:64] or "_"
        numbered = (f"{name}-{number}" for number in itertools.count(len(names) + 1))
        names.append(next(n for n in itertools.chain([name], numbered) if n not in names))
    return tuple(names)


def write_images(source: Logged, folder: Path) -> int:
    """Write every frame of every view as VIEW/FRAME.png, and return how many there are."""
    for stream, name in enumerate(file_names(source.spec)):
        (folder / name).mkdir(parents=True)
        for block in pieces(source, stream):
            for i, frame in enumerate(block.frames):
                Image.fromarray(frame).save(folder / name / f"{block.t + i:08d}.png")
    return count(source)
