"""Finding the next sound chunk of a damaged log."""

from __future__ import annotations

import contextlib
import re
from bisect import bisect_left
from typing import Final

from mcap.opcode import Opcode

from recorder.mcap.records import (
    CHUNK_HEADER,
    CHUNK_PEEK,
    MAX_CHUNK,
    RECORD_HEADER,
    MalformedRecord,
    Segment,
)
from recorder.mcap.store import Store

_CHUNK: Final = re.compile(
    rb"(?=\x06[\s\S]{4}\0{4}[\s\S]{20}\0{4}[\s\S]{4}(\0{4}|\x03\0{3}lz4|\x04\0{3}zstd)[\s\S]{4}\0{4})"
    # Opcode, length, times and the low half of the size, its high half, CRC, compression, bytes.
)
_BLOCK: Final = 1 << 20
_OVERLAP: Final = 64


def stands(file: Store, at: int, stop: int) -> bool:
    """Whether a known record begins at `at` and ends before `stop`."""
    head = file.read(at, RECORD_HEADER.size)
    if len(head) < RECORD_HEADER.size:
        return at == stop
    opcode, length = RECORD_HEADER.unpack(head)
    return bool(1 <= opcode <= Opcode.DATA_END and at + RECORD_HEADER.size + length <= stop)


def own_end(file: Store, opcode: int, content: int) -> int | None:
    """The place at which a chunk or a message index ends by what it holds; None for others."""
    if opcode == Opcode.MESSAGE_INDEX:
        return content + 6 + int.from_bytes(file.peek(content + 2, 4), "little")
    if opcode == Opcode.CHUNK:
        with contextlib.suppress(MalformedRecord):
            chunk = Segment.of_chunk(content - RECORD_HEADER.size, file.peek(content, CHUNK_PEEK))
            return chunk.data_offset + chunk.stored
    return None


def leave_chunks(named: list[int], opcode: int, at: int, end: int) -> None:
    """See that the record in [at, end) leaves the chunks alone that the summary names, in order.

    Raises:
        MalformedRecord: it does not.
    """
    place = bisect_left(named, at)
    if opcode == Opcode.CHUNK or place == len(named):
        return
    if named[place] == at:
        raise MalformedRecord("no chunk where the summary names one")
    if named[place] < end:
        raise MalformedRecord("a record runs over the chunk behind it")


def next_chunk(file: Store, at: int, stop: int) -> int | None:
    """The first place in [at, stop) where a chunk with consistent lengths begins, or None."""
    while at < stop:
        block = file.read(at, min(_BLOCK + _OVERLAP, stop - at))
        for found in _CHUNK.finditer(block):
            place = found.start()
            _, length, start, end, size, _ = CHUNK_HEADER.unpack_from(block, place)
            name = place + CHUNK_HEADER.size
            after = name + len(found[1])
            stored = int.from_bytes(block[after : after + 8], "little")
            agrees = place + RECORD_HEADER.size + length == after + 8 + stored
            fits = size <= MAX_CHUNK and at + after + 8 + stored <= stop
            if agrees and fits and start <= end and place < _BLOCK:
                return at + place
        at += _BLOCK
    return None


def fitting(chunk: Segment, end: int) -> Segment:
    """A chunk whose data must not run over the end of its record."""
    if chunk.data_offset + chunk.stored > end:
        raise MalformedRecord("a chunk's length is not that of its data")
    return chunk
