"""The frames of a recording's views, from its first to its last, a piece at a time."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cdmisfa.core.blocks import Block, SourceSpec
from replay.recordings.source import RecordedSource

PIECE = 1000
"""Most frames that are held at once."""

PIECE_BYTES = 64 * 2**20
"""Most bytes of frames that are held at once, unless one frame has more."""


_UNSAFE = re.compile(r"[^\w.-]|^\.")


def pieces(source: RecordedSource, stream: int) -> Iterator[Block]:
    """Every frame of one view, in order.

    Args:
        source: a recording; its clock is moved.
        stream: the view.
    """
    frame = math.prod(source.spec.frame_shape) * np.dtype(source.spec.dtype).itemsize
    size = max(1, min(PIECE, PIECE_BYTES // max(1, frame)))
    first, end = source.first_frame, source.first_frame + source.frames
    for t in range(first, end, size):
        source.seek(t)
        yield source.take(stream, min(size, end - t))


def view_names(spec: SourceSpec) -> tuple[str, ...]:
    """A name for each view that can be one of a file, no two of them the same.

    A log may come from anywhere, and call its view `../x`.
    """
    names: list[str] = []
    for view in spec.streams:
        name = _UNSAFE.sub("_", view)[:64] or "_"
        names.append(name if name not in names else f"{name}-{len(names) + 1}")
    return tuple(names)


def write_images(source: RecordedSource, folder: Path) -> int:
    """Write every frame of every view as VIEW/FRAME.png.

    Returns:
        How many images.
    """
    for stream, name in enumerate(view_names(source.spec)):
        (folder / name).mkdir(parents=True, exist_ok=True)
        for block in pieces(source, stream):
            for i, frame in enumerate(block.frames):
                _save(frame, folder / name / f"{block.t + i:08d}.png")
    return source.frames * len(source.spec.streams)


def _save(frame: NDArray[Any], file: Path) -> None:
    Image.fromarray(frame).save(file)
