"""Rows of signals on their way into a Rerun recording, many at a time.

Handing rows over one by one costs a hundred times more. Every array is copied: Rerun
keeps reading what it was given after the call.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.clock import times_of

FRAME = "frame"
"""Timeline of the global frame counter t."""

ITERATION = "iteration"
"""Timeline of the learner's iterations."""

LOG_TIME = "message_log_time"
"""Timeline of the log time: the name Rerun's own MCAP loader gives it."""

TIMELINE_SIGNALS = ("iteration", "t", "log_time")
"""Signals that are not lines but the timelines themselves."""

MAX_BYTES = 4 * 1024 * 1024
"""Most bytes of a column that wait."""


class Clock:
    """Where a row stands on each timeline.

    Args:
        spec: of the source, for the log time of a frame.
    """

    def __init__(self, spec: SourceSpec) -> None:
        self._spec = spec

    def columns(
        self, frames: NDArray[np.int64], iterations: NDArray[np.int64] | None
    ) -> list[rr.TimeColumn]:
        """Columns of time for rows at these frames."""
        times = times_of(frames, self._spec.fps, self._spec.start_ns)
        found = [
            rr.TimeColumn(FRAME, sequence=frames.copy()),
            rr.TimeColumn(LOG_TIME, timestamp=times.astype("datetime64[ns]")),
        ]
        if iterations is not None:
            found.append(rr.TimeColumn(ITERATION, sequence=iterations.copy()))
        return found


class Column:
    """One entity's rows, waiting to be handed over.

    Args:
        recording: where they go.
        clock: how frames become times.
        path: the entity.
        rows: hand over when so many rows, or `MAX_BYTES`, wait.
    """

    def __init__(self, recording: rr.RecordingStream, clock: Clock, path: str, rows: int) -> None:
        self.path = path
        self._recording = recording
        self._clock = clock
        self._rows = rows
        self._frames: list[NDArray[np.int64]] = []
        self._iterations: list[NDArray[np.int64]] = []
        self._values: list[NDArray[Any]] = []
        self._waiting = 0
        self._bytes = 0

    def add(
        self,
        frames: NDArray[np.int64],
        iterations: NDArray[np.int64] | int | None,
        values: NDArray[Any],
    ) -> None:
        """Take values of n rows, at n frames of one iteration or of n."""
        self._frames.append(frames)
        if iterations is not None:
            self._iterations.append(np.broadcast_to(iterations, (len(frames),)))
        self._values.append(values)
        self._waiting += len(frames)
        self._bytes += values.nbytes
        if self._waiting >= self._rows or self._bytes >= MAX_BYTES:
            self.flush()

    def flush(self) -> None:
        """Hand over what waits."""
        if self._waiting:
            iterations = _joined(self._iterations) if self._iterations else None
            times = self._clock.columns(_joined(self._frames), iterations)
            self.send(times, _joined(self._values))
        self._frames, self._iterations, self._values = [], [], []
        self._waiting = self._bytes = 0

    def send(self, times: list[rr.TimeColumn], values: NDArray[Any]) -> None:
        """Hand (n, ...) values over as rows of scalars."""
        table = np.array(values, dtype=np.float64).reshape(len(values), -1)
        self._recording.send_columns(self.path, times, rr.Scalars.columns(scalars=table))


def _joined(parts: list[NDArray[Any]]) -> NDArray[Any]:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


class ImageColumn(Column):
    """Images, (n, height, width) grey or (n, height, width, 3) colour."""

    def send(self, times: list[rr.TimeColumn], values: NDArray[Any]) -> None:
        """Hand n images over."""
        buffers = np.ascontiguousarray(values).reshape(len(values), -1)
        self._recording.send_columns(self.path, times, rr.Image.columns(buffer=buffers))

    def declare(self, height: int, width: int, *, colours: bool = False) -> None:
        """Say once what the images are."""
        form = rr.components.ImageFormat(
            width=width,
            height=height,
            color_model="RGB" if colours else "L",
            channel_datatype="U8",
        )
        self._recording.log(self.path, rr.Image.from_fields(format=form), static=True)


class TensorColumn(Column):
    """Tensors of one shape, with a name for each dimension."""

    def __init__(
        self,
        recording: rr.RecordingStream,
        clock: Clock,
        path: str,
        rows: int,
        names: Sequence[str],
    ) -> None:
        super().__init__(recording, clock, path, rows)
        self._names = names

    def send(self, times: list[rr.TimeColumn], values: NDArray[Any]) -> None:
        """Hand n tensors over."""
        batch: Any = _TensorBatch(tensor_array(np.asarray(values, dtype=np.float64), self._names))
        self._recording.send_columns(self.path, times, [batch])


class _TensorBatch:
    """A column of tensors; `rr.Tensor.columns` takes one at a time."""

    def __init__(self, array: pa.Array) -> None:
        self._array = array

    def component_descriptor(self) -> Any:
        return rr.Tensor(np.zeros((1, 1))).as_component_batches()[0].component_descriptor()

    def as_arrow_array(self) -> pa.Array:
        return self._array


def tensor_array(block: NDArray[np.float64], names: Sequence[str]) -> pa.Array:
    """(n, *shape) values as n rows of Rerun's tensor type.

    The type is Rerun's own; a test holds this encoding against `rr.Tensor`.
    """
    kind = rr.encodings.TensorDataBatch._ARROW_DATATYPE
    union = kind.field("buffer").type
    position = next(i for i in range(union.num_fields) if union.field(i).name == "F64")
    count, shape = len(block), np.array(block.shape[1:], dtype=np.uint64)
    size = int(np.prod(shape))
    children = [
        pa.nulls(0) if pa.types.is_null(union.field(i).type) else pa.array([], union.field(i).type)
        for i in range(union.num_fields)
    ]
    children[position] = pa.ListArray.from_arrays(
        _offsets(count, size),
        pa.array(np.array(block).reshape(-1)),
        type=union.field(position).type,
    )
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
    shapes = pa.ListArray.from_arrays(
        _offsets(count, len(shape)), pa.array(np.tile(shape, count)), type=kind.field("shape").type
    )
    labels = pa.ListArray.from_arrays(
        _offsets(count, len(shape)),
        pa.array(list(names) * count, type=kind.field("names").type.value_type),
        type=kind.field("names").type,
    )
    rows = pa.StructArray.from_arrays([shapes, labels, buffer], fields=list(kind))
    return pa.ListArray.from_arrays(_offsets(count), rows)


def _offsets(count: int, width: int = 1) -> pa.Array:
    return pa.array(np.arange(count + 1, dtype=np.int32) * width)
