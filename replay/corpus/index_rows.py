"""Rows of the index for one log: one a stream, or one with the problem of a log that is broken."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import pyarrow as pa

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.core.untrusted import parse_json
from recorder.log.messages import view_topic
from recorder.mcap.reader import LogReader
from recorder.mcap.records import MalformedRecord
from replay.integrity.info import describe_log, describe_reader
from replay.integrity.listing import ListedLog, size_and_time
from replay.integrity.report import failed
from replay.logs.clock import missing
from replay.logs.formats.lerobot import LAYOUT as DATASET
from replay.logs.health import COLUMNS, Health, broken_rows
from replay.logs.open_logs import identity_of, image_topics, is_external_format, open_stream
from replay.logs.stream import ChannelInfo
from replay.storage.identity import Identity, McapIdentity
from replay.storage.location import is_url, location

# Increased whenever a column changes its meaning; an index of another version is refused.
VERSION: Final = 3

# Key of the Parquet file's metadata that holds the version.
MARK: Final = b"cdmisfa.corpus"

# Longest configuration in the index, in characters; a longer one is omitted.
MOST_TEXT: Final = 64 * 1024

# Longest problem in the index, in characters; a longer one is cut.
MOST_LETTERS: Final = 500

_WORD: Final = pa.dictionary(pa.int32(), pa.string())

# Columns of the index; docs/reference/files.md describes each.
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
        *((name, pa.float64()) for name in COLUMNS),
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


def read_rows(logs: Sequence[ListedLog], deep: bool) -> tuple[pa.Table, list[str]]:
    """Read the rows of some logs; return also the paths of logs that no longer exist.

    Args:
        logs: with their paths in the index.
        deep: decode them, for checksums, gaps and shapes.
    """
    rows: list[dict[str, Any]] = []
    gone: list[str] = []
    for log in logs:
        streams: list[dict[str, Any]] = []
        problem = log.problem
        try:
            if not problem:
                streams = list(_streams_of(location(log.file), log, deep))
        except ImportError:
            raise
        except Exception as error:  # libraries raise anything for a broken file
            if not (is_url(log.file) or os.path.lexists(log.file)):
                gone.append(log.path)
                continue
            if not isinstance(error, CdmisfaError):
                text = error.strerror if isinstance(error, OSError) else None
                error = LogDamagedError(text or f"{type(error).__name__}: {error}")
            report = failed(log.file, error)
            streams = [{"crc": report.crc, "state": report.state}]
            problem = report.problems[0].what
        shared = {"path": log.path, "log": log.path, "bytes": log.bytes, "changed": log.changed}
        for number, stream in enumerate(streams or [{"state": "not read"}]):
            problems = "; ".join(filter(None, (problem, stream.get("problem"))))
            about = {"number": number, "deep": deep, "problem": _shortened(problems) or None}
            rows.append(shared | stream | about)
    return pa.Table.from_pylist(rows, SCHEMA), gone


def _streams_of(place: Path, log: ListedLog, deep: bool) -> Iterator[dict[str, Any]]:
    """Yield a row for each stream of a log, or one for a log without streams."""
    if is_external_format(place):
        report, sha256 = describe_log(place, decode=deep), _hash_of(identity_of(place))
        topics = [c.topic for c in report.channels if deep and c.encoding != "numpy"]
    else:
        with LogReader(place, skip_damaged=True, check="chunks") as reader:
            sha256 = _hash_of(McapIdentity(reader))
            report = describe_reader(reader, decode=False)
        if deep:
            report = describe_log(place, decode=True)
        topics = image_topics(place) if deep and report.kind != "run" else []
    problems = [f"{p.where}: {p.what}" for p in report.problems]
    if not is_url(log.file) and size_and_time(place) != (log.bytes, log.changed):
        problems.append("the file changed while it was indexed: index again")
    records = [record for file in report.metadata.values() for record in file.values()]
    metadata = {name: value for record in records for name, value in record.items()}
    folder = log.path.rpartition("/")[0] or "."
    shared = {
        "log": log.path if report.kind == "foreign" else folder,
        "bytes": log.bytes or report.size.file,
        "kind": report.kind,
        "compression": " ".join(sorted(report.size.compression)) or None,
        "identity": sha256,
        "crc": report.crc,
        "state": report.state,
        "seed": report.seed if abs(report.seed or 0) < 2**63 else None,
        "configuration": _configuration(metadata),
        "problem": "; ".join(problem.replace(f"{place}: ", "") for problem in problems),
    }
    for channel in report.channels:
        summary = _summary(channel, metadata if report.kind == "recording" else {})
        decoded = _decoded(place, channel.topic) if channel.topic in topics else {}
        yield shared | decoded | summary
    if not report.channels:
        yield shared


def _summary(channel: ChannelInfo, view: Mapping[str, str]) -> dict[str, Any]:
    """Return what the summary of a log states of a channel; `view` is the metadata of a view."""
    start, end = channel.start_ns, channel.end_ns
    row: dict[str, Any] = {
        "topic": channel.topic,
        "encoding": channel.encoding,
        "schema": channel.schema,
        "messages": channel.messages,
        "rate": channel.rate,
        "start_ns": start if start is None or start < 2**63 else None,
        "end_ns": end if end is None or end < 2**63 else None,
        "seconds": None if start is None or end is None else (end - start) / 1e9,
    }
    if channel.topic == view_topic(view.get("view", "")) and row["seconds"] is not None:
        row["shape"] = view.get("frame_shape", "").replace(",", "x")
        with contextlib.suppress(ValueError):
            row["rate"] = float(view.get("fps", ""))
            row["gaps"] = max(round(row["seconds"] * row["rate"]) + 1 - channel.messages, 0)
    elif channel.encoding == "numpy":
        row["shape"] = channel.schema.partition(" ")[2]
    return row


def _decoded(place: Path, topic: str) -> dict[str, Any]:
    """Return shape and health of the images of a topic, and the number of missing images."""
    try:
        with open_stream(place, topic) as stream:
            shape = "x".join(map(str, stream.image(0).shape))
            health = Health()
            broken = list(broken_rows(stream, health))  # `verify` names every broken image
            if stream.program == DATASET:  # it pauses between episodes, where nothing is missing
                gaps = sum(isinstance(error, MalformedRecord) for _, error in broken)
            else:
                gaps = 0 if stream.times is None else int(missing(stream.times).sum())
            return {"shape": shape, "gaps": gaps, **health.columns()}
    except LogDamagedError as error:
        return {"problem": str(error).removeprefix(f"{place}: ")}
    except UsageError:  # the topic has no image
        return {}


def _hash_of(identity: Identity) -> str:
    """Return the hash that identifies a log before all of it is read."""
    return str(next(v for k, v in identity.sample().items() if k.endswith("sha256")))


def _configuration(metadata: Mapping[str, str]) -> str | None:
    """Return the configuration that a log states, as JSON; None if it is too long."""
    values: dict[str, Any] = dict(metadata)
    with contextlib.suppress(ValueError):
        manifest = parse_json(values.get("manifest", ""))
        if isinstance(manifest, Mapping):
            del values["manifest"]
            values |= manifest
    text = json.dumps(values, sort_keys=True)
    return text if values and len(text) <= MOST_TEXT else None


def _shortened(text: str) -> str:
    line = " ".join(text.encode("utf-8", "backslashreplace").decode().split())
    return line if len(line) <= MOST_LETTERS else f"{line[: MOST_LETTERS - 3]}..."
