"""A recording, or other logs, as a report shows it: every stream, its gaps, what the world knew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import CdmisfaError
from replay.report.drawing import (
    WIDE,
    Axis,
    Plot,
    beside,
    colour_class,
    data_uri,
    padded,
    reduced,
    sheet,
)
from replay.report.panels import LANE, NEAR, PIXELS, ROOM, Frames, frames_at, numbers_plot
from replay.report.trust import command

SAMPLES = 48
"""Frames of each stream that are shown where one points."""

STRIP = 10
"""Frames of each stream that are shown side by side."""

STREAMS = 24
"""Streams that are shown."""

ROWS, RUNS = 20_000, 200
"""Frames of numbers that are drawn; of longer streams so many stretches of as many in all."""

TRUTH = 400
"""Frames of what the world knew that are drawn."""


def recording_content(source: Any, paths: Sequence[Path]) -> dict[str, Any]:
    """What the page of a recording is made of; see recording.html."""
    spec = source.spec
    first, count = source.first_frame, source.frames
    seconds = count / spec.fps
    plot = _lanes(source)
    frames: dict[str, Frames] = {}
    problems: list[str] = []
    streams = []
    for s, name in enumerate(spec.streams[:STREAMS]):
        try:
            streams.append(_stream(source, s, frames))
        except CdmisfaError as error:
            problems.append(f"{name} cannot be read to its end: {error}")
    size = "x".join(map(str, reversed(spec.frame_shape)))
    what = f"pictures of {size}" if spec.images else f"frames of {size} numbers"
    return {
        "kind": "recording",
        "title": ", ".join(path.resolve().name for path in paths),
        "lead": f"{len(spec.streams)} stream{'s' * (len(spec.streams) > 1)}, {count:,} frames "
        f"each at {spec.fps:g} a second ({seconds:,.1f} s), {what}.",
        "problems": [*problems, *source.warnings],
        "notes": list(getattr(source, "notes", ())),
        "lanes": plot,
        "gaps": _gaps(source),
        "streams": streams,
        "more": max(len(spec.streams) - STREAMS, 0),
        "truth": _truth(source),
        "commands": [
            (text, command(name, *paths))
            for text, name in (
                ("Check that it is whole", "verify"),
                ("See every frame", "view"),
                ("Learn from it", "learn"),
            )
        ],
        "first": f"{first:,}",
        "frames": {key: asdict(value) for key, value in frames.items()},
    }


def _lanes(source: Any) -> Plot:
    spec, first, count = source.spec, source.first_frame, source.frames
    shown = range(len(spec.streams[:STREAMS]))
    height = LANE * len(shown)
    plot = Plot(
        Axis(first, first + max(count, 1), WIDE),
        Axis(0, height, height),
        "Which frames each stream has",
        names=beside(spec.streams, shown),
    )
    for s in shown:
        top, high = LANE * s, LANE - ROOM
        plot.path("lane", f"M0 {top}h{WIDE}v{high}H0z")
        parts = (
            f"M{a:.1f} {top}H{b:.1f}v{high}H{a:.1f}z"
            for low, stop in source.spans(s, first, first + count)
            for a, b in [plot.x([low, stop]).tolist()]
        )
        plot.path(f"fill {colour_class(s)}", "".join(parts))
    return plot


def _gaps(source: Any) -> list[tuple[str, str, str]]:
    spec, first, count = source.spec, source.first_frame, source.frames
    found = []
    for s, name in enumerate(spec.streams):
        spans = source.spans(s, first, first + count)
        missing = count - sum(stop - start for start, stop in spans)
        if missing:
            found.append((name, f"{max(len(spans) - 1, 1):,}", f"{missing:,}"))
    return found


def _rows(source: Any, stream: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """The numbers of a stream, of a long one in stretches."""
    first, count = source.first_frame, source.frames
    held = source.spans(stream, first, first + count)
    if sum(stop - start for start, stop in held) > ROWS:
        length = ROWS // RUNS
        starts = np.linspace(first, first + count - length, RUNS).astype(int).tolist()
        held = [span for a in starts for span in source.spans(stream, a, a + length)]
    t, rows = [np.empty(0, np.int64)], [np.empty((0, *source.spec.frame_shape))]
    for start, stop in held:
        source.seek(start)
        rows.append(source.take(stream, stop - start).frames)
        t.append(np.arange(start, stop))
    return np.concatenate(t), np.concatenate(rows)


def _sampled(source: Any, stream: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Some frames of a stream, spread evenly over those that it has."""
    first, count = source.first_frame, source.frames
    held = source.spans(stream, first, first + count)
    lengths = np.cumsum([stop - start for start, stop in held])
    total = int(lengths[-1]) if len(lengths) else 0
    t, frames = [], []
    for k in np.unique(np.linspace(0, total - 1, min(SAMPLES, total)).astype(int)).tolist():
        span = int(np.searchsorted(lengths, k, side="right"))
        at = held[span][1] - (int(lengths[span]) - k)
        source.seek(at)
        t.append(at)
        frames.append(source.take(stream, 1).frames[0])
    return np.array(t, np.int64), np.array(frames)


