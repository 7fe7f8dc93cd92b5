"""What a run states for good: what it learned from, its signals, and what lies beside its log."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from replay.runs.folders import MODULES_FILE, read_run_json
from replay.runs.log import read_header
from replay.storage.identity import file_sha256

_FILES: Final = ("files", "views")
"""Where sources state their files, each as a table."""

_WHOLE: Final = "sha256"
_HASHES: Final = {_WHOLE, "sample_sha256"}
_KNOWN: Final = {*_HASHES, "bytes"}
"""What is known of a file before all of it was read, or only then."""


def final_record(
    folder: Path, document: Mapping[str, Any], signals: str, *, view: bool
) -> dict[str, str]:
    """What a run's log states last, of a folder that holds its modules already.

    Args:
        folder: of the run.
        document: what its run.json states.
        signals: the SHA-256 of its signals.
        view: whether it has a view, too.
    """
    return {
        "signals_sha256": signals,
        "modules_sha256": file_sha256(folder / MODULES_FILE),
        "facts_sha256": facts_sha256(document),
        "view": json.dumps(view),
    }


def facts_sha256(document: Mapping[str, Any]) -> str:
    """SHA-256 of what a run.json states, but for where the run lies and how it was called."""
    facts = {key: value for key, value in document.items() if key != "command"}
    if isinstance(result := facts.get("result"), Mapping):
        facts["result"] = {key: value for key, value in result.items() if key != "run"}
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def stated_source(log: Path) -> Any:
    """What a run states of its source: in its log, and of large files once it ended in run.json.

    Args:
        log: of the run.

    Raises:
        UsageError: it is no run's log.
        LogDamagedError: it cannot be read.
    """

    def ended(file: Mapping[str, Any], at_end: Mapping[str, Any]) -> Mapping[str, Any]:
        large = "sample_sha256" in file and _WHOLE in at_end
        return {**file, _WHOLE: at_end[_WHOLE]} if large else file

    stated = read_header(log).manifest.get("source")
    return _of_each(stated, read_run_json(log.parent).get("source"), ended)


def states_whole(source: Any) -> bool:
    """Whether a source states the SHA-256 of all of a file."""
    return any(_WHOLE in file for key in _FILES for file in _tables(source, key))


def known_to_both(one: Any, other: Any) -> tuple[Any, Any]:
    """What two sources state, less what only one of them knows of a file and the other does not."""

    def known(file: Mapping[str, Any], to: Mapping[str, Any]) -> Mapping[str, Any]:
        shared = file.keys() & to.keys()
        left_out = _KNOWN - shared if shared & _HASHES else set()
        return {key: value for key, value in file.items() if key not in left_out}

    return _of_each(one, other, known), _of_each(other, one, known)


def other_files(one: Any, another: Any) -> list[str]:
    """Names of the files of a source that are not those of another, by what both know of them."""
    found = []
    for key in _FILES:
        own, others = _tables(one, key), _tables(another, key)
        if len(own) == len(others):
            found += [
                str(file.get("file"))
                for file, like in zip(own, others, strict=True)
                if any(file[known] != like[known] for known in _HASHES & file.keys() & like.keys())
            ]
    return found


def _of_each(
    one: Any,
    other: Any,
    change: Callable[[Mapping[str, Any], Mapping[str, Any]], Mapping[str, Any]],
) -> Any:
    """A source, with each of its files changed by what another says of the same one."""
    found = one
    for key in _FILES:
        own, others = _tables(one, key), _tables(other, key)
        if own and len(own) == len(others):
            changed = [change(file, like) for file, like in zip(own, others, strict=True)]
            found = {**found, key: changed}
    return found


def _tables(source: Any, key: str) -> list[Mapping[str, Any]]:
    files = source.get(key) if isinstance(source, Mapping) else None
    if isinstance(files, list) and all(isinstance(file, Mapping) for file in files):
        return files
    return []
