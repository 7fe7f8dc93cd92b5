"""Which parts of many logs to look at: what is rare and new, noise set apart, within a budget."""

from __future__ import annotations

import contextlib
import csv
import functools
import io
import itertools
import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.processes import WorkerDied, run_all
from recorder.log.files import atomic_write, refuse_existing
from replay.corpus.choosing import rarity, scale, spread_out
from replay.corpus.index import indexed_logs
from replay.corpus.judging import NOISE, NONE, VERDICTS, Applies, Judged, Watched, judge, open_for
from replay.report.curated import Curated, report_of_segments

SHOWN: Final = 60
"""Segments whose pictures are shown."""

PICTURES: Final = 8
"""Pictures of a segment that are shown."""

STREAMS: Final = 4
"""Streams of a segment that are shown."""

WRITTEN: Final = frozenset({"blocks.parquet", "curated.json", "index.html", "segments.csv"})
"""What a folder of segments holds; with other things in it, it is never replaced."""

COLUMNS: Final = {
    "log": pa.string(),
    "stream": pa.string(),
    "t": pa.int64(),
    "start_ns": pa.int64(),
    "end_ns": pa.int64(),
    "verdict": pa.string(),
    "module": pa.int64(),
    "novelty": pa.float64(),
}
"""Of `blocks.parquet`."""


@dataclass(slots=True)
class _Log:
    """What is opened as one, and what was found in it."""

    name: str
    files: list[str] = field(default_factory=list)
    identities: list[str] = field(default_factory=list)
    doubles: list[str] = field(default_factory=list)
    judged: Judged | None = None
    problem: str = ""
    gain: float = 0.0

    @property
    def found(self) -> Judged:
        """What was found, where it was judged."""
        assert self.judged is not None
        return self.judged

    @property
    def left_out(self) -> str:
        """Why it is not judged: another holds the same as each of its files."""
        others = [name for name in self.doubles if name != self.name]
        return f"holds the same as {others[0]}" if len(others) == len(self.files) else ""

    @property
    def seconds(self) -> dict[str, float]:
        """Of its blocks by their verdict."""
        each = self.judged.seconds() if self.judged else [0.0] * len(VERDICTS)
        return dict(zip(VERDICTS, each, strict=True))


@dataclass(frozen=True, slots=True)
class _Window:
    """Frames of all streams of a log that are chosen together."""

    number: int
    at: int
    start: int
    stop: int
    far: float


def curate(
    index: Path,
    out: Path,
    *,
    known: Applies | None = None,
    known_as: Path | None = None,
    budget: float = 600.0,
    jobs: int = 1,
    force: bool = False,
    told: Callable[[float, float | None], None] = lambda done, total: None,
) -> Curated:
    """Choose segments of the logs of an index, and write them with pictures into a folder.

    A log of which another holds the same is left out: the same bytes or, where the index was made
    by decoding, the same messages.

    Args:
        index: of the logs, up to date.
        out: the folder.
        known: modules of a run.
        known_as: the run; what looks as what it watched comes last.
        budget: seconds of all segments together.
        jobs: processes; what is chosen does not depend on them.
        force: replace what was written here before.
        told: how many of the logs that are judged were.

    Raises:
        UsageError: there is no such index or run, no log shows frames, or something is at `out`,
            with `force` what was not written here.
        LogWriteError: the folder cannot be written.
    """
    refuse_existing(out, force=force, goes_on=False)
    if others := sorted(_there(out) - WRITTEN):
        raise UsageError(f"{out} holds other files, such as {others[0]}: choose another folder")
    logs = _logs(index)
    watched = None if known_as is None else Watched.by(known_as)
    work = functools.partial(judge, known=known, watched=watched)
    while judged := _to_judge(logs):  # again where one could not be that others are doubles of
        found = run_all(work, [log.files for log in judged], jobs=min(jobs, len(judged)))
        for done, (number, one) in enumerate(found, 1):
            if isinstance(one, Judged):
                judged[number].judged = one
            else:
                judged[number].problem = one.what if isinstance(one, WorkerDied) else one
            told(done, len(judged))
    if not any(log.judged and len(log.judged.t) for log in logs):
        why = next((f": {log.problem}" for log in logs if log.problem), "")
        raise UsageError(f"{index}: no log in it shows frames{why}")
    chosen, all_seen = _choose(logs, budget)
    segments = list(_segments(logs, chosen))
    order = sorted(logs, key=lambda log: (-log.gain, log.name))
    rows: list[dict[str, Any]] = [
        {
            "log": log.name,
            "new": round(log.gain, 3),
            **{name: round(value, 3) for name, value in log.seconds.items()},
            "problem": log.problem or log.left_out or None,
        }
        for log in order
    ]
    total = {name: sum((log.seconds[name] for log in logs), 0.0) for name in VERDICTS}
    lasts = sum(s["seconds"] for s in segments)
    left = "nothing else is new" if all_seen else "no other block that is new fits into it"
    to_cut = sum(any(map(_is_cut, s["files"])) for s in segments)
    shown = Curated(rows, segments, total, lasts, left if lasts < budget else "", to_cut)
    with atomic_write(out) as folder:
        folder.mkdir()
        _write(folder, out, shown, logs, budget, known_as)
        pictures = [_pictures(logs[s["number"]], s, known) for s in segments[:SHOWN]]
        page = report_of_segments(shown, pictures, budget, known_as)
        (folder / "index.html").write_text(page, encoding="utf-8")
    return shown


