"""Detect truncated video files, by the lengths that their containers state.

A container is a sequence of parts, each with a name and a length. In a truncated file one part is
incomplete; FFmpeg would silently return the frames before it.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from cdmisfa.core.untrusted import opened_regular


class Extent(NamedTuple):
    """Completeness of a file.

    Attributes:
        missing: description of the missing part; "" if none is known.
        stated: whether the file states its length, so that a missing end is detected.
    """

    missing: str = ""
    stated: bool = True


def extent_of(path: Path) -> Extent:
    """Return how far the file of a video goes, by the parts of its container.

    Raises:
        UsageError: the path is not a regular file, or not readable.
        LogDamagedError: the disk does not give it.
    """
    with opened_regular(path) as file:
        size, head = os.fstat(file.fileno()).st_size, file.read(16)
        if head[4:8] in _FIRST_BOXES:
            kinds, extent = _boxes(file, size)
            if kinds & {b"moov", b"moof"}:
                return extent
            return extent._replace(missing="; ".join(filter(None, (extent.missing, _NO_INDEX))))
        if head.startswith(_EBML):
            return _elements(file, size)
        if head.startswith(b"RIFF"):
            return _chunks(file, size)
        return Extent(stated=False)


def _ended(what: str, stop: int, size: int) -> Extent:
    return Extent(f"the file ends at byte {size}, but {what} ends at byte {stop}")


def _zeros(at: int) -> Extent:
    return Extent(f"it has zeros at byte {at}, where its next part should begin")


def _at(file: BinaryIO, place: int, count: int) -> bytes:
    """Return `count` bytes from an offset, padded with zeros at the end of the file."""
    file.seek(place)
    return file.read(count).ljust(count, b"\0")


# MP4, MOV: ISO/IEC 14496-12, 4.2

_FIRST_BOXES: Final = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot", b"styp")


_NO_INDEX: Final = (
    "its index (moov), which cameras write last, is incomplete, so no frame can be read: "
    "restore it with untrunc and an intact video of the same camera"
)


def _boxes(file: BinaryIO, size: int) -> tuple[set[bytes], Extent]:
    """Return the kinds of its boxes that are all there, and how far it goes.

    In one piece a file ends with its last box; in fragments, moof, their index mfra ends it.
    """
    kinds: set[bytes] = set()
    at = 0
    while at < size:
        length, kind, long = struct.unpack(">I4sQ", _at(file, at, 16))
        if kind == bytes(4):  # behind the last box of a file in one piece it is room for others
            return kinds, _zeros(at) if b"moof" in kinds else Extent()
        if length == 0:  # to the end, wherever that is
            return kinds, Extent(stated=False)
        stop = at + max(long if length == 1 else length, 8)
        if stop > size:
            return kinds, _ended(f"its {kind.decode('latin-1')!r}", stop, size)
        kinds.add(kind)
        at = stop
    return kinds, Extent(stated=b"moof" not in kinds or b"mfra" in kinds)


# Matroska, WebM: RFC 8794 and RFC 9559

_EBML: Final = b"\x1a\x45\xdf\xa3"
_SEGMENT, _CLUSTER = 0x18538067, 0x1F43B675


def _elements(file: BinaryIO, size: int) -> Extent:
    """Return how far a segment, clusters and blocks go; a live writer states no length."""
    at, end, stated = 0, size, True
    while at < end:
        head = _at(file, at, 12)
        kind, more, _ = _number(head)
        if head[0] == 0 or head[more] == 0:
            return _zeros(at)
        length, width, unknown = _number(head[more:], keep=False)
        body = at + more + width
        holds = kind in (_SEGMENT, _CLUSTER)
        if unknown and not holds:
            return Extent(f"its part at byte {at} has no length")
        if not unknown and body + length > size:
            return _ended(_NAMES.get(kind, "a part"), body + length, size)
        if kind == _SEGMENT:
            stated = not unknown
            end = size if unknown else body + length
        at = body if holds else body + length
    return Extent(stated=stated)


_NAMES: Final = {_SEGMENT: "its segment", _CLUSTER: "a cluster"}


def _number(data: bytes, *, keep: bool = True) -> tuple[int, int, bool]:
    """Return a number of variable width, its width, and whether it means an unknown length.

    Args:
        data: begins with it.
        keep: the mark of the width is a part of the number, as of names.
    """
    width = 9 - data[0].bit_length()
    value = int.from_bytes(data[:width], "big")
    ones = (1 << 7 * width) - 1
    return (value if keep else value & ones), width, value & ones == ones


# AVI: RIFF, with further ones behind the first where it is large (OpenDML)


def _chunks(file: BinaryIO, size: int) -> Extent:
    at = 0
    while at < size and _at(file, at, 4) == b"RIFF":
        stop = at + 8 + int.from_bytes(_at(file, at + 4, 4), "little")
        if stop - at - 8 in (0, 0xFFFFFFFF):  # what wrote it could not go back
            return Extent(stated=False)
        if stop > size:
            return _ended("its 'RIFF'", stop, size)
        for name, start, end in _inner_chunks(file, at + 12, stop):
            if name == bytes(4):
                return _zeros(start)
            if end > stop:
                return _ended(f"its {name.decode('latin-1')!r}", end, size)
        at = stop + stop % 2
    return Extent()


def _inner_chunks(file: BinaryIO, at: int, stop: int) -> Iterator[tuple[bytes, int, int]]:
    while at + 8 <= stop:
        name, length = struct.unpack("<4sI", _at(file, at, 8))
        yield name, at, at + 8 + length
        at += 8 + length + length % 2
