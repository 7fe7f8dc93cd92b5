"""A moment of a run in words: a frame, an iteration or an event."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path

from cdmisfa.core.errors import UsageError
from replay.inputs import holds_run, open_to_look
from replay.recordings.source import RecordedSource
from replay.runs.log import EVENT_TOPIC, read_batches, read_columns, read_header

ITERATION = re.compile(r"(?:iteration|iter|i)\s*(\d+)", re.IGNORECASE)

TOLD = 3
"""Events that a refusal names."""


def frame_at(path: Path, at: str) -> int:
    """The frame of a moment.

    Args:
        path: a run or recording, or an .rrd file.
        at: a frame, as "20000"; of a run also an iteration, as "iteration 500", or words of an
            event, as "module 2": the first one that has them.

    Raises:
        UsageError: there is no such moment.
        LogDamagedError: the log cannot be read.
    """
    if at.isdecimal():
        frame = int(at)
        if path.suffix != ".rrd" and frame > (last := _last_frame(path)):
            raise UsageError(f"--at {at}: there is no such frame, the last of {path} is {last}")
        return frame
    if path.suffix == ".rrd" or not holds_run(path):
        raise UsageError(f"--at {at}: only a run has iterations and events, say a frame")
    found = ITERATION.fullmatch(at.strip())
    return _of_iteration(path, int(found[1])) if found else _of_event(path, at)


def _of_iteration(run: Path, iteration: int) -> int:
    last = -1
    for columns in read_columns(run):
        last = int(columns.iterations[-1])
        if iteration <= last:
            return int(columns.frames[columns.iterations.tolist().index(iteration)])
    raise UsageError(f"--at iteration {iteration}: the last of {run} is {last}")


def _of_event(run: Path, words: str) -> int:
    wanted = re.compile(rf"(?<!\w){re.escape(words.strip())}(?!\w)", re.IGNORECASE)
    told: list[str] = []
    for batch in read_batches(run, read_header(run), topics=(EVENT_TOPIC,)):
        for event in batch.events:
            if wanted.search(event.text):
                return int(event.t)
            told.append(event.text)
    some = "; ".join(told[:TOLD]) or "none"
    raise UsageError(f"--at {words!r} is no frame, iteration or event of {run}; events: {some}")


def _last_frame(path: Path) -> int:
    if holds_run(path):
        ends = (int(piece.frames[-1]) + piece.tau - 1 for piece in read_columns(path))
        return max(ends, default=0)
    with contextlib.closing(open_to_look([path], salvage=True)) as source:
        if isinstance(source, RecordedSource):
            return max(ranges[-1][1] for ranges in source.coverage().values() if ranges) - 1
        return source.frames - 1
