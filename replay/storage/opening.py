"""Opening what paths and URLs name: to read at any place, or as files of this machine."""

from __future__ import annotations

import contextlib
import difflib
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.untrusted import opened_regular
from recorder.mcap.records import KINDS, MAGIC
from recorder.mcap.store import PARTIAL, FileStore, Store
from replay.storage.location import Location, Url, location


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
                raise UsageError(
                    f"{path}: no log in this folder; {KINDS}; record or learn first, or name each "
                    "video, bag, table or folder of pictures in it, or cdmisfa index all of them"
                )
            files += found
        elif path.exists():
            files.append(path)
        else:
            raise no_such(path)
    if not files:
        raise UsageError("no log was named")
    return files


def no_such(path: Path, words: Iterable[str] = (), remedy: str = "") -> UsageError:
    """The error about a path that does not exist: it names what is written nearly so.

    Args:
        path: as it was named.
        words: what else may have been meant.
        remedy: what is said where nothing is near.
    """
    if path.is_symlink():
        return UsageError(f"{path} is a link to {path.readlink()}, which is not there")
    beside = [path.parent / p.name for p in path.parent.iterdir()] if path.parent.is_dir() else ()
    known = {str(name).lower(): name for name in (*beside, *words)}
    nearest = difflib.get_close_matches(str(path).lower(), known, n=1, cutoff=0.7)
    hint = f"did you mean {known[nearest[0]]}?" if nearest else remedy
    return UsageError(f"{path}: no such file or folder{hint and ': '}{hint}")


def _listed(url: Url) -> list[Location]:
    """The logs right below an S3 prefix, as those of a folder; any other URL as itself."""
    if not url.folder:
        return [url]
    from replay.storage.servers import ask_s3

    entries = ask_s3(url, lambda files: files._ls(url.address, detail=True, refresh=True))
    names = sorted(str(entry["name"]) for entry in entries)
    logs = [n for n in names if n.removesuffix(PARTIAL).endswith(".mcap")]
    if not logs:
        raise UsageError(f"{url}: no .mcap file below this prefix")
    return [Url(f"s3://{n}") for n in logs if n.removesuffix(PARTIAL) not in {*logs} - {n}]


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


def starts_as_log(path: Path) -> bool:
    """Whether a file begins as every MCAP file does.

    Raises:
        UsageError: it is no regular file, or may not be read.
        LogDamagedError: the disk does not give it.
    """
    with opened_regular(path) as file:
        return file.read(len(MAGIC)) == MAGIC


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
