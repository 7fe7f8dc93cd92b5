"""Which world a run or a recording was in, as far as the logs that are there say it."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from cdmisfa.core.errors import CdmisfaError, LogDamagedError
from cdmisfa.core.untrusted import parse_json
from recorder.log.scenery import KIND, NECK, Scenery, scenery_of
from recorder.log.viewlog import CONFIG_NAME
from recorder.mcap.reader import LogReader
from replay.recordings.poses import first_pose
from replay.runs.log import RunHeader
from replay.storage.opening import log_files, open_store

PRESET = (
    "the recording that it learned from is not where it was: the table, the eyes and the sizes of "
    "the objects are those of the scene's preset"
)


def world_of_run(
    header: RunHeader, run: Path, recording: Path | None = None
) -> tuple[Scenery | None, str | None]:
    """What stood where in a run, and what is not sure about it.

    Args:
        header: of its log.
        run: its folder.
        recording: which it learned from, where that is known.

    Returns:
        No world where the run was in none that is described here.
    """
    source = _table(header.manifest.get("source"))
    if source.get("kind") == KIND:
        return _told(_table(source.get("scene")))
    if source.get("scene") != KIND:
        return None, None
    for place in _places(header, run, recording):
        with contextlib.suppress(CdmisfaError, OSError):
            found = world_of_recording(place, sha256=str(source.get("config_sha256")))
            if found is not None:
                return found, None
    scenery, _ = _told(_table(_table(header.manifest.get("config")).get("scene")))
    return scenery, PRESET if scenery is not None else None


def world_of_recording(path: Path, sha256: str | None = None) -> Scenery | None:
    """What stood where in a recording.

    Args:
        path: of the recording.
        sha256: the checksum that its configuration must have.

    Returns:
        None of other scenes and recordings.

    Raises:
        UsageError: there is no such recording.
        LogDamagedError: it cannot be read.
    """
    data, pose = b"{}", None
    for file in log_files(path):  # the first has it, unless they are many
        with LogReader(open_store(file)) as reader:
            if own := [entry for entry in reader.attachments if entry.name == CONFIG_NAME]:
                data, pose = bytes(reader.attachment_data(own[0])), first_pose(reader)
                break
    if sha256 is not None and hashlib.sha256(data).hexdigest() != sha256:
        return None
    try:
        config = _table(_table(parse_json(data)).get("scene"))
    except ValueError as error:
        raise LogDamagedError(f"{file}: its {CONFIG_NAME} is broken ({error})") from error
    return scenery_of(config, NECK if pose is None else pose.position)


def _places(header: RunHeader, run: Path, recording: Path | None) -> Iterator[Path]:
    """Where the recording may be that a run learned from."""
    if recording is not None:
        yield recording
    named = _table(header.manifest.get("command")).get("source")
    for name in named if isinstance(named, list) else []:
        with contextlib.suppress(OSError, ValueError):
            if (place := run / str(name)).exists():
                yield place


def _told(config: Mapping[str, Any]) -> tuple[Scenery | None, str | None]:
    try:
        return scenery_of(config), None
    except LogDamagedError as error:
        return None, str(error)


def _table(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
