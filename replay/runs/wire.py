"""Many protobuf messages of one layout, read at once.

Messages whose numbers have a fixed width and whose sizes are the same differ in their
values alone. So one of them says where the values of all of them stand.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from replay.mcap.records import MalformedRecord

Span = tuple[int, int]
"""Where a value begins and ends in a message."""

_WIDTHS = {1: 8, 5: 4}
_VARINT, _LENGTH = 0, 2
_LONGEST = 10  # bytes of a varint


def spans(data: bytes) -> dict[int, Span]:
    """Where the value of each field of a message stands, by the field's number.

    Raises:
        MalformedRecord: it is no message, or a field stands in it twice.
    """
    found: dict[int, Span] = {}
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        number, kind = key >> 3, key & 7
        if kind == _VARINT:
            end = _varint(data, at)[1]
        elif kind == _LENGTH:
            length, at = _varint(data, at)
            end = at + length
        elif kind in _WIDTHS:
            end = at + _WIDTHS[kind]
        else:
            raise MalformedRecord("a field of no known kind")
        if end > len(data) or number in found:
            raise MalformedRecord("a field runs over the end, or stands there twice")
        found[number] = at, end
        at = end
    return found


def alike(messages: Sequence[bytes], values: Sequence[Span]) -> NDArray[np.uint8] | None:
    """Messages as (n, size) bytes, where they differ in these values alone; else None.

    Args:
        messages: at least one.
        values: of the first message, not its shape: everything else must be the same in all.
    """
    size = len(messages[0])
    if any(len(message) != size for message in messages):
        return None
    rows = np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), size)
    same = np.ones(size, dtype=bool)
    for start, stop in values:
        same[start:stop] = False
    return rows if (rows[:, same] == rows[0, same]).all() else None


def column(rows: NDArray[np.uint8], span: Span, dtype: str) -> NDArray[Any]:
    """The values that stand at one place of n messages, (n, values of that place)."""
    return np.ascontiguousarray(rows[:, span[0] : span[1]]).view(dtype)


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for k, byte in enumerate(data[at : at + _LONGEST]):
        value |= (byte & 0x7F) << 7 * k
        if byte < 0x80:
            return value, at + k + 1
    raise MalformedRecord("a number runs over the end")
