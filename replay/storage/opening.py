"""Opening what a path or a URL names, to read at any place of it."""

from __future__ import annotations

from pathlib import Path

from replay.storage.location import Location
from replay.storage.store import FileStore, Store


def open_store(place: Location) -> Store:
    """Open a file, or an object behind a URL.

    Raises:
        UsageError: there is no such file.
        LogDamagedError: the server does not give it.
        CdmisfaError: what reads URLs is not installed.
    """
    if isinstance(place, Path):
        return FileStore(place)
    from replay.storage.remote import RemoteStore

    return RemoteStore(place)
