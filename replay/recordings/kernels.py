"""Walking over a chunk and copying values out of it, compiled.

A chunk passes only where every byte of it is accounted for, its message index agrees with
it, and its messages are laid out as the recorder does it. What does not pass is left to
`replay.mcap.tables` and `replay.recordings.scanner`, which say what is wrong with it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.compiled import compiled
from replay.mcap.records import Bytes

Places = NDArray[np.int64]

MAX_PARTS = 64
"""Most channels of a chunk; more are left to the tables."""

_INDEX = 7  # opcode of a message index
_MESSAGE = 5  # opcode of a message
_RECORD = 9  # bytes of opcode and length
_HEADER = 31  # bytes before a message's payload


@compiled
def number(data: Bytes, at: int, width: int) -> int:
    """The unsigned little-endian number of `width` bytes at a place, as 64 bits."""
    value = np.uint64(0)
    for k in range(width):
        value |= np.uint64(data[at + k]) << np.uint64(8 * k)
    return int(value)


@compiled
def index_parts(index: Bytes, parts: Places) -> int:
    """Where the pairs of each message index stand.

    Args:
        index: (N,) records of message indexes.
        parts: (MAX_PARTS, 3) written: channel, place of the first pair, place after the last.

    Returns:
        How many parts there are, or -1 where something else stands there.
    """
    at, n, found = 0, len(index), 0
    while at < n:
        if n - at < _RECORD + 6 or index[at] != _INDEX or found == MAX_PARTS:
            return -1
        length = number(index, at + 1, 8)
        channel = number(index, at + _RECORD, 2)
        pairs = number(index, at + _RECORD + 2, 4)
        if length != pairs + 6 or pairs % 16 or pairs > n - at - _RECORD - 6:
            return -1
        for k in range(found):
            if parts[k, 0] == channel:
                return -1
        at += _RECORD + 6
        parts[found, 0], parts[found, 1], parts[found, 2] = channel, at, at + pairs
        at += pairs
        found += 1
    return found


@compiled
def scan(
    data: Bytes,
    index: Bytes,
    start: int,
    stop: int,
    channels: Places,
    least: Places,
    places: Places,
    marks: Bytes,
    ends: Places,
    times: NDArray[np.uint64],
    counts: Places,
) -> bool:
    """Check a chunk of messages and find those of some channels.

    Args:
        data: (B,) the decompressed records.
        index: (N,) its message index records.
        start: earliest log time, in nanoseconds.
        stop: latest log time.
        channels: (C,) the channels wanted.
        least: (C,) fewest bytes of a payload.
        places: (C, M) distance from the payload's end of bytes that are the same in every
            message; 0 none.
        marks: (C, M) those bytes.
        ends: (C, n) written: place after each message's payload.
        times: (C, n) written: its log time.
        counts: (C,) how many messages of each there are.

    Returns:
        Whether the chunk is in order; nothing that was written counts where it is not.
    """
    parts = np.empty((MAX_PARTS, 3), np.int64)
    n_parts = index_parts(index, parts)
    if n_parts < 0:
        return False
    seen = np.zeros(len(channels), np.int64)
    size, at = len(data), 0
    while at < size:
        if size - at < _HEADER or data[at] != _MESSAGE:
            return False
        length = number(data, at + 1, 8)
        if length < _HEADER - _RECORD or length > size - at - _RECORD:
            return False
        channel = number(data, at + _RECORD, 2)
        time = number(data, at + _RECORD + 6, 8)
        if time < start or time > stop:
            return False
        part = 0
        while part < n_parts and parts[part, 0] != channel:
            part += 1
        if part == n_parts or parts[part, 1] == parts[part, 2]:
            return False
        pair = parts[part, 1]
        parts[part, 1] += 16
        if number(index, pair, 8) != time or number(index, pair + 8, 8) != at:
            return False
        end = at + _RECORD + length
        for c in range(len(channels)):
            if channels[c] != channel:
                continue
            if end - at - _HEADER < least[c] or seen[c] == counts[c]:
                return False
            for k in range(places.shape[1]):
                if places[c, k] and data[end - places[c, k]] != marks[c, k]:
                    return False
            ends[c, seen[c]], times[c, seen[c]] = end, time
            seen[c] += 1
        at = end
    for part in range(n_parts):
        if parts[part, 1] != parts[part, 2]:
            return False
    return bool((seen == counts).all())


@compiled
def gather(data: Bytes, ends: Places, distances: Places, width: int, out: Bytes) -> None:
    """Copy the values out of messages.

    Args:
        data: (B,) the decompressed records.
        ends: (n,) place after each message's payload, as `scan` gave it.
        distances: (R,) distance of each value from there, not above what `scan` checked.
        width: bytes of a value.
        out: (n, R * width) written.
    """
    # Unsigned, so that numba leaves out the test for negative indices.
    for i in range(np.uint64(len(ends))):
        for r in range(np.uint64(len(distances))):
            low, column = np.uint64(ends[i] - distances[r]), r * np.uint64(width)
            for k in range(np.uint64(width)):
                out[i, column + k] = data[low + k]
