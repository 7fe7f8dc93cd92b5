"""Which files a log consists of."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

from cdmisfa.errors import CdmisfaError, UsageError
from recorder.logfile import PARTIAL
from replay.records import MAGIC


def log_files(paths: str | Path | Iterable[str | Path]) -> list[Path]:
    """List the MCAP files of folders, and files that are named.

    In a folder a `.partial` counts where the finished file is not there.

    Raises:
        UsageError: there is none.
    """
    if isinstance(paths, str | Path):
        paths = [paths]
    files: list[Path] = []
    for path in map(Path, paths):
        if path.is_dir():
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
