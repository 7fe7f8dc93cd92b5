"""Rows of numbers and images on their way into a Rerun recording, many at a time.

Handing rows over one by one costs a hundred times more. Rerun keeps reading what it was given
after the call: so an array is copied, but for images that nobody may write to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.clock import times_of
from replay.palette import Colour, packed_all, pale
from replay.view.labels import label

FRAME = "frame"
"""Timeline of the global frame counter t."""

ITERATION = "iteration"
"""Timeline of the learner's iterations."""

LOG_TIME = "message_log_time"
"""Timeline of the log time: the name Rerun's own MCAP loader gives it."""

TIMELINE_SIGNALS = ("iteration", "t", "log_time")
"""Signals that are not lines but the timelines themselves."""

MOST_STREAMS = 16
"""Streams with lines and lanes of their own: the most watched ones."""

AGGREGATION = rr.components.AggregationPolicy.MinMax
"""Lines with more values than the screen has columns are drawn from the least to the most.

Their mean, which the viewer draws where nothing is said, may be a value that never was.
"""

ROWS = 16000
"""Rows of a column that are handed over at once."""

MAX_BYTES = 4 * 1024 * 1024
"""Bytes of a column that wait no longer, and about the most that are handed over at once.

Of 12 MB of images at once Rerun's threads take twice as long, of .5 MB we do.
"""

Encode = Callable[[NDArray[Any]], Any]
"""Makes Rerun's component columns of (n, ...) values."""


def power_of_ten(values: FloatArray) -> FloatArray:
    """Logarithms of values, of any shape, to the base of ten; NaN of what has none."""
    return np.log10(np.where(values > 0, values, np.nan))


def scalars(values: NDArray[Any]) -> Any:
    """(n, ...) values as n rows of scalars."""
    return rr.Scalars.columns(scalars=np.array(values, dtype=np.float64).reshape(len(values), -1))


