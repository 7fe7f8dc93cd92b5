"""Provenance of a run: the hashes of its closing record, and of the files it learned from.

A run's header states what is known of the source files when it starts: their size, and a SHA-256
of all bytes or, of large files, of a sample. `run.json` adds the SHA-256 of all bytes at the end.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from replay.runs.folders import MODULES_FILE, read_run_json
from replay.runs.log import read_header
from replay.storage.identity import file_sha256

# Keys under which a source's description lists its files, each as a table.
FILE_LISTS = ("files", "views")

WHOLE = "sha256"
SAMPLE = "sample_sha256"
HASHES = {WHOLE, SAMPLE}

# Description of a source file: its name, size and hashes.
File = Mapping[str, Any]


def final_record(
    folder: Path, document: Mapping[str, Any], signals: str, *, view: bool
) -> dict[str, str]:
    """Return the closing record of a run, by which `verify` proves its folder.

    Args:
        folder: folder of the run, with its modules.
        document: contents of its run.json.
        signals: SHA-256 of its signals.
        view: whether the folder holds a Rerun recording, too.
    """
    return {
        "signals_sha256": signals,
        "modules_sha256": file_sha256(folder / MODULES_FILE),
        "facts_sha256": facts_sha256(document),
        "view": json.dumps(view),
    }


def facts_sha256(document: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a run.json without the command and the folder's path."""
    facts = {key: value for key, value in document.items() if key != "command"}
    if isinstance(result := facts.get("result"), Mapping):
        facts["result"] = {key: value for key, value in result.items() if key != "run"}
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def stated_source(log: Path) -> Any:
    """Return the source of a run as its log states it, with the final hashes of large files.

    Raises:
        UsageError: the log is not that of a run.
        LogDamagedError: the log cannot be read.
    """

    def with_final_hash(file: File, final: File) -> File:
        return {**file, WHOLE: final[WHOLE]} if SAMPLE in file and WHOLE in final else file

    stated = read_header(log).manifest.get("source")
    return _update_files(stated, read_run_json(log.parent).get("source"), with_final_hash)


def has_whole_hashes(source: Any) -> bool:
    """Return whether a source states the SHA-256 of all bytes of one of its files."""
    return any(WHOLE in file for key in FILE_LISTS for file in _files(source, key))


def comparable(first: Any, second: Any) -> tuple[Any, Any]:
    """Return two sources without the hashes and sizes that only one of them states."""

    def shared_facts(file: File, other: File) -> File:
        shared = file.keys() & other.keys()
        dropped = HASHES | {"bytes"} if shared & HASHES else set()
        return {k: value for k, value in file.items() if k in shared or k not in dropped}

    return _update_files(first, second, shared_facts), _update_files(second, first, shared_facts)


def changed_files(source: Any, present: Any) -> list[str]:
    """Return the names of a source's files that are missing or differ among the present ones.

    Only hashes that both sources state are compared.
    """
    changed = []
    for key in FILE_LISTS:
        files, paired = _files(source, key), _files(present, key)
        if len(files) == len(paired):
            changed += [
                file
                for file, other in zip(files, paired, strict=True)
                if any(file[k] != other[k] for k in HASHES & file.keys() & other.keys())
            ]
        elif paired:
            names = {file.get("file") for file in paired}
            changed += [file for file in files if file.get("file") not in names]
    return [str(file.get("file")) for file in changed]


def _update_files(source: Any, other: Any, update: Callable[[File, File], File]) -> Any:
    """Return a source whose files are updated by the files of another source, pair by pair."""
    updated = source
    for key in FILE_LISTS:
        files, paired = _files(source, key), _files(other, key)
        if files and len(files) == len(paired):
            updated = {**updated, key: [update(*pair) for pair in zip(files, paired, strict=True)]}
    return updated


def _files(source: Any, key: str) -> list[File]:
    files = source.get(key) if isinstance(source, Mapping) else None
    if isinstance(files, list) and all(isinstance(file, Mapping) for file in files):
        return files
    return []
