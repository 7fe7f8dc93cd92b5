"""Which files a log consists of."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from cdmisfa.errors import CdmisfaError, UsageError
from recorder.logfile import PARTIAL
from replay.reader import LogReader
from replay.records import MAGIC
from replay.store import Location, Url, location


def log_files(paths: str | Location | Iterable[str | Location]) -> list[Location]:
    """List the MCAP files of folders and of S3 prefixes, and files that are named.

    In a folder a `.partial` counts where the finished file is not there.

    Raises:
        UsageError: there is none.
        LogDamagedError: a server does not list it.
    """
    if isinstance(paths, str | Path | Url):
        paths = [paths]
    files: list[Location] = []
    for path in map(location, paths):
        if isinstance(path, Url):
            files += _listed(path)
        elif path.is_dir():
            whole = sorted(path.glob("*.mcap"))
            cut = sorted(path.glob(f"*.mcap{PARTIAL}"))
            found = whole + [p for p in cut if p.with_suffix("") not in whole]
            if not found:
                raise UsageError(f"{path}: no .mcap file in this folder; record or learn first")
            files += found
        elif path.exists():
            files.append(path)
        else:
            raise UsageError(f"{path}: no such file or folder")
    if not files:
        raise UsageError("no log was named")
    return files


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
        reader: of the log behind a URL.

    Raises:
        CdmisfaError: it cannot be read.
    """
    if isinstance(path, Path):
        return {"file": path.name, "sha256": sha256(path)}
    if reader is None:
        raise ValueError(f"{path} is identified by its reader")
    name = "index_sha256" if reader.by_index else "sha256"
    return {"file": path.name, "url": str(path), "bytes": reader.size, name: reader.digest()}


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


def _listed(url: Url) -> list[Location]:
    """An S3 prefix as its logs, as in a folder; any other URL as itself."""
    if not url.folder:
        return [url]
    from replay.remote import listed

    found = listed(url)
    whole = {log.name for log in found}
    return [log for log in found if log.name.removesuffix(PARTIAL) not in whole - {log.name}]
