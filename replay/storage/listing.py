"""Which files a log consists of."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from cdmisfa.core.errors import UsageError
from recorder.mcap.store import PARTIAL
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
                    f"{path}: no .mcap file in this folder; record or learn first, or name each "
                    "video, bag or folder of pictures in it"
                )
            files += found
        elif path.exists():
            files.append(path)
        else:
            raise UsageError(f"{path}: no such file or folder")
    if not files:
        raise UsageError("no log was named")
    return files


def _listed(url: Url) -> list[Location]:
    """An S3 prefix as its logs, as in a folder; any other URL as itself."""
    if not url.folder:
        return [url]
    from replay.storage.servers import listed

    found = listed(url)
    whole = {log.name for log in found}
    return [log for log in found if log.name.removesuffix(PARTIAL) not in whole - {log.name}]
