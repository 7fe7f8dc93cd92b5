"""Find the logs that words name and all logs below folders: names, sizes, when they changed.

No log is opened for this, and no more is asked of the file system than what a folder lists.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from cdmisfa.core.errors import CdmisfaError
from recorder.mcap.store import PARTIAL
from replay.inputs import locations
from replay.logs.formats.images import ENDINGS as IMAGE_ENDINGS
from replay.logs.opening import ENDINGS, log_format
from replay.runs.folders import RUN_FILE
from replay.storage.location import is_url

INDEX: Final = "corpus.parquet"
"""Name of the index of a folder, in it."""

_LOGS: Final = frozenset((".mcap", *ENDINGS))
_RUN: Final = frozenset((RUN_FILE, RUN_FILE + PARTIAL))


class Found(NamedTuple):
    """A log, a file or a folder that is one.

    Attributes:
        file: its name, as it is opened; of a name that is not UTF-8 as it can be written.
        bytes: of it.
        changed: what differs when it was written again: the time of its last change in
            nanoseconds; "" of a URL, and where it cannot be opened.
        problem: why it cannot be opened.
        path: what it is called in an index; "" before it is in one.
    """

    file: str
    bytes: int = 0
    changed: str = ""
    problem: str = ""
    path: str = ""


def found_logs(words: Sequence[str | Path]) -> Iterator[Found]:
    """The logs that words name, in the order of names within each folder.

    A folder is listed once, by whichever links lead there.

    Raises:
        UsageError: a word names nothing.
    """
    seen: set[tuple[int, int]] = set()
    for word in words:
        if is_url(word):
            yield Found(str(word))
            continue
        for place in locations([word]):
            if place.is_dir():
                yield from _below(str(place), seen)
            else:
                yield _file(place)


def may_be_corpus(words: Sequence[str | Path]) -> bool:
    """Return whether words are a folder that has an index, or a file that may be one."""
    if len(words) != 1:
        return False
    place = Path(words[0])
    # `os.path` says no of a name that is too long, where `Path` raises.
    return os.path.isfile(place / INDEX) or (place.suffix == ".parquet" and place.is_file())


def state_of_log(place: Path) -> tuple[int, str]:
    """Bytes of a log on this machine and when it changed, as `Found` has them.

    Raises:
        OSError: it is not there.
    """
    if place.is_dir():
        return _state_of_folder(place)
    state = os.stat(place)
    return state.st_size, str(state.st_mtime_ns)


def _file(place: Path) -> Found:
    try:
        return _named(str(place), *state_of_log(place))
    except OSError as error:
        return _named(str(place), problem=_why(error))


def _below(root: str, seen: set[tuple[int, int]]) -> Iterator[Found]:
    """The logs of a folder and of those in it, down to the last."""
    folders = [root]
    while folders:
        folder = folders.pop()
        try:
            state = os.stat(folder)
            if (state.st_dev, state.st_ino) in seen:
                continue
            seen.add((state.st_dev, state.st_ino))
            with os.scandir(folder) as listed:
                entries = sorted(listed, key=lambda entry: entry.name)
        except OSError as error:
            yield _named(folder, problem=_why(error))
            continue
        names = {entry.name for entry in entries}
        kind = _kind_of(folder, names)
        if kind in ("bag", "dataset", "pictures"):
            yield _file(Path(folder))
        if kind in ("bag", "dataset"):
            continue
        run = names & _RUN
        folders += [] if run else [e.path for e in reversed(entries) if _is_folder(e)]
        yield from _files_of([e for e in entries if e.name in run] if run else entries, names)


def _kind_of(folder: str, names: set[str]) -> str:
    """The format of the log that a folder is; "mcap" or "split" where its files are logs."""
    hints = any(os.path.splitext(name)[1].lower() in IMAGE_ENDINGS for name in names)
    if not (hints or names & {"metadata.yaml", "meta"}) or names & _RUN:
        return "mcap"
    try:
        return log_format(Path(folder))
    except (CdmisfaError, OSError):
        return "mcap"


def _files_of(entries: Sequence[os.DirEntry[str]], names: set[str]) -> Iterator[Found]:
    """The logs among what a folder lists; a partial one where the whole one is not there."""
    for entry in entries:
        whole = entry.name.removesuffix(f".mcap{PARTIAL}")
        partial = whole != entry.name and f"{whole}.mcap" not in names
        ending = os.path.splitext(entry.name)[1].lower()
        if entry.name == INDEX or not (partial or ending in _LOGS) or _is_folder(entry):
            continue
        try:
            state = entry.stat()
            yield _named(entry.path, state.st_size, str(state.st_mtime_ns))
        except FileNotFoundError as error:
            if entry.is_symlink():
                yield _named(entry.path, problem=_why(error))
        except OSError as error:
            yield _named(entry.path, problem=_why(error))


def _state_of_folder(folder: Path) -> tuple[int, str]:
    states = [path.stat() for path in folder.rglob("*") if path.is_file()]
    last = max((state.st_mtime_ns for state in states), default=0)
    return sum(state.st_size for state in states), str(last)


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # a link that leads to itself
        return False


def _named(name: str, size: int = 0, changed: str = "", problem: str = "") -> Found:
    try:
        name.encode()
    except UnicodeEncodeError:
        name = os.fsencode(name).decode(errors="backslashreplace")
        problem = "its name is not UTF-8: give it another"
    return Found(name, size, changed, problem)


def _why(error: OSError) -> str:
    return f"it cannot be read: {error.strerror or error}"
