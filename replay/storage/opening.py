"""Opening what a path or a URL names: to read at any place of it, or as files of this machine."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from cdmisfa.core.errors import CdmisfaError
from recorder.mcap.store import FileStore, Store
from replay.storage.listing import log_files
from replay.storage.location import Location, Url, location


def open_store(place: str | Location) -> Store:
    """Open a file, or an object behind a URL.

    Raises:
        UsageError: there is no such file.
        LogDamagedError: the server does not give it.
        CdmisfaError: what reads URLs is not installed.
    """
    place = location(place)
    if isinstance(place, Path):
        return FileStore(place)
    from replay.storage.remote import RemoteStore

    return RemoteStore(place)


@contextlib.contextmanager
def fetched(place: Location) -> Iterator[Path]:
    """Give a path as it is, and a URL as a copy that is gone afterwards.

    Raises:
        UsageError: there is no such object.
        LogDamagedError: the server sends less than it says, or something else.
        CdmisfaError: the server does not give it, or there is no room for it.
    """
    if not isinstance(place, Url):
        yield place
        return
    with tempfile.TemporaryDirectory(prefix="cdmisfa-") as temporary:
        folder = Path(temporary) / (place if place.folder else place.parent).name
        folder.mkdir()
        for log in log_files(place):
            copied(log, folder / log.name)
        yield folder if place.folder else folder / place.name


def copied(log: Location, target: Path) -> None:
    """Copy what a path or a URL names into a file that is not there.

    Raises:
        UsageError: there is no such object.
        LogDamagedError: the server sends less than it says, or something else.
        CdmisfaError: the server does not give it, or there is no room for it.
    """
    with contextlib.closing(open_store(log)) as source:
        try:
            if source.size > (room := shutil.disk_usage(target.parent).free):
                raise CdmisfaError(
                    f"{log}: it has {source.size} bytes, and there is room for {room} at "
                    f"{target.parent}: set TMPDIR"
                )
            with target.open("xb") as copy:
                for block in source.blocks(0, source.size):
                    copy.write(block)
        except OSError as error:
            raise CdmisfaError(f"{log}: cannot be copied to {target}: {error.strerror}") from None
