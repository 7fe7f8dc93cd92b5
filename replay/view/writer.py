"""Write numbers, images and texts into a Rerun recording, many rows at a time.

Every part of a view writes through `Writer`, which knows the clock of the frames, buffers the
rows of each entity, and remembers the range of its values. Sending rows one by one would cost a
hundred times more. Rerun reads an array after the call that sends it, so arrays are copied, except
read-only images.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.clock import times_of
from replay.palette import RgbOrRgba, packed_all, pale

# Timeline of the global frame counter t.
FRAME = "frame"

# Timeline of the learner's iterations.
ITERATION = "iteration"

# Timeline of the log time: the name Rerun's own MCAP loader gives it.
LOG_TIME = "message_log_time"

# Most streams with lines and state timelines: the most attended ones; more would be unreadable.
MOST_STREAMS = 16

# Draw lines with more values than pixels from their minimum to their maximum. The mean, the
# default of Rerun 0.41, may be a value that never occurred.
AGGREGATION = rr.components.AggregationPolicy.MinMax

# Rows of an entity that are sent at once.
MAX_ROWS = 16_000

# Bytes of an entity's rows that are sent at once. With 12 MB of images at once Rerun's threads take
# twice as long, with 0.5 MB our own loop does.
MAX_BYTES = 4 * 1024 * 1024

# Width of lines, in points.
WIDTH = 1.5

# Least and greatest value.
Interval = tuple[float, float]

# Frames of n rows, and their iterations where the source has any, (n,) each.
At = tuple[IntArray, IntArray | None]

Encode = Callable[[NDArray[Any]], Any]

# Characters in the viewer's font: Rerun 0.41 panics at any other.
_DRAWN = (
    (0x20, 0x7E),  # ASCII
    (0xA1, 0x17F),  # Latin
    (0x300, 0x304),  # accents that are put over letters, as in η̇
    (0x306, 0x30C),
    (0x384, 0x3CE),  # Greek
    (0x400, 0x45F),  # Cyrillic
)


@lru_cache(maxsize=4096)
def drawable(text: str) -> str:
    """Return a text without the letters that the viewer cannot draw."""
    letters = (c for c in text if c not in "⟨⟩")
    return "".join(
        c if c == "\n" or any(low <= ord(c) <= high for low, high in _DRAWN) else "?"
        for c in letters
    )


def part(names: Sequence[str], index: int) -> str:
    """Return a stream's part of an entity's path: its number from 1, which sorts it, and name."""
    return str(rr.escape_entity_path_part(f"{index + 1}_{drawable(names[index])}"))


def for_stream(path: str, spec: SourceSpec, stream: int) -> str:
    """Return the entity of a stream's frames or weights: one for all if they have one kind."""
    return f"{path}/{part(spec.streams, stream)}" if spec.kinds else path


def power_of_ten(values: FloatArray) -> FloatArray:
    """Return the logarithms of values to the base of ten; NaN for values that have none."""
    return np.log10(np.where(values > 0, values, np.nan))


def changes(values: NDArray[Any], before: Any) -> IntArray:
    """Return the indices at which values differ from the one before them."""
    return np.flatnonzero(np.diff(values.astype(np.int64), prepend=before))


def scalar_columns(values: NDArray[Any]) -> Any:
    """Return (n, lines) numbers as n rows."""
    return rr.Scalars.columns(scalars=values)


def image_columns(values: NDArray[np.uint8]) -> Any:
    """Return (n, ...) bytes as n rows of images, copied only where they may be written to."""
    pixels = values.copy() if values.flags.writeable else values
    offsets = pa.array(np.arange(len(values) + 1, dtype=np.int32) * values[0].size)
    kind = rr.components.ImageBufferBatch(b"\0").as_arrow_array().type
    # Rerun takes an Arrow array as it is, and copies anything else three times.
    blobs = pa.ListArray.from_arrays(offsets, pa.array(pixels.reshape(-1)), type=kind)
    return rr.Image.columns(buffer=blobs)


@dataclass(slots=True)
class _Buffer:
    """Rows of one entity that wait to be sent."""

    encode: Encode
    style: Any
    gap: int
    sent: bool = False
    last: IntArray | None = None
    parts: list[tuple[IntArray, IntArray | None, NDArray[Any]]] = field(default_factory=list)
    rows: int = 0
    bytes: int = 0