class Column:
    """One entity's rows of numbers, waiting to be handed over.

    Until there is a number that is not NaN, rows do not wait longer than others, and are then
    dropped: a signal that the run never has gets no entity.

    Args:
        target: where they go.
        path: the entity.
        style: what is said of it once.
        encode: how values are handed over.
        within: frames from a row to the next one, at most: where more lie between them, a row of
            NaN ends lines, which would lead across what was not watched; 0: they lead across.
    """

    def __init__(
        self,
        target: Target,
        path: str,
        style: Any = None,
        encode: Encode = scalars,
        *,
        within: int = 0,
    ) -> None:
        self.path, self._target = path, target
        self._style, self._encode, self._within = style, encode, within
        self._begun = False
        self._last: IntArray | None = None
        self._clear()

    def _clear(self) -> None:
        self._frames: list[IntArray] = []
        self._iterations: list[IntArray] = []
        self._values: list[NDArray[Any]] = []
        self._waiting = self._bytes = 0

    def add(self, frames: IntArray, iterations: IntArray | None, values: NDArray[Any]) -> None:
        """Take values of n rows, (n, ...), at n frames."""
        self._frames.append(frames)
        if iterations is not None:
            self._iterations.append(iterations)
        self._values.append(values)
        self._waiting += len(frames)
        self._bytes += values.nbytes
        if self._waiting >= ROWS or self._bytes >= MAX_BYTES:
            self.flush()

    def flush(self) -> None:
        """Hand over what waits."""
        if not self._waiting:
            return
        values = _joined(self._values)
        missing = values.dtype.kind == "f" and bool(np.isnan(values).all())
        if self._begun or not missing:
            if self._style is not None and not self._begun:
                self._target.log(self.path, self._style)
            self._begun = True
            frames = _joined(self._frames)
            iterations = _joined(self._iterations) if self._iterations else None
            if self._within:
                frames, iterations, values = self._ended_at_gaps(frames, iterations, values)
            rows = max(MAX_BYTES // max(values[:1].nbytes, 1), 1)
            for part in (slice(i, i + rows) for i in range(0, len(values), rows)):
                those = None if iterations is None else iterations[part]
                self.send(self._target.times(frames[part], those), values[part])
        self._clear()

    def _ended_at_gaps(
        self, frames: IntArray, iterations: IntArray | None, values: NDArray[Any]
    ) -> tuple[IntArray, IntArray | None, NDArray[Any]]:
        """Rows with one more of NaN where each gap begins.

        Of its iteration, the next one, the row behind it is the last: a table shows that.
        """
        last = frames[:1] if self._last is None else self._last
        self._last = frames[-1:]
        before = np.concatenate([last, frames[:-1]])
        gaps = np.flatnonzero(frames - before > self._within)
        if not len(gaps):
            return frames, iterations, values
        if iterations is not None:
            iterations = np.insert(iterations, gaps, iterations[gaps])
        values = np.insert(values.astype(np.float64), gaps, np.nan, axis=0)
        return np.insert(frames, gaps, before[gaps] + self._within), iterations, values

    def send(self, times: list[rr.TimeColumn], values: NDArray[Any]) -> None:
        """Hand (n, ...) values over as rows."""
        self._target.recording.send_columns(self.path, times, self._encode(values))


def _joined(parts: list[NDArray[Any]]) -> NDArray[Any]:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


@dataclass(frozen=True, slots=True)
class Target:
    """A Rerun recording, and the source on whose clock its rows stand."""

    recording: rr.RecordingStream
    spec: SourceSpec

    def times(self, frames: IntArray, iterations: IntArray | None = None) -> list[rr.TimeColumn]:
        """The times of rows at these frames, on each timeline."""
        times = times_of(frames, self.spec.fps, self.spec.start_ns)
        found = [
            rr.TimeColumn(FRAME, sequence=frames.copy()),
            rr.TimeColumn(LOG_TIME, timestamp=times.astype("datetime64[ns]")),
        ]
        if iterations is not None:
            found.append(rr.TimeColumn(ITERATION, sequence=iterations.copy()))
        return found

    def send(self, path: str, frames: IntArray, iterations: IntArray, rows: Any) -> None:
        """Hand rows over at once."""
        self.recording.send_columns(path, self.times(frames, iterations), rows)

    def log(self, path: str, value: Any) -> None:
        """Say something of an entity that holds at all times."""
        self.recording.log(path, value, static=True)

    def log_at(self, path: str, t: int, iteration: int, value: Any) -> None:
        """Log something at a frame and iteration."""
        self.recording.set_time(FRAME, sequence=t)
        self.recording.set_time(ITERATION, sequence=max(iteration, 0))
        at = np.datetime64(self.spec.time_ns(t), "ns")
        self.recording.set_time(LOG_TIME, timestamp=at)
        self.recording.log(path, value)

    def lines(
        self,
        path: str,
        names: Sequence[str],
        rgbs: Sequence[Colour] | None = None,
        width: float | None = None,
        *,
        within: int = 0,
    ) -> Column:
        """A column that is drawn as lines, whose names and colours are said once.

        Args:
            path: the entity.
            names: of the lines.
            rgbs: their colours.
            width: of a line.
            within: see `Column`.
        """
        style = rr.SeriesLines(
            names=[label(name) for name in names],
            colors=packed_all(rgbs or [pale(i) for i in range(len(names))]),
            widths=None if width is None else [width] * len(names),
            aggregation_policy=AGGREGATION,
        )
        return Column(self, path, style, within=within)

    def frames(self, path: str, width: float | None = None) -> Column:
        """A column of the source's frames: images, or lines of values."""
        if self.spec.images:
            return self.images(path)
        names = [f"value {i + 1}" for i in range(int(np.prod(self.spec.frame_shape)))]
        return self.lines(path, names, width=width, within=1)

    def images(self, path: str) -> Column:
        """A column of images of the source, (n, height, width) grey."""
        height, width = self.spec.frame_shape
        form = rr.components.ImageFormat(
            width=width, height=height, color_model="L", channel_datatype="U8"
        )
        return Column(self, path, rr.Image.from_fields(format=form), images)

    def tensors(self, path: str, names: Sequence[str]) -> Column:
        """A column of tensors of one shape, with a name for each dimension."""
        return Column(self, path, None, lambda values: named_tensors(values, names))


class _Batch:
    """An Arrow array of n rows of the component that another batch has one of."""

    def __init__(self, one: Any, rows: pa.Array) -> None:
        self._one, self._rows = one, rows

    def component_descriptor(self) -> Any:
        return self._one.component_descriptor()

    def as_arrow_array(self) -> pa.Array:
        return self._rows


def images(values: NDArray[np.uint8]) -> Any:
    """(n, ...) bytes as n rows of images; `rr.Image.columns` copies them three times.

    They are copied once where they may be written to. A test holds this against `rr.Image`.
    """
    one = rr.Image.from_fields(buffer=b"\0").as_component_batches()[0]
    count, pixels = len(values), values.reshape(-1)
    blobs = pa.array(pixels.copy() if values.flags.writeable else pixels)
    kind = one.as_arrow_array().type
    return [_Batch(one, _lists(count, 1, _lists(count, values[0].size, blobs, kind)))]


def named_tensors(values: NDArray[Any], names: Sequence[str]) -> Any:
    """(n, *shape) values as n rows of tensors; `rr.Tensor.columns` takes one at a time.

    A test holds this encoding against `rr.Tensor`.
    """
    made = tensors(np.asarray(values, dtype=np.float64), names)
    one = rr.Tensor.from_fields(data=made[:1]).as_component_batches()[0]
    return [_Batch(one, _lists(len(made), 1, made))]


def tensors(values: NDArray[np.float64], names: Sequence[str] = ()) -> pa.Array:
    """(n, *shape) values as n tensors in Rerun's type.

    Rerun's own conversion takes one tensor at a time.
    """
    kind = rr.components.TensorDataBatch(None).as_arrow_array().type
    union = kind.field("buffer").type
    position = next(i for i in range(union.num_fields) if union.field(i).name == "F64")
    count, shape = len(values), np.array(values.shape[1:], dtype=np.uint64)
    children = [
        pa.nulls(0) if pa.types.is_null(field.type) else pa.array([], field.type)
        for field in map(union.field, range(union.num_fields))
    ]
    numbers = pa.array(values.reshape(-1).copy())
    children[position] = _lists(count, int(np.prod(shape)), numbers, union.field(position).type)
    buffer = pa.Array.from_buffers(
        union,
        count,
        [
            None,
            pa.py_buffer(np.full(count, union.type_codes[position], dtype=np.int8)),
            pa.py_buffer(np.arange(count, dtype=np.int32)),
        ],
        children=children,
    )
    of_names = kind.field("names").type
    named = pa.nulls(count, of_names)
    if names:
        named = _lists(count, len(shape), pa.array([*names] * count, of_names.value_type), of_names)
    parts = [
        _lists(count, len(shape), pa.array(np.tile(shape, count)), kind.field("shape").type),
        named,
        buffer,
    ]
    return pa.StructArray.from_arrays(parts, fields=list(kind))


def _lists(count: int, width: int, values: pa.Array, kind: pa.DataType | None = None) -> pa.Array:
    """Values as lists of so many each."""
    offsets = pa.array(np.arange(count + 1, dtype=np.int32) * width)
    return pa.ListArray.from_arrays(offsets, values, type=kind)
