"""Chunks of logs, as `frames.c` looks through them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.core.arrays import IntArray
from cdmisfa.core.blocks import UINT8
from cdmisfa.core.errors import UsageError
from cdmisfa.kernels import INT64, Struct, pointer, readable


def _buffer(kind: str, data: Any) -> Any:
    return kernels.ffi.from_buffer(kind, data)


def layouts(channels: Any, least: Any, places: Any, marks: Any) -> Struct:
    """How the messages of some channels are laid out, for `scan`.

    Args:
        channels: (C,) the channels.
        least: (C,) fewest bytes of a payload.
        places: (C, M) distance from the payload's end of bytes that are the same in every message;
            0 none.
        marks: (C, M) those bytes.
    """
    n, m = shape = np.shape(places)
    arrays = {
        "ids": readable("channels", np.array(channels, np.int64), (n,), INT64),
        "least": readable("least", np.array(least, np.int64), (n,), INT64),
        "places": readable("places", np.array(places, np.int64), shape, INT64),
        "bytes": readable("marks", np.array(marks, np.uint8), shape, UINT8),
    }
    return Struct("layouts", {"channels": n, "marks": m}, arrays)


def scan(
    data: Any, index: Any, start: int, stop: int, wanted: Struct, counts: Sequence[int]
) -> tuple[IntArray, NDArray[np.uint64]] | None:
    """Check a chunk of messages and find those of some channels.

    Args:
        data: the decompressed records, bytes.
        index: its message index records, bytes.
        start: earliest log time, in nanoseconds.
        stop: latest log time.
        wanted: the layouts of the channels.
        counts: (C,) how many messages of each there are.

    Returns:
        (C, n) place after each message's payload and (C, n) its log time; None where the chunk is
        not in order.
    """
    n, most = wanted.pointer.channels, max(counts)
    ends, times = np.empty((n, most), np.int64), np.empty((n, most), np.uint64)
    code = kernels.lib.scan(
        _buffer("uint8_t[]", data),
        len(data),
        _buffer("uint8_t[]", index),
        len(index),
        start,
        stop,
        wanted.pointer,
        readable("counts", counts, (n,), INT64),
        _buffer("int64_t[]", np.zeros(n, np.int64)),
        most,
        _buffer("int64_t[]", ends),
        _buffer("uint64_t[]", times),
    )
    return None if code else (ends, times)


def gather(
    data: Any, ends: IntArray, distances: IntArray, width: int, out: NDArray[np.uint8]
) -> None:
    """Copy the values out of messages.

    Args:
        data: the decompressed records, bytes.
        ends: (n,) place after each message's payload.
        distances: (R,) distance of each value from there.
        width: bytes of a value.
        out: (n, R * width) written.

    Raises:
        UsageError: a value does not lie within the data.
    """
    n, values = len(ends), len(distances)
    code = kernels.lib.gather(
        _buffer("uint8_t[]", data),
        len(data),
        readable("ends", ends, (n,), INT64),
        n,
        readable("distances", distances, (values,), INT64),
        values,
        width,
        pointer("out", out, (n, values * width), UINT8),
    )
    if code:
        raise UsageError("a value lies outside of the data that it is to be copied from")
