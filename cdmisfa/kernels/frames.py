"""Chunks of logs, as `frames.c` looks through them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.core.arrays import ByteArray, IntArray
from cdmisfa.core.blocks import UINT8
from cdmisfa.core.errors import UsageError
from cdmisfa.kernels import INT64, Struct, pointer, readable, records

# A message of a chunk: times in nanoseconds, and the place of its payload.
MESSAGE = np.dtype(
    {
        "names": ["log_time", "publish_time", "at", "size", "sequence", "channel", "unused"],
        "formats": ["u8", "u8", "i8", "i8", "u4", "u2", "u2"],
    },
    align=True,
)
# Most messages of a chunk, and most other records, that are read.
MOST_RECORDS = 1 << 20


def walk_records(data: ByteArray) -> tuple[NDArray[np.void], IntArray, int, tuple[int, int]]:
    """Walk over the records of a chunk as far as they are sound.

    Args:
        data: (B,) the decompressed records.

    Returns:
        (n,) of `MESSAGE`, in their order; (m, 2) first byte and end of the other records; the
        place where the walk ends: B, or that of the first record that is none; and the earliest
        and the latest log time, of no message 2**64 - 1 and 0.

    Raises:
        UsageError: there are more than `MOST_RECORDS` of a kind.
    """
    found, chunk = kernels.ffi.new("walked *"), kernels.ffi.from_buffer("uint8_t[]", data)
    kernels.lib.walk_records(chunk, len(data), kernels.ffi.NULL, kernels.ffi.NULL, found)
    if max(found.messages, found.others) > MOST_RECORDS:
        raise UsageError(f"it holds more than {MOST_RECORDS} messages, the limit of a chunk")
    messages, spans = np.empty(found.messages, MESSAGE), np.empty((found.others, 2), np.int64)
    rows = records("message", messages), kernels.ffi.from_buffer("int64_t[]", spans)
    kernels.lib.walk_records(chunk, len(data), *rows, found)
    return messages, spans, found.end, (found.earliest, found.latest)


def layout(least: int, places: Any, marks: Any, distances: Any, width: int) -> Struct:
    """Return where the payloads of a channel hold their values, for `gather`.

    Args:
        least: fewest bytes of a payload.
        places: (M,) distances from a payload's end of bytes that are the same in every message.
        marks: (M,) those bytes.
        distances: (R,) of each value.
        width: bytes of a value.
    """
    m, r = len(marks), len(distances)
    arrays = {
        "distances": readable("distances", distances, (r,), INT64),
        "places": readable("places", places, (m,), INT64),
        "bytes": readable("marks", marks, (m,), UINT8),
    }
    numbers = {"least": least, "values": r, "width": width, "marks": m}
    return Struct("layout", numbers, arrays)


def gather(
    data: ByteArray,
    messages: NDArray[np.void],
    channel: int,
    rows: tuple[int, int],
    laid_out: Struct,
    out: ByteArray | None,
) -> int | None:
    """Check how messages of a channel are laid out, and copy their values.

    Args:
        data: (B,) the decompressed records.
        messages: (n,) of `MESSAGE`, one after the other, of any channels.
        channel: the channel.
        rows: those of its messages that are wanted, [start, stop).
        laid_out: as `layout` says.
        out: (stop - start, R * width), written; None to check only.

    Returns:
        How many messages of the channel there are; None where one that is wanted is not laid out
        so, and `out` holds anything.
    """
    held, (start, stop) = laid_out.pointer, rows
    shape = stop - start, held.values * held.width
    into = kernels.ffi.NULL if out is None else pointer("out", out, shape, UINT8)
    chunk = kernels.ffi.from_buffer("uint8_t[]", data), len(data)
    wanted = kernels.ffi.from_buffer("message[]", messages), len(messages)
    found = int(kernels.lib.gather(*chunk, *wanted, channel, start, stop, held, into))
    return None if found < 0 else found
