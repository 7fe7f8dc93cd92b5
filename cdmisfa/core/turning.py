"""Frames that are lost while a head turns from one stream to another."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

from cdmisfa.core.blocks import FrameSource, SeekableSource
from cdmisfa.core.errors import LogExhaustedError


def turn_to(source: FrameSource, before: int, after: int) -> None:
    """Pass over the frames of a turn.

    A source whose head has to turn says how many there are: `turns`, [from][to]. They depend on
    the two streams alone, and so a recording gives the blocks that the scene gave. Where the
    frames end meanwhile, the next `take` says so.

    Args:
        source: whose next block is of the stream `after`.
        before: the stream of its last block.
        after: the next one's.
    """
    turns: Sequence[Sequence[int]] = getattr(source, "turns", ())
    lost = turns[before][after] if turns else 0
    if not lost:
        return
    with contextlib.suppress(LogExhaustedError):
        if isinstance(source, SeekableSource):
            source.seek(source.t + lost)
        else:
            source.take_all(lost)
