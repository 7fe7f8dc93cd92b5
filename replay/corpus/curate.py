"""Which parts of many logs to look at: what no module knows, noise set apart, within a budget."""

from __future__ import annotations

import contextlib
import csv
import io
import itertools
import json
import os
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.errors import CdmisfaError, LogExhaustedError, UsageError
from cdmisfa.modules import Module
from recorder.log.files import atomic_write, refuse_existing
from replay.corpus.choosing import Features, described, scaled, spread_out
from replay.corpus.index import read_index
from replay.export.applied import Applied
from replay.inputs import open_to_look
from replay.report.curated import Curated, report_of_segments
from replay.storage.location import location

SECONDS: Final = 2.0
"""Of a block where no run says how many frames it has."""

LEAST: Final = 3
"""Frames of a block that is judged."""

SHOWN: Final = 60
"""Segments whose pictures are shown."""

PICTURES: Final = 8
"""Pictures of a segment that are shown."""

STREAMS: Final = 4
"""Streams of a segment that are shown."""

KNOWN, NOVEL, NOISE = VERDICTS = ("known", "novel", "noise")


class Applies(Protocol):
    """The modules of a run, ready to be applied: `cdmisfa.experiments.apply.Application`."""

    tau: int

    @property
    def modules(self) -> Sequence[Module]:
        """In their order."""

    def open(self, words: Sequence[str], *, salvage: bool) -> Any:
        """Open logs as the modules take them."""

    def to(self, source: Any) -> Iterator[Applied]:
        """Apply the modules to them, block by block."""


@dataclass(slots=True)
class _Log:
    """What is opened as one, and what was found in it."""

    name: str
    files: list[str]
    spec: SourceSpec | None = None
    tau: int = 0
    problem: str = ""
    left_out: str = ""
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(VERDICTS, 0.0))
    gain: float = 0.0