def _stream(source: Any, stream: int, frames: dict[str, Frames]) -> dict[str, Any]:
    spec, key = source.spec, f"stream{stream}"
    first, count = source.first_frame, source.frames
    t, shown = _sampled(source, stream) if spec.images else _rows(source, stream)
    found: dict[str, Any] = {
        "name": spec.streams[stream],
        "colour": colour_class(stream),
        "count": f"{sum(b - a for a, b in source.spans(stream, first, first + count)):,}",
        "picture": "", "picked": "", "plot": None, "numbers": None,
    }  # fmt: skip
    if not len(t):
        return found
    if not spec.images:
        about = f"Numbers of {spec.streams[stream]} over its frames"
        found["numbers"] = numbers_plot(shown, about, 110, t)
        return found
    picked = np.unique(np.linspace(0, len(t) - 1, STRIP).astype(int))
    small = [reduced(shown[i], PIXELS) for i in picked]
    found["picture"] = data_uri(sheet(small, len(small), 2), photo=True)
    found["picked"] = f"{len(small)} frames, from {t[0]:,} to {t[-1]:,}"
    values = shown.reshape(len(shown), -1).astype(np.float64)
    light, spread = values.mean(axis=1), values.std(axis=1)
    low, high = padded(np.concatenate([light, spread]), log=False)
    plot = Plot(
        Axis(first, first + max(count, 1), WIDE),
        Axis(low, high, NEAR, turned=True),
        f"Mean brightness and contrast of {spec.streams[stream]} over its frames",
        frames=key,
    )
    plot.grid(2)
    plot.line(f"broad {colour_class(stream)}", t.astype(float), light)
    plot.line("plain", t.astype(float), spread)
    found["plot"] = plot
    frames[key] = frames_at(plot, t, shown, [f"frame {k:,}" for k in t.tolist()], images=True)
    return found


def _truth(source: Any) -> list[tuple[str, Plot]]:
    """What the world knew, where it says."""
    spec, first, count = source.spec, source.first_frame, source.frames
    if not spec.truth:
        return []
    t = np.unique(np.linspace(first, first + count - 1, min(TRUTH, count)).astype(int))
    rows = []
    for at in t.tolist():
        source.seek(at)
        rows.append(source.take(0, 1).truth[0])
    values, found = np.array(rows), []
    for column, name in enumerate(spec.truth):
        low, high = padded(values[:, column], log=False)
        plot = Plot(
            Axis(first, first + max(count, 1), WIDE), Axis(low, high, NEAR, turned=True), name
        )
        plot.grid(2)
        plot.most = 3
        plot.dots("plain", t.astype(float), values[:, column])
        found.append((name, plot))
    return found
