"""What tells a log from other files, and from other logs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cdmisfa.core.errors import CdmisfaError
from recorder.mcap.writer import MAGIC
from replay.mcap.reader import LogReader
from replay.storage.checksum import sha256
from replay.storage.location import Location


def starts_as_log(path: Path) -> bool:
    """Whether a file begins as every MCAP file does.

    Raises:
        CdmisfaError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError as error:
        raise CdmisfaError(f"{path}: {error.strerror}") from None


def identity(path: Location, reader: LogReader | None = None) -> dict[str, Any]:
    """What tells a log from others: of a file the SHA-256 of all of it.

    Of a URL, so that not every byte is read, its size and `index_sha256`: over the file from
    its data end record on, which holds the checksum of all data and where each chunk is. Where
    the index does not account for every message, `sha256` over all of it, too.

    Args:
        path: the log.
        reader: of the log; without it the file that has its path now.

    Raises:
        CdmisfaError: it cannot be read.
    """
    if isinstance(path, Path):
        return {"file": path.name, "sha256": reader.digest() if reader else sha256(path)}
    if reader is None:
        raise ValueError(f"{path} is identified by its reader")
    name = "index_sha256" if reader.by_index else "sha256"
    return {"file": path.name, "url": str(path), "bytes": reader.size, name: reader.digest()}
