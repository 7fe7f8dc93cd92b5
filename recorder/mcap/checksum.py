"""The checksum of MCAP files."""

from __future__ import annotations

try:  # the same number, several times faster
    from isal.isal_zlib import crc32 as _crc32
except ImportError:
    from zlib import crc32 as _crc32


def crc32(data: bytes | memoryview, value: int = 0) -> int:
    """CRC-32 of bytes, continued from the `value` of those before."""
    return int(_crc32(data, value))
