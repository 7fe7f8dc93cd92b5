"""Align streams of external logs on one clock, or raise an error that names the needed options."""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from cdmisfa.core.arrays import IntArray
from cdmisfa.core.clock import NANOSECONDS, RECORDED_FPS, times_of
from cdmisfa.core.errors import UsageError
from cdmisfa.core.names import stream_name, stream_names
from recorder.images.options import InputOptions
from replay.logs import clock as clocks
from replay.logs.clock import FrameClock
from replay.logs.formats.arrays import FPS
from replay.logs.formats.table import TIME_NAMES, UNITS
from replay.logs.stream import LogStream, joined

# Share by which a measured rate may differ from the whole number that is meant: clocks of cameras.
DRIFT: Final = 1e-4


class UnequalError(UsageError):
    """Streams that differ in time or rate and need an option for their alignment."""


def align(
    streams: Sequence[LogStream], options: InputOptions
) -> tuple[list[LogStream], float, FrameClock]:
    """Put streams on one clock; arrays always by index.

    Args:
        streams: the streams, one at least.
        options: the rate, the part of the logs, and how streams that differ are aligned.

    Returns:
        The streams with times, cut to the part that is asked for, their rate and their clock.

    Raises:
        UnequalError: the streams differ, and no option says how to align them.
        UsageError: no rate is known, or a stream has nothing in the part that is asked for.
    """
    arrays = all(stream.encoding == "numpy" for stream in streams)
    fps = options.rate or (FPS if arrays else _rate(streams))
    streams = [
        replace(s, times=times_of(np.arange(s.count), fps, s.begins)) if s.times is None else s
        for s in streams
    ]
    if options.start or options.end is not None:
        zero = min(int(_times(stream)[0]) for stream in streams)
        streams = [_excerpt(stream, options, zero) for stream in streams]
    times = list(map(_times, streams))
    by_index = arrays or (options.align == "index" and len(times) > 1)
    if options.align == "nearest" and abs(fps - round(fps)) <= DRIFT * fps:
        fps = float(round(fps))
    if options.align in ("time", "nearest"):
        nearest = options.align == "nearest"
        return streams, fps, clocks.by_time(times, fps, nearest=nearest)
    if not by_index:
        _refuse_unequal(streams, times, fps)
    return streams, fps, clocks.by_index(times, fps, gaps=not by_index)


def _times(stream: LogStream) -> IntArray:
    assert stream.times is not None
    return stream.times


def _rate(streams: Sequence[LogStream]) -> float:
    """Return rows a second of the first stream that has times.

    Raises:
        UsageError: no stream has times, or they tell no rate that is taken.
    """
    timed = next((stream for stream in streams if stream.times is not None), streams[0])
    step = float("nan") if timed.times is None else clocks.step_of(timed.times)
    if not (step > 0 and (timed.read is None or 1 / step <= RECORDED_FPS[1])):
        if timed.times is not None and not step > 0:
            why = (
                "has one row" if timed.count == 1 else "has most rows at the time of the row before"
            )
            raise UsageError(
                f"{timed.path} {why}, so it has no frame rate: set --rate in frames per second"
            )
        column = next((n for n in timed.fields if n in TIME_NAMES), "COLUMN")
        unit = f"its unit ({', '.join(UNITS)})"
        name = f", or name the column of times and {unit} with --set input.time={column}:UNIT"
        hint = name if timed.read is not None else ""
        raise UsageError(f"{timed.path} has no frame rate: set --rate in frames per second{hint}")
    return float(f"{1 / step:.6g}")


def _excerpt(stream: LogStream, options: InputOptions, zero: int) -> LogStream:
    """Return a stream between --start and --end, in seconds after the first row of all streams."""
    times = _times(stream)
    low, high = (
        len(times) if at is None else int(np.searchsorted(times, zero + round(at * NANOSECONDS)))
        for at in (options.start, options.end)
    )
    if options.end is not None and options.end < options.start:
        raise UsageError(f"--end {options.end:g} is before --start {options.start:g}")
    if low >= high:
        lasts = (int(times[-1]) - zero) / NANOSECONDS
        raise UsageError(
            f"{stream.path}: {stream.topic} has no images between --start and --end; its last is "
            f"at {lasts:g} s"
        )
    return stream.part(np.arange(low, high), times[low:high])


def _refuse_unequal(streams: Sequence[LogStream], times: Sequence[IntArray], fps: float) -> None:
    """Refuse streams that are not on one clock, or not of the rate asked for."""
    by_time = f"align them by time with --align time --rate {fps:g}"
    begins, ends = clocks.overlap(times)
    for stream, stamps in zip(streams, times, strict=True):
        two = f"{streams[0].topic} and {stream.topic}"
        if reason := clocks.unlike(times[0], stamps):
            if begins < ends:
                raise UnequalError(f"{two} have {reason}: {by_time}")
            raise UnequalError(
                f"{two} do not overlap in time: align them by number with "
                f"--align index --rate {fps:g}"
            )
        step = clocks.step_of(stamps)
        if step > 0 and abs(step * fps - 1) > clocks.UNEVEN:
            raise UnequalError(
                f"{stream.topic} has {1 / step:g} images per second, not {fps:g}: {by_time}"
            )


def join_parts(streams: Sequence[LogStream]) -> list[LogStream]:
    """Join logs of one topic that follow one another in time; others remain separate streams."""
    result: list[LogStream] = []
    for topic in dict.fromkeys(stream.topic for stream in streams):
        alike = [stream for stream in streams if stream.topic == topic]
        ordered = sorted(alike, key=lambda s: 0 if s.times is None else int(s.times[0]))
        follow = len(alike) > 1 and all(
            one.times is not None and two.times is not None and one.times[-1] < two.times[0]
            for one, two in itertools.pairwise(ordered)
        )
        result += [joined(ordered)] if follow else alike
    return result if len(result) < len(streams) else list(streams)


def unique_stream_names(streams: Sequence[LogStream]) -> tuple[str, ...]:
    """Name streams by their topics, and by files and folders where they share a topic.

    Raises:
        UsageError: a topic of a log is named twice.
    """
    topics = [stream.topic for stream in streams]
    if len(set(topics)) == len(topics):
        return stream_names(topics)
    places = [(stream.path.resolve(), stream.topic) for stream in streams]
    if len(set(places)) < len(places):
        place = next(place for place in places if places.count(place) > 1)
        raise UsageError(f"{place[1]} of {place[0]} is given twice: remove one")
    for folders in range(max(len(path.parts) for path, _ in places)):
        names = [_in_folders(stream, folders) for stream in streams]
        if len(set(names)) == len(names):
            return stream_names(names)
    return stream_names([f"{i + 1}/{topic}" for i, topic in enumerate(topics)])


def _in_folders(stream: LogStream, folders: int) -> str:
    """Return a stream's name with that of its file, and of some of the folders this is in."""
    path, name = stream.path, stream_name(stream.topic)
    if name not in (stream_name(path.stem), stream_name(path.resolve().name)):
        name = f"{path.stem}/{name}"
    above = Path(os.path.abspath(path)).parts[:-1]
    return "/".join([*above[max(len(above) - folders, 0) :], name])
