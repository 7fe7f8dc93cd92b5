"""What the index says of one log: a row a stream, one with the problem where it cannot be read."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.core.untrusted import parse_json
from recorder.log.messages import view_topic
from recorder.mcap.reader import LogReader
from recorder.mcap.records import MalformedRecord, Segment
from replay.arrays import are_arrays
from replay.camera_logs.alignment import Times, missing
from replay.camera_logs.opening import identity_of, image_topics, only_foreign, open_images
from replay.corpus.finding import state_of_log
from replay.integrity.counting import read_once
from replay.integrity.info import ChannelInfo, LogInfo, describe_log, describe_reader
from replay.integrity.state import failed_state
from replay.storage.identity import FilesIdentity, Identity, LogIdentity
from replay.storage.location import is_url, location

VERSION: Final = 1
"""Rises whenever a column changes its meaning."""

MARK: Final = b"cdmisfa.corpus"
"""Key of the Parquet file's metadata that holds the version."""

MOST_TEXT: Final = 64 * 1024
"""Letters of a configuration that is kept."""

MOST_SAID: Final = 500
"""Letters of a problem that are kept."""

_WORD: Final = pa.dictionary(pa.int32(), pa.string())

SCHEMA: Final = pa.schema(
    [
        ("path", pa.string()),
        ("log", pa.string()),
        ("bytes", pa.int64()),
        ("changed", pa.string()),
        ("number", pa.int32()),
        ("kind", _WORD),
        ("topic", _WORD),
        ("encoding", _WORD),
        ("schema", _WORD),
        ("shape", _WORD),
        ("messages", pa.int64()),
        ("rate", pa.float64()),
        ("start_ns", pa.int64()),
        ("end_ns", pa.int64()),
        ("seconds", pa.float64()),
        ("gaps", pa.int64()),
        ("compression", _WORD),
        ("identity", pa.string()),
        ("sha256", pa.string()),
        ("content", pa.string()),
        ("contents", pa.string()),
        ("crc", _WORD),
        ("state", _WORD),
        ("seed", pa.int64()),
        ("configuration", _WORD),
        ("problem", pa.string()),
        ("deep", pa.bool_()),
    ],
    metadata={MARK: str(VERSION).encode()},
)
"""Columns of the index; docs/how-to/corpus.md says what each is."""


class Task(NamedTuple):
    """A log to be looked at.

    Attributes:
        file: what is opened.
        path: what it is called in the index.
        bytes: see `Found`.
        changed: see `Found`.
        problem: see `Found`; then it is not opened.
        sha256: of all its bytes as the index has it, which tells whether it changed.
    """

    file: str
    path: str
    bytes: int
    changed: str
    problem: str = ""
    sha256: str | None = None


class Answer(NamedTuple):
    """Rows of some logs.

    Attributes:
        rows: of them.
        looked: paths of those that are not as they were.
        gone: paths of those of them that are not there any more.
    """

    rows: pa.Table
    looked: Sequence[str]
    gone: Sequence[str]


def look(tasks: Sequence[Task], deep: bool, full: bool) -> Answer:
    """Look at some logs.

    Args:
        tasks: which.
        deep: decode them, for checksums, gaps, shapes, and what their messages are.
        full: read all of their bytes, for their SHA-256.
    """
    rows: list[dict[str, Any]] = []
    looked, gone = [], []
    for task in tasks:
        try:
            found = [] if task.problem else list(_rows_of(location(task.file), task, deep, full))
        except _SameError:
            continue
        except Exception as raised:  # whatever a broken file makes a library of others raise
            if not (is_url(task.file) or os.path.lexists(task.file)):
                looked.append(task.path)
                gone.append(task.path)
                continue
            error = _as_ours(raised)
            crc, state = failed_state(error)
            task = task._replace(problem=str(error).removeprefix(f"{task.file}: "))
            found = [{"crc": crc, "state": state}]
        looked.append(task.path)
        contents = _contents(found)
        for number, row in enumerate(found or [{"state": "not read"}]):
            rows.append({**_row(task, row, deep), "number": number, "contents": contents})
    return Answer(pa.Table.from_pylist(rows, SCHEMA), looked, gone)