class Writer:
    """Writes the rows of a view into a Rerun recording.

    Args:
        recording: the recording.
        spec: the source whose frames give the clock.

    Attributes:
        spans: least and greatest value of every entity of numbers that has a value.
    """

    def __init__(self, recording: rr.RecordingStream, spec: SourceSpec) -> None:
        self.recording, self.spec = recording, spec
        self.spans: dict[str, Interval] = {}
        self._buffers: dict[str, _Buffer] = {}

    def log(self, path: str, value: Any) -> None:
        """Log a value without a time."""
        self.recording.log(path, value, static=True)

    def event(self, t: int, iteration: int | None, text: str, level: str = "INFO") -> None:
        """Log the text of an event."""
        level = "WARN" if level == "WARNING" else level
        self.log_at("events", t, iteration, rr.TextLog(drawable(text), level=level))

    def log_at(self, path: str, t: int, iteration: int | None, value: Any) -> None:
        """Log a value at a frame, and an iteration where the source has any."""
        self.recording.set_time(FRAME, sequence=t)
        if iteration is not None:
            self.recording.set_time(ITERATION, sequence=max(iteration, 0))
        at = np.datetime64(self.spec.time_ns(t), "ns")
        self.recording.set_time(LOG_TIME, timestamp=at)
        self.recording.log(path, value)

    def send(self, path: str, at: At, columns: Any) -> None:
        """Send Rerun's component columns at once, a row for each frame."""
        frames, iterations = at
        clock = times_of(frames, self.spec.fps, self.spec.start_ns)
        times = [
            rr.TimeColumn(FRAME, sequence=frames.copy()),
            rr.TimeColumn(LOG_TIME, timestamp=clock.astype("datetime64[ns]")),
        ]
        if iterations is not None:
            times.append(rr.TimeColumn(ITERATION, sequence=iterations.copy()))
        self.recording.send_columns(path, times, columns)

    def lines(
        self,
        path: str,
        names: Sequence[str],
        at: At,
        values: NDArray[Any],
        rgbs: Sequence[RgbOrRgba] = (),
        *,
        width: float = WIDTH,
        gap: int = 0,
    ) -> None:
        """Buffer (n, ...) values that are drawn as lines; see `buffer`.

        Names and colors, by default pale ones, count when the entity is first written.
        """
        style = None
        if path not in self._buffers:
            style = rr.SeriesLines(
                names=[drawable(name) for name in names],
                colors=packed_all(rgbs or [pale(i) for i in range(len(names))]),
                widths=[width] * len(names),
                aggregation_policy=AGGREGATION,
            )
        self.buffer(path, at, values, style, gap=gap)

    def frames(self, path: str, at: At, values: NDArray[Any], stream: int) -> None:
        """Buffer frames of a stream, or of one with the same kind: gray images, or lines."""
        spec = self.spec.of(stream)
        shape = spec.frame_shape
        if spec.images:
            form = rr.components.ImageFormat(
                width=shape[1], height=shape[0], color_model="L", channel_datatype="U8"
            )
            self.buffer(path, at, values, rr.Image.from_fields(format=form), image_columns)
        else:
            names = [f"value {i + 1}" for i in range(int(np.prod(shape)))]
            self.lines(path, names, at, values, gap=1)

    def buffer(
        self,
        path: str,
        at: At,
        values: NDArray[Any],
        style: Any = None,
        encode: Encode = scalar_columns,
        *,
        gap: int = 0,
    ) -> None:
        """Buffer rows of an entity, and send them when they are many.

        Numbers that are all NaN are not written: the run does not have their signal.

        Args:
            path: the entity.
            at: frames and iterations of the rows.
            values: (n, ...).
            style: value that is logged once, before the first row.
            encode: makes Rerun's component columns of values.
            gap: frames from a row to the next one, at most: where more lie between them, a row of
                NaN ends the lines; 0: lines are never ended.
        """
        if path not in self._buffers:
            self._buffers[path] = _Buffer(encode, style, gap)
        waiting = self._buffers[path]
        waiting.parts.append((*at, values))
        waiting.rows += len(values)
        waiting.bytes += values.nbytes
        if waiting.rows >= MAX_ROWS or waiting.bytes >= MAX_BYTES:
            self._send_buffer(path, waiting)

    def flush(self) -> None:
        """Send all rows that wait."""
        for path, waiting in self._buffers.items():
            self._send_buffer(path, waiting)

    def covered(self, entity: str) -> Interval | None:
        """Return the least and the greatest value of an entity that is written, or of many (**)."""
        spans = [self.spans[path] for path in self.matching(entity)]
        return (min(low for low, _ in spans), max(high for _, high in spans)) if spans else None

    def matching(self, entity: str) -> list[str]:
        """Return the written entities of numbers that a path with wildcards (**) names."""
        return fnmatch.filter(self.spans, entity.lstrip("/").replace("**", "*"))

    def _send_buffer(self, path: str, waiting: _Buffer) -> None:
        if not waiting.rows:
            return
        frames, iterations, values = (
            parts[0] if len(parts) == 1 or parts[0] is None else np.concatenate(parts)
            for parts in zip(*waiting.parts, strict=True)
        )
        waiting.parts, waiting.rows, waiting.bytes = [], 0, 0
        if waiting.encode is scalar_columns:
            values = values.reshape(len(values), -1).astype(np.float64)
            finite = values[np.isfinite(values)]
            if len(finite):
                low, high = self.spans.get(path, (np.inf, -np.inf))
                self.spans[path] = min(low, float(finite.min())), max(high, float(finite.max()))
            elif not waiting.sent and np.isnan(values).all():
                return
        if waiting.style is not None and not waiting.sent:
            self.log(path, waiting.style)
        waiting.sent = True
        if waiting.gap:
            frames, iterations, values = _ended_at_gaps(waiting, frames, iterations, values)
        rows = max(MAX_BYTES // max(values[:1].nbytes, 1), 1)
        for piece in (slice(i, i + rows) for i in range(0, len(values), rows)):
            at = frames[piece], None if iterations is None else iterations[piece]
            self.send(path, at, waiting.encode(values[piece]))


def _ended_at_gaps(
    waiting: _Buffer, frames: IntArray, iterations: IntArray | None, values: NDArray[Any]
) -> tuple[IntArray, IntArray | None, NDArray[Any]]:
    """Insert a row of NaN where each gap begins, at the iteration of the row behind the gap."""
    last = frames[:1] if waiting.last is None else waiting.last
    waiting.last = frames[-1:]
    before = np.concatenate([last, frames[:-1]])
    gaps = np.flatnonzero(frames - before > waiting.gap)
    if not len(gaps):
        return frames, iterations, values
    if iterations is not None:
        iterations = np.insert(iterations, gaps, iterations[gaps])
    values = np.insert(values, gaps, np.nan, axis=0)
    return np.insert(frames, gaps, before[gaps] + waiting.gap), iterations, values
