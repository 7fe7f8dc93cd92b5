"""Which messages of a log are wanted, and the list of segments that says so of many logs."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import UsageError
from cdmisfa.core.untrusted import MAX_JSON, parse_json, read_regular
from replay.camera_logs.opening import fits_topic
from replay.storage.location import location
from replay.stored import Span

FOREVER: Final = 2**64
"""Behind every log time, nanoseconds."""

_FIELDS: Final = ("path", "start", "stop", "topic", "log")
_ISO: Final = re.compile(
    r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?(Z|[+-]\d\d:\d\d)?", re.ASCII
)
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Segment:
    """What is wanted of a log: log times [start, stop), nanoseconds, of the topics of a pattern.

    What is opened as one, as the views of a recording are, has one name, `log`.
    """

    start: int = 0
    stop: int = FOREVER
    topic: str = "*"
    log: str = ""


def spans_of(segments: Iterable[Segment], topic: str) -> list[Span]:
    """The log times that are wanted of a topic, in order and apart from each other."""
    found: list[Span] = []
    for start, stop in sorted((s.start, s.stop) for s in segments if fits_topic(topic, s.topic)):
        if found and start <= found[-1][1]:
            found[-1] = found[-1][0], max(stop, found[-1][1])
        else:
            found.append((start, stop))
    return found


def within(times: NDArray[np.uint64], spans: Sequence[Span]) -> NDArray[np.bool_]:
    """Which log times, (n,), lie in spans: a truth value each."""
    edges = np.array([edge for span in spans for edge in span if edge < FOREVER], np.uint64)
    inside: NDArray[np.bool_] = np.searchsorted(edges, times, side="right") % 2 == 1
    return inside


def read_segments(path: Path) -> list[tuple[Path | None, Segment]]:
    """The rows of a list of segments, CSV or JSON: `path`, `start`, `stop`, `topic` and `log`.

    Times are nanoseconds or dates (ISO 8601, UTC where they name no zone). A relative path is one
    from the list's folder; a row may lack it, the topic, which may be a pattern, or the log.

    Raises:
        UsageError: it is no such list.
    """
    text = read_regular(path, MAX_JSON)
    try:
        rows = _from_json(text) if path.suffix.lower() == ".json" else _from_csv(text)
    except (ValueError, csv.Error) as error:
        raise UsageError(f"{path}: it is no list of segments ({error})") from None
    if not rows:
        raise UsageError(f"{path}: it lists no segment: a row is {', '.join(_FIELDS)}")
    return [_row(path, where, values) for where, values in rows]


def _from_csv(text: bytes) -> list[tuple[str, Mapping[str, Any]]]:
    rows = csv.DictReader(io.StringIO(text.decode("utf-8-sig"), newline=""), restkey="")
    return [(f"line {rows.line_num}", {k: v for k, v in row.items() if v}) for row in rows]


def _from_json(text: bytes) -> list[tuple[str, Mapping[str, Any]]]:
    rows = parse_json(text)
    if isinstance(rows, dict):
        rows = rows.get("segments")
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ValueError("JSON is a list of objects, or one with them as its segments")
    return [(f"segment {i}", row) for i, row in enumerate(rows)]


def _row(path: Path, where: str, row: Mapping[str, Any]) -> tuple[Path | None, Segment]:
    for name in ("start", "stop"):
        if name not in row:
            raise UsageError(f"{path}: {where} misses {name}: a row is {', '.join(_FIELDS)}")
    try:
        start, stop = _time(row["start"]), _time(row["stop"])
    except ValueError as error:
        raise UsageError(f"{path}: {where}: {error}") from None
    if not 0 <= start < stop <= FOREVER:
        raise UsageError(f"{path}: {where}: its times [{start}, {stop}) ns hold no moment of a log")
    for name in ("path", "topic", "log"):
        if not isinstance(row.get(name, ""), str):
            raise UsageError(f"{path}: {where}: its {name} is no text")
    place = location(row["path"]) if row.get("path") else None
    if place is not None:
        place = path.parent / place
    return place, Segment(start, stop, row.get("topic") or "*", row.get("log") or "")


def _time(value: Any) -> int:
    """A log time, nanoseconds; a ValueError where it is neither these nor a date."""
    if type(value) is int or (isinstance(value, str) and re.fullmatch(r"\d{1,20}", value)):
        return int(value)
    found = _ISO.fullmatch(value) if isinstance(value, str) else None
    if found is None:
        raise ValueError(f"{str(value)[:40]!r} is no time: write nanoseconds, or an ISO 8601 date")
    whole = datetime.fromisoformat(found[1] + (found[3] or "Z")) - _EPOCH
    return whole // timedelta(seconds=1) * NANOSECONDS + int((found[2] or "").ljust(9, "0"))
