"""Words of a command line as places: paths, URLs, and patterns of both."""

from __future__ import annotations

import fnmatch
import glob
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from cdmisfa.core.errors import UsageError
from replay.camera_logs.formats.bag import BAGS
from replay.camera_logs.formats.picture_folder import PICTURES, by_number
from replay.camera_logs.formats.table import TABLES
from replay.camera_logs.formats.video import VIDEOS
from replay.storage.location import Location, Url, location
from replay.storage.opening import log_files

_WHOLE: Final = frozenset((*VIDEOS, *BAGS, *TABLES, *PICTURES))
"""Endings of files that are read whole, and so by their paths alone."""


def places(words: Sequence[str | Location]) -> list[Location]:
    """The places that words name, in their order; a pattern names what matches, by number.

    Raises:
        UsageError: nothing matches a pattern, or a URL is of a kind that is not read.
    """
    found: list[Location] = []
    for word in words:
        found += _matches(word) if isinstance(word, str) and _is_pattern(word) else [location(word)]
    for place in found:
        if isinstance(place, Url) and place.suffix.lower() in _WHOLE:
            raise UsageError(f"{place}: of URLs MCAP logs are read: copy this file here first")
    return found


def _is_pattern(word: str) -> bool:
    return any(letter in word for letter in "*?[") and not Path(word).exists()


def _matches(word: str) -> list[Location]:
    if "://" not in word:
        matched = [Path(name) for name in glob.glob(word, recursive=True)]
        matched = [path for path in matched if path.suffix not in (".rrd", ".json")]
        if not matched:
            raise UsageError(f"{word}: no file or folder matches")
        return [*sorted(matched, key=by_number)]
    if not word.startswith("s3://"):
        return [location(word)]  # a question mark of a web address, and servers list nothing
    folder, _, pattern = word.rpartition("/")
    if _is_pattern(folder):
        raise UsageError(f"{word}: a pattern is the last part of an s3:// address only")
    listed = [log for log in log_files(location(folder)) if fnmatch.fnmatchcase(log.name, pattern)]
    if not listed:
        raise UsageError(f"{word}: no log matches")
    return [log for log in listed if isinstance(log, Url)]