def _as_ours(raised: Exception) -> CdmisfaError:
    if isinstance(raised, CdmisfaError):
        return raised
    said = raised.strerror if isinstance(raised, OSError) else None
    return LogDamagedError(said or f"{type(raised).__name__}: {raised}")


class _SameError(Exception):
    """A log has the bytes that it had."""


def _row(task: Task, row: Mapping[str, Any], deep: bool) -> dict[str, Any]:
    path = task.path
    own = {"path": path, "log": path, "bytes": task.bytes, "changed": task.changed, "deep": deep}
    problem = "; ".join(filter(None, (task.problem, row.get("problem")))) or None
    return {**own, **row, "problem": problem and _said(problem)}


def _contents(rows: Sequence[Mapping[str, Any]]) -> str | None:
    """A checksum of the messages of a log, in whatever order its streams are."""
    known = sorted((row["topic"], row["content"]) for row in rows if row.get("content"))
    return hashlib.sha256(json.dumps(known).encode()).hexdigest() if known else None


def _rows_of(place: Path, task: Task, deep: bool, full: bool) -> Iterator[dict[str, Any]]:
    sha256 = None
    if full:
        sha256 = _all_bytes(place)
        if sha256 == task.sha256:
            raise _SameError
    info, identity, contents = _described(place, deep)
    problems = [f"{p.where}: {p.what}" for p in info.problems]
    if not is_url(task.file) and state_of_log(place) != (task.bytes, task.changed):
        problems.append("it changed while it was indexed: index again")
    records = [record for found in info.metadata.values() for record in found.values()]
    stated = {name: value for record in records for name, value in record.items()}
    about = {
        "log": _log_of(task.path, info),
        "bytes": task.bytes or info.size.file,
        "kind": info.kind,
        "compression": " ".join(sorted(info.size.compression)) or None,
        "identity": identity,
        "sha256": sha256,
        "crc": info.crc,
        "state": info.state,
        "seed": info.seed if info.seed is None or -(2**63) <= info.seed < 2**63 else None,
        "configuration": _configuration(stated),
        "problem": "; ".join(problem.replace(f"{place}: ", "") for problem in problems),
    }
    view = stated if info.kind == "recording" else {}
    for channel, content in zip(info.channels, contents, strict=True):
        yield {**about, **_stream(channel, view), **content}
    if not info.channels:
        yield about


def _stream(channel: ChannelInfo, view: Mapping[str, str]) -> dict[str, Any]:
    """What a summary says of a channel; of the frames of a recording, how many are missing, too."""
    start, end, rate = channel.start_ns, channel.end_ns, channel.rate
    found: dict[str, Any] = {
        "topic": channel.topic,
        "encoding": channel.encoding,
        "schema": channel.schema,
        "messages": channel.messages,
        "rate": rate,
        "start_ns": start if start is None or start < 2**63 else None,
        "end_ns": end if end is None or end < 2**63 else None,
        "seconds": None if start is None or end is None else (end - start) / 1e9,
    }
    if channel.topic == view_topic(view.get("view", "")) and found["seconds"] is not None:
        found["shape"] = view.get("frame_shape", "").replace(",", "x")
        with contextlib.suppress(ValueError):
            frames = round(found["seconds"] * float(view.get("fps", ""))) + 1
            found |= {"rate": float(view["fps"]), "gaps": max(frames - channel.messages, 0)}
    elif channel.encoding == "numpy":
        found["shape"] = channel.schema.partition(" ")[2]
    return found


