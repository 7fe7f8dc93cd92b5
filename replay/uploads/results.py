"""The file or folder of a result as the objects of an S3 bucket, and back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from cdmisfa.core.errors import CdmisfaError, UsageError
from recorder.log.files import atomic_write
from replay.storage.location import Url
from replay.storage.opening import copied
from replay.uploads.objects import NOTES, Stored, is_of, objects_below, put

Progress = Callable[[float, float | None], None]
"""Told how many bytes are done, and how many there are."""


def upload(
    local: Path, url: Url, progress: Progress = lambda done, total: None
) -> tuple[int, int, list[str]]:
    """Write a file, or every file of a folder, below an address, each checked once it is there.

    What is there already with the same size and checksum is not sent again.

    Args:
        local: the file or folder.
        url: what it becomes; below it, the files of a folder.
        progress: told after each file.

    Returns:
        How many files there are, how many bytes, and what else is below the address.

    Raises:
        UsageError: there is no such file or folder, or bucket.
        UnreachableError: the server does not take it.
        CdmisfaError: the server has something else than was sent.
    """
    files = _files(local)
    there = objects_below(url)
    sizes = {rest: file.stat().st_size for rest, file in files.items()}
    done, total = 0, sum(sizes.values())
    for rest, file in files.items():
        if rest not in there or not is_of(there[rest], file):
            put(file, _below(url, rest))
        done += sizes[rest]
        progress(done, total)
    return len(files), total, sorted(there.keys() - files.keys())


def fetch(url: Url, local: Path, there: Mapping[str, Stored], progress: Progress) -> None:
    """Copy what is below an address into a folder, whole or not at all.

    Args:
        url: of the result.
        local: the folder, which is not there.
        there: what is below the address.
        progress: told after each file.

    Raises:
        UnreachableError: the server does not give it.
        LogDamagedError: it gives something else.
        CdmisfaError: there is no room for it.
    """
    done, total = 0, sum(stored.size for stored in there.values())
    with atomic_write(local) as folder:
        for rest, stored in sorted(there.items()):
            parts = rest.split("/")
            if parts[0] or {"", ".", ".."} & {*parts[1:]}:
                raise UsageError(f"{url}{rest} is no file of a result that is gone on with")
            file = folder.joinpath(*parts[1:])
            file.parent.mkdir(parents=True, exist_ok=True)
            copied(_below(url, rest), file)
            md5 = len(stored.tag) == 32  # of one part, which may be encrypted with another tag
            if file.stat().st_size != stored.size or (md5 and not is_of(stored, file)):
                raise CdmisfaError(f"{_below(url, rest)}: other bytes came than are stored")
            done += stored.size
            progress(done, total)


def _files(local: Path) -> dict[str, Path]:
    """The files of a result, by how its address goes on for each."""
    if local.is_dir():
        found = sorted(path for path in local.rglob("*") if path.is_file())
        return {f"/{path.relative_to(local).as_posix()}": path for path in found}
    if not local.is_file():
        raise UsageError(f"{local}: no such file or folder")
    notes = local.with_name(local.name + NOTES)
    return {"": local, **({NOTES: notes} if notes.is_file() else {})}


def _below(url: Url, rest: str) -> Url:
    return Url(url.address.rstrip("/") + rest)
