"""Checksums of bytes and of files."""

from __future__ import annotations

import hashlib
from pathlib import Path

from cdmisfa.core.errors import CdmisfaError

try:  # the same number, several times faster
    from isal.isal_zlib import crc32 as _crc32
except ImportError:
    from zlib import crc32 as _crc32


def crc32(data: bytes | memoryview, value: int = 0) -> int:
    """CRC-32 of bytes, continued from the `value` of those before."""
    return int(_crc32(data, value))


def sha256(path: Path) -> str:
    """SHA-256 of a file, read piece by piece.

    Raises:
        CdmisfaError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise CdmisfaError(f"{path}: {error.strerror}") from None
