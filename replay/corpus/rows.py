"""Rows of the index for one log: one a stream, or one with the problem of a log that is broken."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import pyarrow as pa

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.core.untrusted import parse_json
from recorder.log.messages import view_topic
from recorder.mcap.reader import LogReader
from recorder.mcap.records import MalformedRecord
from replay.corpus.finding import Found, state_of_log
from replay.integrity.info import describe_log, describe_reader
from replay.integrity.report import ChannelInfo, LogReport, failed_state
from replay.logs.clock import missing
from replay.logs.opening import identity_of, image_topics, only_external, open_stream
from replay.storage.identity import Identity, McapIdentity
from replay.storage.location import is_url, location

VERSION: Final = 2
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


class Answer(NamedTuple):
    """Rows of some logs.

    Attributes:
        rows: of them.
        gone: paths of those that are not there any more.
    """

    rows: pa.Table
    gone: Sequence[str]


def look(logs: Sequence[Found], deep: bool) -> Answer:
    """Read the rows of some logs.

    Args:
        logs: which, with their paths in the index.
        deep: decode them, for checksums, gaps and shapes.
    """
    rows: list[dict[str, Any]] = []
    gone = []
    for log in logs:
        try:
            found = [] if log.problem else list(_rows_of(location(log.file), log, deep))
        except Exception as raised:  # whatever a broken file makes a library of others raise
            if not (is_url(log.file) or os.path.lexists(log.file)):
                gone.append(log.path)
                continue
            error = _as_ours(raised)
            crc, state = failed_state(error)
            log = log._replace(problem=str(error).removeprefix(f"{log.file}: "))
            found = [{"crc": crc, "state": state}]
        for number, row in enumerate(found or [{"state": "not read"}]):
            rows.append({**_row(log, row, deep), "number": number})
    return Answer(pa.Table.from_pylist(rows, SCHEMA), gone)


def _as_ours(raised: Exception) -> CdmisfaError:
    if isinstance(raised, CdmisfaError):
        return raised
    said = raised.strerror if isinstance(raised, OSError) else None
    return LogDamagedError(said or f"{type(raised).__name__}: {raised}")


def _row(log: Found, row: Mapping[str, Any], deep: bool) -> dict[str, Any]:
    path = log.path
    own = {"path": path, "log": path, "bytes": log.bytes, "changed": log.changed, "deep": deep}
    problem = "; ".join(filter(None, (log.problem, row.get("problem")))) or None
    return {**own, **row, "problem": problem and _said(problem)}


def _rows_of(place: Path, log: Found, deep: bool) -> Iterator[dict[str, Any]]:
    info, identity, images = _described(place, deep)
    problems = [f"{p.where}: {p.what}" for p in info.problems]
    if not is_url(log.file) and state_of_log(place) != (log.bytes, log.changed):
        problems.append("it changed while it was indexed: index again")
    records = [record for found in info.metadata.values() for record in found.values()]
    stated = {name: value for record in records for name, value in record.items()}
    about = {
        "log": _log_of(log.path, info),
        "bytes": log.bytes or info.size.file,
        "kind": info.kind,
        "compression": " ".join(sorted(info.size.compression)) or None,
        "identity": identity,
        "crc": info.crc,
        "state": info.state,
        "seed": info.seed if info.seed is None or -(2**63) <= info.seed < 2**63 else None,
        "configuration": _configuration(stated),
        "problem": "; ".join(problem.replace(f"{place}: ", "") for problem in problems),
    }
    view = stated if info.kind == "recording" else {}
    for channel, shown in zip(info.channels, images, strict=True):
        yield {**about, **_stream(channel, view), **shown}
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


def _described(place: Path, deep: bool) -> tuple[LogReport, str, list[dict[str, Any]]]:
    """Return what a log is, its identity, and what the images of each channel show."""
    if only_external(place):
        info, sha256 = describe_log(place, decode=deep), _hash_of(identity_of(place))
        topics = [c.topic for c in info.channels if deep and c.encoding != "numpy"]
    else:
        with LogReader(place, salvage=True, check="chunks") as reader:
            sha256 = _hash_of(McapIdentity(reader))
            info = describe_reader(reader, decode=False)
        if deep:
            info = describe_log(place, decode=True)
        topics = image_topics(place) if deep and info.kind == "foreign" else []
    images = [_shown(place, c.topic) if c.topic in topics else {} for c in info.channels]
    return info, sha256, images


def _shown(place: Path, topic: str) -> dict[str, Any]:
    """Shape of the first image of a topic, and how many are missing; nothing where it has none."""
    try:
        with open_stream(place, topic) as stream:
            shape = "x".join(map(str, stream.image(0).shape))
            return {"shape": shape, "gaps": 0 if stream.times is None else missing(stream.times)}
    except (LogDamagedError, MalformedRecord, UsageError) as error:
        said = str(error).removeprefix(f"{place}: ")
        return {"problem": said} if isinstance(error, LogDamagedError) else {}


def _hash_of(identity: Identity) -> str:
    """What identifies a log before all of it is read."""
    return str(next(v for k, v in identity.sample().items() if k.endswith("sha256")))


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


def _log_of(path: str, info: LogReport) -> str:
    """What is opened as one: the folder of a recording or a run, any other log itself."""
    if info.kind == "foreign":
        return path
    return path.rpartition("/")[0] or "."


def _said(text: str) -> str:
    line = " ".join(text.encode("utf-8", "backslashreplace").decode().split())
    return line if len(line) <= MOST_SAID else f"{line[: MOST_SAID - 3]}..."