@dataclass(slots=True)
class _Blocks:
    """A row a block of a stream: see `blocks.parquet`."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    features: list[Features] = field(default_factory=list)
    groups: list[int] = field(default_factory=list)
    kinds: dict[tuple[Any, ...], int] = field(default_factory=dict)

    def add(
        self, number: int, log: _Log, block: Block, novelty: Any, modules: Sequence[int]
    ) -> None:
        """Judge a block."""
        spec = log.spec
        assert spec is not None
        features, noise = described(block.frames)
        near = novelty is not None and np.isfinite(novelty).any()
        nearest = int(np.argmin(novelty)) if near else None
        verdict, module = (NOISE if noise else NOVEL), None
        if nearest is not None and novelty[nearest] < 1:
            verdict, module = KNOWN, modules[nearest]
        stream = spec.streams[block.stream]
        kind = (stream, spec.frame_shape, spec.images)
        self.groups.append(self.kinds.setdefault(kind, len(self.kinds)))
        self.features.append(features)
        start, stop = spec.time_ns(block.t), spec.time_ns(block.t + len(block))
        log.seconds[verdict] += len(block) / spec.fps
        self.rows.append(
            {
                "log": log.name,
                "stream": stream,
                "t": block.t,
                "start_ns": start,
                "end_ns": stop,
                "verdict": verdict,
                "module": module,
                "novelty": None if nearest is None else float(novelty[nearest]),
                "window": (number, block.t // log.tau),
            }
        )


def curate(
    index: Path,
    out: Path,
    *,
    known: Applies | None = None,
    known_as: Path | None = None,
    budget: float = 600.0,
    force: bool = False,
    told: Callable[[float, float | None], None] = lambda done, total: None,
) -> Curated:
    """Choose segments of the logs of an index, and write them with pictures into a folder.

    A log of which another holds the same bytes is left out.

    Args:
        index: of the logs, up to date.
        out: the folder.
        known: modules of a run; what they know is not chosen.
        known_as: the run.
        budget: seconds of all segments together.
        force: replace the folder.
        told: how many of the logs were judged.

    Raises:
        UsageError: there is no such index or run, no log shows frames, or something is at `out`.
        LogWriteError: the folder cannot be written.
    """
    refuse_existing(out, force=force, goes_on=False)
    logs, blocks = _logs(index), _Blocks()
    for number, log in enumerate(logs):
        if not log.left_out:
            try:
                _judge(number, log, known, blocks)
            except CdmisfaError as error:
                log.problem = str(error)
        told(number + 1, len(logs))
    if not blocks.rows:
        why = next((f": {log.problem}" for log in logs if log.problem), "")
        raise UsageError(f"{index}: no log in it shows frames{why}")
    chosen, all_seen = _choose(logs, blocks, budget)
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
    left = "nothing else is new" if all_seen else "the next block does not fit into it"
    to_cut = sum(any(map(_is_cut, s["files"])) for s in segments)
    found = Curated(rows, segments, total, lasts, left if lasts < budget else "", to_cut)
    with atomic_write(out) as folder:
        folder.mkdir()
        _write(folder, out, found, blocks, budget, known_as)
        pictures = [_pictures(logs[s["number"]], s, known) for s in segments[:SHOWN]]
        page = report_of_segments(found, pictures, budget, known_as)
        (folder / "index.html").write_text(page, encoding="utf-8")
    return found


def _logs(index: Path) -> list[_Log]:
    """What is opened as one, of each log of an index but runs; doubles are left out."""
    wanted = ["log", "path", "kind", "identity", "number"]
    rows = [row for row in read_index(index).select(wanted).to_pylist() if row["number"] == 0]
    found: dict[str, _Log] = {}
    first: dict[str, str] = {}
    for row in rows:
        if row["kind"] in ("foreign", "recording"):
            path = row["path"]
            opened = path if "://" in path else str(index.parent / path)
            name = row["log"] if row["kind"] == "recording" and row["log"] != "." else path
            log = found.setdefault(name, _Log(name, []))
            log.files.append(opened)
            other = first.setdefault(row["identity"] or path, name)
            if other != name:
                log.left_out = f"holds the same as {other}"
            elif len(log.files) > 1:
                log.left_out = ""
    return list(found.values())


def _open(log: _Log, application: Applies | None) -> Any:
    if application is not None:
        return application.open(log.files, salvage=True)
    return open_to_look([location(file) for file in log.files], salvage=True)


def _judge(number: int, log: _Log, application: Applies | None, blocks: _Blocks) -> None:
    with contextlib.closing(_open(log, application)) as source:
        log.spec = source.spec
        log.tau = application.tau if application else max(round(SECONDS * source.spec.fps), LEAST)
        for block, novelty in _judged(source, log.tau, application):
            if len(block) >= LEAST:
                modules = [m.index for m in application.modules] if application else []
                blocks.add(number, log, block, novelty, modules)


def _judged(source: Any, tau: int, application: Applies | None) -> Iterator[tuple[Block, Any]]:
    if application is not None:
        for applied in application.to(source):
            yield applied.block, np.where(applied.alive, applied.novelty, np.inf)
        return
    end = source.first_frame + source.frames
    with contextlib.suppress(LogExhaustedError):
        while source.t < end:
            for block in source.take_all(min(tau - source.t % tau, end - source.t)):
                yield block, None


def _choose(
    logs: Sequence[_Log], blocks: _Blocks, budget: float
) -> tuple[list[tuple[int, int, float]], bool]:
    """The log and the number of each window that is chosen, and how far it is from the others.

    Also whether there are no more that are new.
    """
    width = max(map(len, blocks.features))
    features = np.array([np.pad(one, (0, width - len(one))) for one in blocks.features])
    groups = np.array(blocks.groups, np.int64)
    features = scaled(features, groups, [kind[2] for kind in blocks.kinds])
    known = {window: i for i, window in enumerate(dict.fromkeys(r["window"] for r in blocks.rows))}
    names, windows = list(known), np.array([known[row["window"]] for row in blocks.rows], np.int64)
    wanted = np.array([row["verdict"] == NOVEL for row in blocks.rows])
    found: list[tuple[int, int, float]] = []
    for window, far in spread_out(features, groups, windows, wanted):
        number, at = names[window]
        log = logs[number]
        assert log.spec is not None
        budget -= log.tau / log.spec.fps
        if budget < 0:
            return found, False
        log.gain += far
        found.append((number, at, far))
    return found, True


def _segments(
    logs: Sequence[_Log], chosen: Sequence[tuple[int, int, float]]
) -> Iterator[dict[str, Any]]:
    """Windows that follow one another as one, in the order in which the first was chosen."""
    rank = {(number, at): place for place, (number, at, _) in enumerate(chosen)}
    far = {(number, at): value for number, at, value in chosen}
    runs: list[list[tuple[int, int]]] = []
    by_log: dict[int, list[int]] = defaultdict(list)
    for number, at, _ in chosen:
        by_log[number].append(at)
    for number, ats in by_log.items():
        each = itertools.groupby(enumerate(sorted(ats)), lambda pair: pair[1] - pair[0])
        runs += [[(number, at) for _, at in run] for _, run in each]
    for run in sorted(runs, key=lambda run: min(rank[key] for key in run)):
        number, log = run[0][0], logs[run[0][0]]
        assert log.spec is not None
        start, stop = run[0][1] * log.tau, (run[-1][1] + 1) * log.tau
        yield {
            "number": number,
            "log": log.name,
            "files": log.files,
            "start": log.spec.time_ns(start),
            "stop": log.spec.time_ns(stop),
            "seconds": (stop - start) / log.spec.fps,
            "t": (start, stop),
            "new": round(max(far[key] for key in run), 3),
        }


def _is_cut(file: str) -> bool:
    """Whether `cut` takes a file."""
    return file.endswith((".mcap", ".partial"))


def _write(
    folder: Path, out: Path, found: Curated, blocks: _Blocks, budget: float, known: Path | None
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
    names = ("log", "stream", "t", "start_ns", "end_ns", "verdict", "module", "novelty")
    kinds = (*(pa.string(),) * 2, *(pa.int64(),) * 3, pa.string(), pa.int64(), pa.float64())
    table = pa.Table.from_pylist(blocks.rows, pa.schema(list(zip(names, kinds, strict=True))))
    pq.write_table(table, folder / "blocks.parquet", compression="zstd")


def _pictures(
    log: _Log, segment: dict[str, Any], application: Applies | None
) -> list[tuple[str, list[Any]]]:
    """Some pictures of each stream of a segment, evenly from its first to its last."""
    found: list[tuple[str, list[Any]]] = []
    with contextlib.closing(_open(log, application)) as source:
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
