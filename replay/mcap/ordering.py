"""The order of a log's messages: by log time, ties in file order."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from replay.mcap.segments import Segment
from replay.mcap.tables import MessageTable


def within(table: MessageTable, low: int, high: int) -> MessageTable:
    """Give the messages with log times from `low` to before `high`."""
    times = table.log_time
    if not len(times) or (low <= int(times.min()) and int(times.max()) < high):
        return table
    keep = times >= np.uint64(min(low, 2**64 - 1))
    if high < 2**64:
        keep &= times < np.uint64(max(high, 0))
    return table.select(keep)


def overlapping(segments: list[tuple[int, Segment]]) -> Iterator[list[tuple[int, Segment]]]:
    """Group segments so that sorting within each group sorts all."""
    ordered = sorted(segments, key=lambda pair: (pair[1].start, pair[0]))
    group: list[tuple[int, Segment]] = []
    end, last = -1, -1
    for number, segment in ordered:
        if group and (segment.start > end or (segment.start == end and number > last)):
            yield sorted(group, key=lambda pair: pair[0])
            group, end, last = [], -1, -1
        group.append((number, segment))
        end, last = max(end, segment.end), max(last, number)
    if group:
        yield sorted(group, key=lambda pair: pair[0])
