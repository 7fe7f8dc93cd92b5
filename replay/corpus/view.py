"""An index of many logs as a page, with the first frames of some of them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import CdmisfaError, LogDamagedError
from cdmisfa.core.names import counted, lasting
from recorder.log.files import atomic_write, refuse_taken, refuse_unless
from replay.corpus.finding import INDEX
from replay.corpus.index import IndexedLog, indexed_logs, is_index, read_index
from replay.corpus.query import ask, summary
from replay.inputs import open_to_look
from replay.report.indexed import Recorded, report_of_index
from replay.storage.location import location

CARDS: Final = 24
"""Logs of which the first frames are shown."""

STREAMS: Final = 4
"""Streams of a log that are shown."""

_DOUBLE: Final = "SELECT unnest(paths) AS path FROM doubles"


def index_to_view(path: Path) -> Path | None:
    """The index that `path` is, or of which it is the folder; None of any other, and of a log.

    A recording or a run stays one, also with an index of its own.
    """
    if not path.is_dir():
        return path if is_index(path) else None
    index = path / INDEX
    if not index.is_file():
        return None
    here = pc.all(pc.equal(read_index(index)["log"], ".")).as_py()
    return None if here and len(indexed_logs(index)) < 2 else index


def view_index(
    index: Path,
    out: Path | None = None,
    *,
    force: bool = False,
    told: Callable[[float, float | None], None] = lambda done, total: None,
) -> Path:
    """Write what an index has as a page: when, what, what is broken or double, first frames.

    Args:
        index: of the logs.
        out: the page; by default beside the index, where one from before is replaced.
        force: replace what is at `out`.
        told: of how many logs the first frames were looked at.

    Returns:
        The page.

    Raises:
        UsageError: it is no index, DuckDB is missing, or something is at `out`.
        LogDamagedError: the index is damaged.
        LogWriteError: the page cannot be written.
    """
    if out is None:
        out = index.with_suffix(".html")
    else:
        refuse_unless(out, "a view of an index is a page", ".html", ".htm")
        refuse_taken(out, force=force)
    found, rows = summary(index), ask(index, "SELECT * FROM streams")
    shown = _evenly(indexed_logs(index), rows)
    cards = []
    for number, log in enumerate(shown):
        cards.append(_card(log))
        told(number + 1, len(shown))
    kinds = [
        (k["kind"], f"{k['logs']:,}", f"{k['files']:,}", f"{k['streams']:,}", lasting(k["seconds"]),
         f"{(k['bytes'] or 0) / 1e6:,.1f} MB")
        for k in found.kinds
    ]  # fmt: skip
    many = {name: sum(k[name] or 0 for k in found.kinds) for name in ("logs", "streams", "seconds")}
    lead = f"{counted(many['logs'], 'log', ',')} of {counted(many['streams'], 'stream', ',')}, "
    lead += f"{lasting(many['seconds'])} long: {found.counts['broken']:,} broken, "
    lead += f"{found.counts['double']:,} there more than once."
    broken = [(row["path"], row["problem"]) for row in found.broken]
    double = [(row["paths"][0], " = ".join(row["paths"][1:])) for row in found.double]
    page = report_of_index(
        str(index.parent.resolve().name if index.name == INDEX else index.stem),
        lead,
        _recorded(rows, ask(index, _DOUBLE)),
        kinds,
        cards,
        f"Of {counted(len(cards), 'log')}, evenly from the first to the last.",
        [
            ("Broken", broken, found.counts["broken"] - len(broken)),
            ("Double", double, found.counts["double"] - len(double)),
        ],
    )
    with atomic_write(out) as place:
        place.write_text(page, "utf-8")
    return out


def _recorded(rows: pa.Table, doubles: pa.Table) -> Recorded:
    """When each stream was recorded that states it."""
    streams = rows.filter(pc.is_valid(rows["topic"]))
    known = pc.and_(pc.is_valid(streams["start_ns"]), pc.is_valid(streams["end_ns"]))
    timed = streams.filter(known)
    double = pc.is_in(timed["path"], doubles["path"]).to_numpy()
    marks = {"broken": pc.is_valid(timed["problem"]).to_numpy(), "double": double}
    topics = np.asarray(timed["topic"].to_pylist(), dtype=str)
    starts, ends = (timed[name].to_numpy() for name in ("start_ns", "end_ns"))
    return Recorded(topics, starts, ends, marks, len(streams) - len(timed))


def _evenly(logs: Sequence[IndexedLog], rows: pa.Table) -> list[IndexedLog]:
    """Some logs from the first to the last, none that holds the same as others."""
    begins = dict(zip(rows["path"].to_pylist(), rows["start_ns"].to_pylist(), strict=True))
    known: set[str | None] = {None}
    order = []
    for log in sorted(logs, key=lambda log: (begins.get(log.files[0]) or 0, log.name)):
        if not known.issuperset(log.identities):
            order.append(log)
        known.update(log.identities)
    return [order[i] for i in np.unique(np.linspace(0, len(order) - 1, CARDS).astype(int)) if order]


def _card(log: IndexedLog) -> dict[str, Any]:
    """A log with its first frames, or why it has none."""
    card: dict[str, Any] = {"name": log.name, "pictures": [], "state": ""}
    try:
        places = [location(file) for file in log.files]
        with contextlib.closing(open_to_look(places, salvage=True)) as source:
            begins = datetime.fromtimestamp(
                source.spec.time_ns(source.first_frame) // NANOSECONDS, UTC
            )
            card["text"] = f"{begins:%Y-%m-%d %H:%M}, {lasting(source.frames / source.spec.fps)}"
            card["pictures"] = list(_firsts(source))
    except CdmisfaError as error:
        broken = isinstance(error, LogDamagedError)
        card |= {"text": str(error), "state": "broken" if broken else ""}
    return card


def _firsts(source: Any) -> Iterator[Any]:
    """The first frame of each stream of pictures."""
    for stream in range(len(source.spec.streams[:STREAMS]) if source.spec.images else 0):
        source.seek(source.first_frame)
        yield source.take(stream, 1).frames[0]
