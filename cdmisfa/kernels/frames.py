"""Access to the messages of an MCAP chunk, by the C of `frames.c`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.core.arrays import ByteArray, IntArray
from cdmisfa.core.blocks import UINT8
from cdmisfa.core.errors import UsageError
from cdmisfa.kernels import INT64, Struct, expect, pointer, readable, records

# A message in a chunk: its times (ns), and offset (`at`) and size of its payload in bytes.
MESSAGE = np.dtype(
    {
        "names": ["log_time", "publish_time", "at", "size", "sequence", "channel", "unused"],
        "formats": ["u8", "u8", "i8", "i8", "u4", "u2", "u2"],
    },
    align=True,
)
# Largest number of messages in a chunk, and of other records. A chunk of 1 MB holds 34,000 empty
# messages; a hostile file could hold so many that their table does not fit into memory.
MAX_RECORDS = 1 << 20


def walk_records(data: ByteArray) -> tuple[NDArray[np.void], IntArray, int, tuple[int, int]]:
    """Walk over the records of a chunk up to the first invalid one.

    Args:
        data: (B,) the decompressed records.

    Returns:
        Messages, (n,) of `MESSAGE`, in their order; first byte and end of each other record,
        (m, 2); offset at which the walk ends, B or that of the first invalid record; earliest and
        latest log time, 2**64 - 1 and 0 if there is no message.

    Raises:
        UsageError: there are more than `MAX_RECORDS` of a kind.
    """
    walk, chunk = kernels.ffi.new("walked *"), kernels.ffi.from_buffer("uint8_t[]", data)
    kernels.lib.walk_records(chunk, len(data), kernels.ffi.NULL, kernels.ffi.NULL, walk)
    if max(walk.messages, walk.others) > MAX_RECORDS:
        raise UsageError(f"it holds more than {MAX_RECORDS} messages, the limit of a chunk")
    messages, spans = np.empty(walk.messages, MESSAGE), np.empty((walk.others, 2), np.int64)
    rows = records("message", messages), kernels.ffi.from_buffer("int64_t[]", spans)
    kernels.lib.walk_records(chunk, len(data), *rows, walk)
    return messages, spans, walk.end, (walk.earliest, walk.latest)


def layout(least: int, places: Any, marks: Any, distances: Any, width: int) -> Struct:
    """Return the layout of the payloads of a channel, for `gather`.

    Args:
        least: smallest size of a payload (bytes).
        places: (M,) distances, from the end of a payload, of bytes that are equal in all messages.
        marks: (M,) these bytes.
        distances: (R,) distances of the values from the end of a payload.
        width: size of a value (bytes).
    """
    m, r = len(marks), len(distances)
    expect("width", width, max(width, 0))
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
    """Check that messages of a channel have a layout, and copy their values.

    Args:
        data: (B,) the decompressed records.
        messages: (n,) of `MESSAGE`, in order, of any channels.
        channel: number of the channel.
        rows: range [start, stop) of the channel's messages to check and copy.
        laid_out: the layout, from `layout`.
        out: (stop - start, R * width), written; None to check only.

    Returns:
        Number of messages of the channel; None if a message in the range has another layout, and
        `out` is then undefined.
    """
    expected, (start, stop) = laid_out.pointer, rows
    shape = stop - start, expected.values * expected.width
    into = kernels.ffi.NULL if out is None else pointer("out", out, shape, UINT8)
    chunk = kernels.ffi.from_buffer("uint8_t[]", data), len(data)
    expect("messages", messages.dtype, MESSAGE)
    table = kernels.ffi.from_buffer("message[]", messages), len(messages)
    count = int(kernels.lib.gather(*chunk, *table, channel, start, stop, expected, into))
    return None if count < 0 else count