def _there(out: Path) -> set[str]:
    return {path.name for path in out.iterdir()} if out.is_dir() else set()


def _logs(index: Path) -> list[_Log]:
    """What is opened as one, of each log of an index but runs."""
    return [
        _Log(name, files, [i or file for i, file in zip(identities, files, strict=True)])
        for name, kind, files, _, identities in indexed_logs(index)
        if kind is not None
    ]


def _to_judge(logs: Sequence[_Log]) -> list[_Log]:
    """Logs that were not judged yet, but for doubles of those that were, or are to be."""
    first: dict[str, str] = {}
    for log in logs:
        if not log.problem:
            log.doubles = [first.setdefault(identity, log.name) for identity in log.identities]
    return [log for log in logs if not (log.judged or log.problem or log.left_out)]


def _choose(logs: Sequence[_Log], budget: float) -> tuple[list[_Window], bool]:
    """Windows that fit into a budget, and whether all that are new do."""
    numbers, all_of = zip(
        *((i, log.judged) for i, log in enumerate(logs) if log.judged), strict=True
    )
    counts = [len(one.t) for one in all_of]
    kinds: dict[tuple[Any, ...], int] = {}
    groups = []
    for one in all_of:
        of = [(name, one.spec.frame_shape, one.spec.images) for name in one.spec.streams]
        groups.append(np.array([kinds.setdefault(kind, len(kinds)) for kind in of])[one.stream])
    width = max(one.features.shape[1] for one in all_of)
    features = np.zeros((sum(counts), width), np.float32)
    for stop, one in zip(np.cumsum(counts).tolist(), all_of, strict=True):
        features[stop - len(one.t) : stop, : one.features.shape[1]] = one.features
    of_group = np.concatenate(groups)
    wanted = np.concatenate([one.verdict for one in all_of]) != NOISE
    scale(features, of_group, wanted, [kind[2] for kind in kinds])
    places = np.stack(
        [np.repeat(numbers, counts), np.concatenate([one.t // one.tau for one in all_of])], axis=1
    )
    names, windows = np.unique(places, axis=0, return_inverse=True)
    windows = windows.reshape(-1)
    start, stop = np.full(len(names), 2**62), np.zeros(len(names), np.int64)
    np.minimum.at(start, windows, np.concatenate([one.t for one in all_of]))
    np.maximum.at(stop, windows, np.concatenate([one.t + one.frames for one in all_of]))
    fps = np.array([logs[number].found.spec.fps for number in names[:, 0]])
    strange = np.concatenate([one.strange for one in all_of])
    rare, seconds = rarity(features, of_group, wanted), (stop - start) / fps
    chosen, all_seen = spread_out(
        features, of_group, windows, wanted, rare, strange, seconds, budget
    )
    for window, far in chosen:
        logs[names[window, 0]].gain += far
    found = [
        _Window(int(names[i, 0]), int(names[i, 1]), int(start[i]), int(stop[i]), far)
        for i, far in chosen
    ]
    return found, all_seen


def _segments(logs: Sequence[_Log], chosen: Sequence[_Window]) -> Iterator[dict[str, Any]]:
    """Windows that follow one another as one, in the order in which the first was chosen."""
    rank = {window: place for place, window in enumerate(chosen)}
    by_place = enumerate(sorted(chosen, key=lambda window: (window.number, window.at)))
    each = itertools.groupby(by_place, lambda one: (one[1].number, one[1].at - one[0]))
    runs = [[window for _, window in run] for _, run in each]
    for run in sorted(runs, key=lambda run: min(rank[window] for window in run)):
        log = logs[run[0].number]
        start, stop = run[0].start, run[-1].stop
        yield {
            "number": run[0].number,
            "log": log.name,
            "files": log.files,
            "start": log.found.spec.time_ns(start),
            "stop": log.found.spec.time_ns(stop),
            "seconds": (stop - start) / log.found.spec.fps,
            "t": (start, stop),
            "new": round(max(window.far for window in run), 3),
        }


def _is_cut(file: str) -> bool:
    """Whether `cut` takes a file."""
    return file.endswith((".mcap", ".partial"))


def _write(
    folder: Path, out: Path, found: Curated, logs: Sequence[_Log], budget: float, known: Path | None
) -> None:
    """Write the segments for `cut`, all of it as JSON, and each block's verdict."""
    listed = io.StringIO()
    rows = csv.writer(listed, lineterminator="\n")
    rows.writerow(("path", "start", "stop", "log"))
    for segment in found.segments:
        for file in segment["files"]:
            if _is_cut(file):
                place = file if "://" in file else os.path.relpath(file, out)
                rows.writerow((place, segment["start"], segment["stop"], segment["log"]))
    (folder / "segments.csv").write_text(listed.getvalue(), "utf-8")
    document = {
        "schema": 1,
        "known": None if known is None else str(known),
        "budget": budget,
        **found.as_json(),
    }
    (folder / "curated.json").write_text(json.dumps(document, indent=1) + "\n", "utf-8")
    with pq.ParquetWriter(folder / "blocks.parquet", pa.schema(COLUMNS), compression="zstd") as to:
        for log in logs:
            if log.judged is not None:
                to.write_table(_rows(log.name, log.judged))


def _rows(name: str, judged: Judged) -> pa.Table:
    """The blocks of a log, a row each."""
    spec, t = judged.spec, judged.t
    columns = {
        "log": [name] * len(t),
        "stream": np.array(spec.streams, object)[judged.stream],
        "t": t,
        "start_ns": [spec.time_ns(at) for at in t.tolist()],
        "end_ns": [spec.time_ns(at) for at in (t + judged.frames).tolist()],
        "verdict": np.array(VERDICTS, object)[judged.verdict],
    }
    arrays = [pa.array(column, COLUMNS[name]) for name, column in columns.items()]
    arrays.append(pa.array(judged.module, pa.int64(), mask=judged.module == NONE))
    arrays.append(pa.array(judged.novelty, pa.float64(), mask=np.isnan(judged.novelty)))
    return pa.table(arrays, schema=pa.schema(COLUMNS))


def _pictures(
    log: _Log, segment: dict[str, Any], known: Applies | None
) -> list[tuple[str, list[Any]]]:
    """Some pictures of each stream of a segment, evenly from its first to its last."""
    found: list[tuple[str, list[Any]]] = []
    with contextlib.closing(open_for(log.files, known)) as source:
        start, stop = segment["t"]
        stop = min(stop, source.first_frame + source.frames)
        at = np.unique(np.linspace(max(start, source.first_frame), stop - 1, PICTURES).astype(int))
        for stream, name in enumerate(source.spec.streams[:STREAMS]):
            shown = []
            for t in at.tolist() if source.spec.images else ():
                with contextlib.suppress(CdmisfaError):  # a gap
                    source.seek(t)
                    shown.append(source.take(stream, 1).frames[0])
            found.append((name, shown))
    return found
