"""What `frames.c` computes, in plain Python."""

from __future__ import annotations

import numpy as np

Found = tuple[list[list[int]], list[list[int]]]


def number(data: bytes, at: int, width: int) -> int:
    """The unsigned little-endian number of `width` bytes at a place."""
    return int.from_bytes(data[at : at + width], "little")


def index_parts(index: bytes) -> dict[int, tuple[int, int]] | None:
    """By channel, place of the first pair of each message index, and place after the last."""
    at, parts = 0, {}
    while at < len(index):
        if len(index) - at < 15 or index[at] != 7 or len(parts) == 64:
            return None
        channel, pairs = number(index, at + 9, 2), number(index, at + 11, 4)
        if number(index, at + 1, 8) != pairs + 6 or pairs % 16 or pairs > len(index) - at - 15:
            return None
        if channel in parts:
            return None
        at += 15
        parts[channel] = at, at + pairs
        at += pairs
    return parts


def scan(data, index, start, stop, channels, least, places, marks, counts) -> Found | None:
    """Check a chunk of messages and find those of some channels; see `kernels.scan`."""
    parts = index_parts(index)
    if parts is None:
        return None
    ends, times = [[] for _ in channels], [[] for _ in channels]
    at = 0
    while at < len(data):
        if len(data) - at < 31 or data[at] != 5:
            return None
        length, channel = number(data, at + 1, 8), number(data, at + 9, 2)
        time, end = number(data, at + 15, 8), at + 9 + length
        if length < 22 or end > len(data) or not start <= time <= stop:
            return None
        pair, last = parts.get(channel, (0, 0))
        if pair == last or (number(index, pair, 8), number(index, pair + 8, 8)) != (time, at):
            return None
        parts[channel] = pair + 16, last
        for c in np.flatnonzero(np.asarray(channels) == channel):
            payload = data[at + 31 : end]
            if len(payload) < least[c] or len(ends[c]) == counts[c]:
                return None
            for place, mark in zip(places[c], marks[c], strict=True):
                if place and not (0 < place <= len(payload) and payload[-place] == mark):
                    return None
            ends[c].append(end)
            times[c].append(time)
        at = end
    if any(pair != last for pair, last in parts.values()) or list(map(len, ends)) != list(counts):
        return None
    return ends, times


def gather(data: bytes, ends, distances, width: int) -> bytes:
    """The values of messages, one after the other."""
    lows = [end - distance for end in ends for distance in distances]
    return b"".join(data[low : low + width] for low in lows)
