"""Checksums of files."""

from __future__ import annotations

import hashlib
from pathlib import Path

from cdmisfa.core.errors import CdmisfaError


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
