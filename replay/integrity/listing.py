"""Find all logs below folders by listing them, without opening any."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from cdmisfa.core.errors import CdmisfaError, UsageError
from recorder.mcap.store import PARTIAL
from replay.integrity.report import LogReport, failed
from replay.logs.formats.images import ENDINGS as IMAGE_ENDINGS
from replay.logs.open_logs import ENDINGS, log_format
from replay.open_sources import locations
from replay.runs.folders import RUN_FILE
from replay.storage.location import is_url
from replay.storage.paths import no_such

# Name of the index file in the folder that it indexes.
INDEX: Final = "corpus.parquet"

_LOGS: Final = frozenset((".mcap", *ENDINGS))
_RUN: Final = frozenset((RUN_FILE, RUN_FILE + PARTIAL))


class ListedLog(NamedTuple):
    """A log: a file, or a folder that is opened as one.

    Attributes:
        file: path or URL; a name that is not UTF-8 is escaped.
        bytes: size.
        changed: time of the last change in nanoseconds; "" for a URL, or if it cannot be read.
        problem: why it cannot be opened, or "".
        path: its name in an index, or "".
    """

    file: str
    bytes: int = 0
    changed: str = ""
    problem: str = ""
    path: str = ""


def find_logs(words: Sequence[str | Path]) -> Iterator[ListedLog]:
    """Yield the logs that words name, and all logs below folders; each folder is listed once.

    Raises:
        UsageError: a word names nothing.
    """
    listed: set[tuple[int, int]] = set()
    for word in words:
        if is_url(word):
            yield ListedLog(str(word))
            continue
        for place in locations([word]):
            if place.is_dir():
                yield from _below(str(place), listed)
            else:
                yield _log_file(str(place))


def each_report(
    place: Path, read: Callable[[Path], LogReport], alone: bool = True
) -> Iterator[LogReport]:
    """Yield the report of each log in a folder and below it, as `index` lists them; of a file, its.

    Args:
        place: the folder or file.
        read: returns the report of a log.
        alone: raise the error of the only log instead of reporting it.

    Raises:
        CdmisfaError: the only log cannot be read, or there is none.
    """
    logs = list(find_logs([place])) if place.is_dir() else [ListedLog(str(place))]
    logs = logs or [ListedLog(str(place), problem="no log is in this folder or below it")]
    for log in logs:
        try:
            if not place.exists():
                raise no_such(place)
            if log.problem:
                raise UsageError(f"{log.file}: {log.problem}")
            yield read(Path(log.file))
        except CdmisfaError as error:
            if alone and len(logs) == 1:
                raise
            yield failed(log.file, error)


def may_be_corpus(words: Sequence[str | Path]) -> bool:
    """Return whether words are a folder that has an index, or a file that may be one."""
    if len(words) != 1:
        return False
    place = Path(words[0])
    # `os.path` says no of a name that is too long, where `Path` raises.
    return os.path.isfile(place / INDEX) or (place.suffix == ".parquet" and place.is_file())


def size_and_time(place: Path) -> tuple[int, str]:
    """Return size and time of change of a log on this machine, as `ListedLog` has them.

    Raises:
        OSError: the log does not exist.
    """
    files = [path for path in place.rglob("*") if path.is_file()] if place.is_dir() else [place]
    states = [os.stat(file) for file in files]
    changed = max((state.st_mtime_ns for state in states), default=0)
    return sum(state.st_size for state in states), str(changed)


def _below(root: str, listed: set[tuple[int, int]]) -> Iterator[ListedLog]:
    """Yield the logs in a folder and all folders below it; links in a circle end."""
    errors: list[OSError] = []
    for folder, folders, files in os.walk(root, followlinks=True, onerror=errors.append):
        state = os.stat(folder)
        names = {*folders, *files}
        format = _format_of_folder(folder, names)
        if format in ("bag", "dataset", "images"):
            yield _log_file(folder)
        if (state.st_dev, state.st_ino) in listed or format in ("bag", "dataset"):
            folders.clear()
            continue
        listed.add((state.st_dev, state.st_ino))
        folders.sort()
        run = names & _RUN
        if run:
            folders.clear()  # a run keeps no further logs below it
        for name in sorted(run or files):
            whole = name.removesuffix(PARTIAL)
            partial = name.endswith(f".mcap{PARTIAL}") and whole not in names
            ending = os.path.splitext(name)[1].lower()
            if name != INDEX and (partial or ending in _LOGS):
                yield _log_file(os.path.join(folder, name))
    for error in errors:
        yield ListedLog(_escaped(error.filename), problem=f"cannot be read: {error.strerror}")


def _format_of_folder(folder: str, names: set[str]) -> str:
    """Return the format of a folder that is one log; "mcap" for a folder of logs."""
    images = any(os.path.splitext(name)[1].lower() in IMAGE_ENDINGS for name in names)
    if names & _RUN or not (images or names & {"metadata.yaml", "meta"}):
        return "mcap"
    try:
        return log_format(Path(folder))
    except (CdmisfaError, OSError):
        return "mcap"


def _log_file(name: str) -> ListedLog:
    if (escaped := _escaped(name)) != name:
        return ListedLog(escaped, problem="its name is not UTF-8: rename it")
    try:
        return ListedLog(name, *size_and_time(Path(name)))
    except OSError as error:
        return ListedLog(name, problem=f"cannot be read: {error.strerror}")


def _escaped(name: str) -> str:
    return os.fsencode(name).decode(errors="backslashreplace")
