"""A source with gaps as episodes: the frames that every view has, numbered through."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cdmisfa.core.blocks import Block, freeze
from cdmisfa.core.errors import UsageError
from replay.inputs import Logged
from replay.recordings.view_file import intersection
from replay.stored import Span, StoredSource


def shared_spans(source: Logged) -> list[Span]:
    """The unbroken stretches of frames that every view has; one of a source without gaps.

    Raises:
        UsageError: there is none.
    """
    first = source.first_frame
    streams = range(len(source.spec.streams))
    held = [source.spans(stream, first, first + source.frames) for stream in streams]
    shared = functools.reduce(intersection, held)
    if not shared:
        raise UsageError("its views have gaps, and no frame in common: export each by itself")
    return shared


class Stitched(StoredSource):
    """Some stretches of a source one after the other, from frame 0 on and without gaps.

    Args:
        source: left open; its clock is moved.
        spans: the stretches.
    """

    gaps = False

    def __init__(self, source: Logged, spans: Sequence[Span]) -> None:
        self._source, self._spans, self._loop = source, list(spans), False
        self._starts = np.cumsum([0, *(high - low for low, high in spans)])
        self._count = int(self._starts[-1])
        start = source.spec.time_ns(spans[0][0])
        self._spec = replace(source.spec, start_ns=start, length=self._count)

    def scene(self) -> Mapping[str, str]:
        """What was recorded."""
        return self._source.scene()

    def describe(self) -> Mapping[str, Any]:
        """As the source does, with the stretches."""
        return {**self._source.describe(), "spans": [list(span) for span in self._spans]}

    def _block(self, stream: int, t: int, n: int) -> Block:
        frames, truth = [], []
        at = t
        while at < t + n:
            place = int(np.searchsorted(self._starts, at, side="right")) - 1
            count = min(t + n, int(self._starts[place + 1])) - at
            self._source.seek(self._spans[place][0] + at - int(self._starts[place]))
            block = self._source.take(stream, count)
            frames.append(block.frames)
            truth.append(block.truth)
            at += count
        return Block(stream, t, freeze(np.concatenate(frames)), freeze(np.concatenate(truth)))

    def _name(self) -> str:
        return "its episodes"
