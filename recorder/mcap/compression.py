"""Decompressing chunks, which may lie about their size and hold anything."""

from __future__ import annotations

import sys
import threading
from typing import Final

import lz4.frame
import numpy as np
import zstandard

from cdmisfa.core.arrays import ByteArray
from recorder.mcap.records import MAX_CHUNK, MalformedRecord

_WINDOW: Final = MAX_CHUNK // 2
"""Most memory that zstd may take for its window, in bytes."""
_KEPT: Final = 6
_KEPT_BYTES: Final = 8 * 1024 * 1024
"""Buffers that are kept to be used again, and the size of the largest."""
_PIECE: Final = 64 * 1024
"""Bytes that LZ4 gives at once: less than the C library would ask new memory of the system for."""
_BROKEN: Final = (zstandard.ZstdError, RuntimeError, ValueError, MemoryError, EOFError)


class Memory:
    """Memory that is used again once nothing refers to it: new memory costs more than filling it.

    Threads may share it.
    """

    def __init__(self) -> None:
        self._held: list[ByteArray] = []
        self._lock = threading.Lock()

    def take(self, size: int) -> ByteArray:
        """Memory of some bytes, which hold anything."""
        with self._lock:
            held = self._held
            for i in range(len(held)):
                # Referred to by the list, and by the call that counts.
                if len(held[i]) >= size and sys.getrefcount(held[i]) == 2:
                    held.append(held.pop(i))
                    return held[-1][:size]
            if size > _KEPT_BYTES:
                return np.empty(size, np.uint8)
            del held[: -_KEPT + 1]
            held.append(np.empty(size + size // 8, np.uint8))
            return held[-1][:size]


class Decompressor:
    """Decompresses the chunks of a file; threads may share it."""

    def __init__(self) -> None:
        self._own = threading.local()

    @property
    def _zstd(self) -> zstandard.ZstdDecompressor:
        """The decompressor of the calling thread."""
        if not hasattr(self._own, "zstd"):
            self._own.zstd = zstandard.ZstdDecompressor(max_window_size=_WINDOW)
        found: zstandard.ZstdDecompressor = self._own.zstd
        return found

    def decompress(self, stored: memoryview, compression: str, out: ByteArray) -> None:
        """Write the records of a chunk into memory of the size that it states.

        Raises:
            MalformedRecord: an unknown compression, more than `MAX_CHUNK` bytes, broken data,
                or another number of bytes than stated.
        """
        size = len(out)
        check_size(compression, size)
        try:
            if compression == "zstd":
                there = self._from_zstd(stored, out)
            elif compression == "lz4":
                there = _from_lz4(stored, out)
            else:
                there = len(stored)
                if there == size:
                    out[:] = np.frombuffer(stored, np.uint8)
        except _BROKEN as error:
            raise MalformedRecord(f"its {compression} data is broken ({error})") from None
        if there != size:
            raise MalformedRecord(f"it states {size} bytes decompressed and holds {there}")

    def _from_zstd(self, stored: memoryview, out: ByteArray) -> int:
        """How many bytes there are; one more than fit stands for any number of them."""
        size = len(out)
        stated = int(zstandard.frame_content_size(stored))
        if stated > size:
            return stated
        if stated == size:
            # Where the whole output fits, zstd writes straight into it.
            if size and self._zstd.stream_reader(stored).readinto(out.data) != size:
                raise MalformedRecord("its zstd data is cut short")
            return size
        data = b""
        if stated == -1:
            data = self._zstd.decompress(stored, max_output_size=max(size, 1))
        if len(data) != size:
            data = self._zstd.stream_reader(stored, read_across_frames=True).read(size + 1)
        if len(data) == size:
            out[:] = np.frombuffer(data, np.uint8)
        return len(data)

    def prefix(self, stored: bytes, compression: str, size: int) -> bytes:
        """Give what can be decompressed of a chunk that was cut short, `size` bytes at most.

        Raises:
            MalformedRecord: an unknown compression, or nothing can be.
        """
        check_size(compression, size)
        if compression == "":
            return stored[:size]
        parts: list[bytes] = []
        try:
            if compression == "lz4":
                return bytes(lz4.frame.LZ4FrameDecompressor().decompress(stored, max_length=size))
            held = 0
            reader = self._zstd.stream_reader(stored)
            while held < size and (part := reader.read(min(size - held, 1 << 17))):
                parts.append(part)
                held += len(part)
        except _BROKEN as error:
            if not (parts and isinstance(error, zstandard.ZstdError)):
                raise MalformedRecord(f"its {compression} data is broken ({error})") from None
        return b"".join(parts)


def check_size(compression: str, size: int) -> None:
    """Refuse an unknown compression, and more than `MAX_CHUNK` bytes decompressed."""
    if compression not in ("", "zstd", "lz4"):
        raise MalformedRecord(f"its compression {compression[:40]!r} is unknown")
    if size > MAX_CHUNK:
        raise MalformedRecord(
            f"it states {size} bytes decompressed, above the limit of {MAX_CHUNK} bytes"
        )


def _from_lz4(stored: memoryview, out: ByteArray) -> int:
    """How many bytes there are; one more than fit stands for any number of them."""
    size = len(out)
    stated = lz4.frame.get_frame_info(stored)["content_size"]
    if stated not in (0, size):
        raise MalformedRecord(f"it states {size} bytes decompressed, its data {stated}")
    context = lz4.frame.create_decompression_context()
    there, used, ended = 0, 0, False
    while not ended:
        most = min(max(size - there, 1), _PIECE)
        data, taken, ended = lz4.frame.decompress_chunk(context, stored[used:], max_length=most)
        if not taken and not data:
            raise MalformedRecord("its lz4 data is cut short")
        if there + len(data) > size:
            return size + 1
        out[there : there + len(data)] = np.frombuffer(data, np.uint8)
        there, used = there + len(data), used + taken
    return there
