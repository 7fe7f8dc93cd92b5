"""What `frames.c` computes, in plain Python."""

from __future__ import annotations


def number(data: bytes, at: int, width: int) -> int:
    """The unsigned little-endian number of `width` bytes at a place."""
    return int.from_bytes(data[at : at + width], "little")


def walk_records(data: bytes):
    """The messages of a chunk, other records, and where the walk ends; see the kernel."""
    messages, others, at = [], [], 0
    while len(data) - at >= 9:
        end = at + 9 + number(data, at + 1, 8)
        if data[at] == 0 or end > len(data) or (data[at] == 5 and end - at < 31):
            break
        if data[at] == 5:
            times = number(data, at + 15, 8), number(data, at + 23, 8)
            ids = number(data, at + 11, 4), number(data, at + 9, 2)
            messages.append((*times, at + 31, end - at - 31, *ids))
        else:
            others.append([at, end])
        at = end
    times = [message[0] for message in messages]
    return messages, others, at, (min(times, default=2**64 - 1), max(times, default=0))


def gather(data: bytes, spans, least, places, marks, distances, width: int):
    """The values of payloads (place, size), one after the other; None if one is not laid out so."""
    if not all(width <= d <= least for d in distances) or not all(1 <= p <= least for p in places):
        return None
    values = []
    for at, size in spans:
        end = at + size
        if at < 0 or size < least or size < 0 or end > len(data):
            return None
        if any(data[end - p] != mark for p, mark in zip(places, marks, strict=True)):
            return None
        values += [data[end - d : end - d + width] for d in distances]
    return b"".join(values)