def _described(place: Path, deep: bool) -> tuple[LogInfo, str | None, Sequence[Mapping[str, Any]]]:
    """A log, its identity, and what its messages were found to be, of each channel."""
    if only_foreign(place) or are_arrays([place]):
        info = describe_log(place, decode=deep)
        contents = [_shown(place, c.topic) if deep else {} for c in info.channels]
        return info, _hash_of(identity_of(place, ())), contents
    with LogReader(place, salvage=True, check="chunks") as reader:
        identity = _hash_of(LogIdentity(reader))
        if not deep:
            info = describe_reader(reader, decode=False)
            return info, identity, [{} for _ in info.channels]

    def all_of(reader: LogReader) -> tuple[LogInfo, list[dict[str, Any]]]:
        content = _Content(reader)
        return describe_reader(reader, decode=True, told=content.add), content.found()

    info, found = read_once(place, all_of)
    if info.kind != "foreign":
        return info, identity, found
    images = set(image_topics(place))
    pairs = zip(info.channels, found, strict=True)
    shown = ({**own, **_shown(place, c.topic)} if c.topic in images else own for c, own in pairs)
    return info, identity, list(shown)


class _Content:
    """What the messages of each channel of a log are, and when."""

    def __init__(self, reader: LogReader) -> None:
        self._reader = reader
        self._hashes: dict[int, Any] = {}
        self._times: dict[int, list[Times]] = {}

    def add(self, segment: Segment) -> None:
        """Take the messages of a chunk in."""
        table = self._reader.table(segment)
        if table is None:
            return
        for number in np.unique(table.channel).tolist():
            own = table.select(table.channel == number)
            self._times.setdefault(number, []).append(own.log_time.copy())
            digest = self._hashes.setdefault(number, hashlib.sha256())
            for _, _, log_time, _, data in own.rows():
                digest.update(struct.pack("<QQ", log_time, len(data)))
                digest.update(data)

    def found(self) -> list[dict[str, Any]]:
        """A checksum of times and messages of each channel, in their order, and its gaps."""
        known: list[dict[str, Any]] = []
        for number in sorted({*self._reader.channels, *self._hashes}):
            digest = self._hashes.get(number)
            times = np.sort(np.concatenate(self._times.get(number, [np.empty(0, np.uint64)])))
            content = None if digest is None else digest.hexdigest()
            known.append({"content": content, "gaps": missing(times)})
        return known


def _shown(place: Path, topic: str) -> dict[str, Any]:
    """Shape of the first image of a topic, and how many are missing; nothing where it has none."""
    try:
        with contextlib.closing(open_images(place, topic)) as images:
            if not images.count:
                return {}
            shape = "x".join(map(str, images.image(0).shape))
            return {"shape": shape, "gaps": missing(images.times)}
    except (LogDamagedError, MalformedRecord, UsageError) as error:
        said = str(error).removeprefix(f"{place}: ")
        return {"problem": said} if isinstance(error, LogDamagedError) else {}


def _hash_of(identity: Identity) -> str:
    """What identifies a log before all of it is read."""
    return str(next(v for k, v in identity.sample().items() if k.endswith("sha256")))


def _all_bytes(place: Path) -> str:
    """SHA-256 of all of a log."""
    if place.is_dir():
        return FilesIdentity(place, (f for f in place.rglob("*") if f.is_file())).sha256(_ignore)
    return FilesIdentity(place).sha256(_ignore)


def _ignore(count: int) -> None:
    """Nobody is told how many bytes were hashed."""


def _configuration(stated: Mapping[str, str]) -> str | None:
    """What a log states of how it was made, as JSON; None where that is nothing, or too much."""
    values: dict[str, Any] = dict(stated)
    with contextlib.suppress(ValueError):
        manifest = parse_json(values.get("manifest", ""))
        if isinstance(manifest, Mapping):
            values = {**values, **manifest}
            del values["manifest"]
    text = json.dumps(values, sort_keys=True)
    return text if values and len(text) <= MOST_TEXT else None


def _log_of(path: str, info: LogInfo) -> str:
    """What is opened as one: the folder of a recording or a run, any other log itself."""
    if info.kind == "foreign":
        return path
    return path.rpartition("/")[0] or "."


def _said(text: str) -> str:
    line = " ".join(text.encode("utf-8", "backslashreplace").decode().split())
    return line if len(line) <= MOST_SAID else f"{line[: MOST_SAID - 3]}..."
