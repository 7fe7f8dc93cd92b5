"""Search for the next sound record of a damaged log."""

from __future__ import annotations

import contextlib
import re
from typing import Final

from mcap.opcode import Opcode

from recorder.mcap.chunks import check_size
from recorder.mcap.records import (
    CHUNK_HEADER,
    CHUNK_PEEK,
    MAX_CHUNK,
    RECORD_HEADER,
    MalformedRecord,
    Segment,
)
from recorder.mcap.store import Store

# A chunk: opcode, length, times, size, CRC, compression, stored size. Sizes below 4 GiB have four
# zero bytes each; random data hardly has zeros at all of these offsets.
_CHUNK: Final = re.compile(
    rb"(?=\x06[\s\S]{4}\0{4}[\s\S]{20}\0{4}[\s\S]{4}(\0{4}|\x03\0{3}lz4|\x04\0{3}zstd)[\s\S]{4}\0{4})"
)
# Length that some writers state in a chunk until it is finished.
_OPEN_LENGTH: Final = 2**64 - 1
_BLOCK: Final = 1 << 20

# Bytes that neighbouring blocks share, more than the pattern with the stored size takes.
_OVERLAP: Final = 64


def is_record(file: Store, at: int, stop: int) -> bool:
    """Return whether a known record begins at `at` and ends before `stop`."""
    head = file.read(at, RECORD_HEADER.size)
    if len(head) < RECORD_HEADER.size:
        return at == stop
    opcode, length = RECORD_HEADER.unpack(head)
    return bool(1 <= opcode <= Opcode.DATA_END and at + RECORD_HEADER.size + length <= stop)


def inner_end(file: Store, opcode: int, content: int) -> int | None:
    """Return the end of a chunk or message index by its inner lengths; None for other records."""
    if opcode == Opcode.MESSAGE_INDEX:
        return content + 6 + int.from_bytes(file.peek(content + 2, 4), "little")
    if opcode == Opcode.CHUNK:
        with contextlib.suppress(MalformedRecord):
            at = content - RECORD_HEADER.size
            return Segment.of_chunk(at, file.peek(content, CHUNK_PEEK)).data_end
    return None


def cut_chunk(file: Store, content: int, length: int, limit: int) -> Segment | None:
    """Return the part of a chunk before the end of the file; None if its header is incomplete.

    Args:
        file: the log.
        content: offset of the record's content.
        length: length of the content that the record states.
        limit: end of the file.
    """
    try:
        head = file.peek(content, min(limit - content, CHUNK_PEEK))
        tail = Segment.of_chunk(content - RECORD_HEADER.size, head)
        check_size(tail.compression, 0)
    except MalformedRecord:
        return None
    if length == _OPEN_LENGTH:
        tail.size, tail.crc = MAX_CHUNK, 0
    else:
        tail.within(content + length)
    tail.stored, tail.cut = limit - tail.data_offset, True
    return tail


def next_chunk(file: Store, at: int, stop: int) -> int | None:
    """Return the first offset in [at, stop) at which a chunk with consistent lengths begins."""
    while at < stop:
        block = file.read(at, min(_BLOCK + _OVERLAP, stop - at))
        for match in _CHUNK.finditer(block):
            place = match.start()
            _, length, start, end, size, _ = CHUNK_HEADER.unpack_from(block, place)
            after = place + CHUNK_HEADER.size + len(match[1])
            stored = int.from_bytes(block[after : after + 8], "little")
            agrees = place + RECORD_HEADER.size + length == after + 8 + stored
            fits = size <= MAX_CHUNK and at + after + 8 + stored <= stop
            if agrees and fits and start <= end and place < _BLOCK:
                return at + place
        at += _BLOCK
    return None
