"""What frozen modules give on the frames of a log, written for other programs as it comes."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from google.protobuf import descriptor_pb2
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.clock import times_of
from cdmisfa.modules import Module, columns_of
from recorder.log.files import atomic_write, refuse_special, refuse_taken
from recorder.log.logfile import LogFile
from recorder.log.messages import ENCODING, ImageEncoder, VectorEncoder, varint, view_topic
from replay.runs.codec import define_message

ROWS: Final = 8192
"""Rows of a table that are written at once."""

_FIELD = descriptor_pb2.FieldDescriptorProto
OUTPUT_SCHEMA: Final = "cdmisfa.ModuleOutput"
_, OUTPUT_DEFINITION = define_message(
    OUTPUT_SCHEMA,
    "module_output",
    [
        ("y", 1, _FIELD.TYPE_DOUBLE, True, "Outputs on the frame, the slowest first"),
        ("slowness", 2, _FIELD.TYPE_DOUBLE, True, "Of each within the block, 1/frame"),
        ("alive", 3, _FIELD.TYPE_BOOL, False, "Whether the first varies as where it was learned"),
        ("novelty", 4, _FIELD.TYPE_DOUBLE, False, "Of the block, 1 and above where it is another"),
        ("frame", 5, _FIELD.TYPE_SFIXED64, False, "Number of the frame"),
    ],
)


@dataclass(frozen=True, slots=True)
class Applied:
    """What M modules with R outputs together give on frames that follow one another.

    Attributes:
        block: of one stream, no longer than a block of the run that learned the modules.
        y: (n, R) outputs of all modules, one beside the other.
        slowness: (R,) of each output within the block, 1/frame; infinite where it stands still.
        alive: (M,) whether the module's first output varies there as where it was learned.
        novelty: (M,) how much else than there it gives, 1 at the bound from which it does not
            know the block.
    """

    block: Block
    y: FloatArray
    slowness: FloatArray
    alive: NDArray[np.bool_]
    novelty: FloatArray


class AppliedSink(Protocol):
    """Takes what modules give, block by block."""

    def add(self, applied: Applied) -> None:
        """Take a block in."""

    def close(self) -> None:
        """Let go; what was taken in is written."""


class TableSink:
    """A table with a row a frame of a stream, Parquet or CSV by the name of the file.

    What has no value is null, or nothing between two commas.

    Args:
        path: of the file.
        form: "parquet" or "csv".
        spec: of the frames.
        modules: in their order.
        log: what is said in a first column, where the table is one of many logs' tables.
    """

    def __init__(
        self, path: Path, form: str, spec: SourceSpec, modules: Sequence[Module], log: str | None
    ) -> None:
        import pyarrow as pa
        import pyarrow.csv as pacsv
        import pyarrow.parquet as pq

        self._pa, self._spec, self._log = pa, spec, log
        self._modules = list(columns_of(modules))
        fields = [("log_time", pa.int64()), ("t", pa.int64()), ("stream", pa.string())]
        if log is not None:
            fields.insert(0, ("log", pa.string()))
        plain = ["log_time", "t"]
        for module, own in self._modules:
            name, outputs = f"module{module.index}", range(own.stop - own.start)
            fields += [(f"{name}_y{j}", pa.float64()) for j in outputs]
            plain += [f"{name}_y{j}" for j in outputs]
            fields += [(f"{name}_slowness{j}", pa.float64()) for j in outputs]
            fields += [(f"{name}_alive", pa.bool_()), (f"{name}_novelty", pa.float64())]
        self._schema = pa.schema(fields)
        self._writer: Any
        if form == "parquet":
            of_blocks = [name for name, _ in fields if name not in plain]
            self._writer = pq.ParquetWriter(
                path, self._schema, compression="zstd", use_dictionary=of_blocks
            )
        else:
            self._writer = pacsv.CSVWriter(path, self._schema)
        self._waiting: list[Applied] = []
        self._count = 0

    def add(self, applied: Applied) -> None:
        """See `AppliedSink`."""
        self._waiting.append(applied)
        self._count += len(applied.block)
        if self._count >= ROWS:
            self._write()

    def close(self) -> None:
        """See `AppliedSink`."""
        self._write()
        self._writer.close()

    def _write(self) -> None:
        if not self._waiting:
            return
        pa, waiting, spec = self._pa, self._waiting, self._spec
        lengths = [len(one.block) for one in waiting]
        t = np.concatenate(
            [np.arange(one.block.t, one.block.t + len(one.block)) for one in waiting]
        )
        names = np.array(spec.streams, object)[[one.block.stream for one in waiting]]

        def of_block(values: Any) -> Any:
            each = np.repeat(np.stack(values), lengths, axis=0)
            return each if each.dtype == bool else np.where(np.isfinite(each), each, np.nan)

        y = np.concatenate([one.y for one in waiting])
        slowness = of_block([one.slowness for one in waiting])
        alive = of_block([one.alive for one in waiting])
        novelty = of_block([one.novelty for one in waiting])
        columns: list[Any] = [] if self._log is None else [pa.repeat(self._log, len(t))]
        columns += [pa.array(times_of(t, spec.fps, spec.start_ns)), pa.array(t)]
        columns.append(pa.array(np.repeat(names, lengths), pa.string()))
        for i, (_, own) in enumerate(self._modules):
            columns += [pa.array(y[:, j]) for j in range(own.start, own.stop)]
            columns += [
                pa.array(slowness[:, j], from_pandas=True) for j in range(own.start, own.stop)
            ]
            columns.append(pa.array(alive[:, i]))
            columns.append(pa.array(novelty[:, i], from_pandas=True))
        self._writer.write_batch(pa.RecordBatch.from_arrays(columns, schema=self._schema))
        self._waiting, self._count = [], 0


def _encoded(applied: Applied, module: int, own: slice) -> list[bytes]:
    """The messages `cdmisfa.ModuleOutput` of a module on a block, all laid out alike."""
    rows = np.repeat(_row(own.stop - own.start), len(applied.block))
    rows["y"], rows["slowness"] = applied.y[:, own], applied.slowness[own]
    rows["alive"], rows["novelty"] = applied.alive[module], applied.novelty[module]
    rows["frame"] = applied.block.t + np.arange(len(rows))
    data, size = rows.tobytes(), rows.itemsize
    return [data[start : start + size] for start in range(0, len(data), size)]


@cache
def _row(count: int) -> NDArray[np.void]:
    """The message of a module with so many outputs, (1,), in which only the values are missing."""
    head = varint(8 * count)
    tags = {"y": b"\x0a" + head, "slowness": b"\x12" + head}
    tags |= {"alive": b"\x18", "novelty": b"\x21", "frame": b"\x29"}
    kinds = (f"({count},)<f8", f"({count},)<f8", "u1", "<f8", "<i8")
    fields = []
    for (name, tag), kind in zip(tags.items(), kinds, strict=True):
        fields += [(f"{name}_tag", f"V{len(tag)}"), (name, kind)]
    row = np.zeros(1, np.dtype(fields))
    for name, tag in tags.items():
        row[f"{name}_tag"] = np.void(tag)
    return row


class LogSink:
    """An MCAP file with the frames of each stream and a topic per module and stream.

    The file is readable while it is written.
    """

    def __init__(
        self, path: Path, spec: SourceSpec, modules: Sequence[Module], *, force: bool = False
    ) -> None:
        self._spec, self._modules = spec, list(columns_of(modules))
        self._encoders: list[Any] = [VectorEncoder() for _ in spec.streams]
        if spec.images:
            height, width = spec.frame_shape
            self._encoders = [ImageEncoder(height, width, name) for name in spec.streams]
        self._log = LogFile(path, force=force, compression="lz4", aside=True)

        def channel(topic: str, schema: str, definition: bytes) -> int:
            return self._log.add_channel(topic, self._log.add_schema(schema, ENCODING, definition))

        self._views = [
            channel(view_topic(name), encoder.schema, encoder.schema_data())
            for name, encoder in zip(spec.streams, self._encoders, strict=True)
        ]
        self._outputs = [
            [
                channel(f"/module{module.index}/{name}", OUTPUT_SCHEMA, OUTPUT_DEFINITION)
                for module, _ in self._modules
            ]
            for name in spec.streams
        ]

    def add(self, applied: Applied) -> None:
        """See `AppliedSink`."""
        block = applied.block
        times = self._spec.times(block.t, block.t + len(block)).tolist()
        encode, view = self._encoders[block.stream], self._views[block.stream]
        found = [
            (view, at, encode(at, frame), at, 0)
            for at, frame in zip(times, block.frames, strict=True)
        ]
        for i, (_, own) in enumerate(self._modules):
            topic = self._outputs[block.stream][i]
            rows = _encoded(applied, i, own)
            found += [(topic, at, row, at, 0) for at, row in zip(times, rows, strict=True)]
        self._log.write_all(found)

    def close(self) -> None:
        """See `AppliedSink`."""
        self._log.finish()

    def abandon(self) -> None:
        """Leave a readable NAME.partial."""
        self._log.abandon()


def _as_json(applied: Applied, spec: SourceSpec, modules: Sequence[Module]) -> Mapping[str, Any]:
    """A block as JSON values; what is no finite number is null."""
    block = applied.block
    return {
        "log_time": spec.time_ns(block.t),
        "t": block.t,
        "frames": len(block),
        "stream": spec.streams[block.stream],
        "modules": [
            {
                "module": module.index,
                "y": applied.y[:, own].tolist(),
                "slowness": [_number(value) for value in applied.slowness[own].tolist()],
                "alive": bool(applied.alive[i]),
                "novelty": _number(float(applied.novelty[i])),
            }
            for i, (module, own) in enumerate(columns_of(modules))
        ],
    }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


class LinesSink:
    """JSON lines, one a block, each handed on at once.

    Args:
        write: takes a line, without its end.
        spec: of the frames.
        modules: in their order.
    """

    def __init__(self, write: Any, spec: SourceSpec, modules: Sequence[Module]) -> None:
        self._write, self._spec, self._modules = write, spec, modules

    def add(self, applied: Applied) -> None:
        """See `AppliedSink`."""
        self._write(json.dumps(_as_json(applied, self._spec, self._modules), allow_nan=False))

    def close(self) -> None:
        """See `AppliedSink`."""


@contextlib.contextmanager
def written(
    out: Path, spec: SourceSpec, modules: Sequence[Module], *, force: bool, log: str | None = None
) -> Iterator[AppliedSink]:
    """A file for what modules give, whole when the body has ended.

    Args:
        out: the file, .parquet, .csv or .mcap.
        spec: of the source.
        modules: in their order.
        force: replace an existing file.
        log: see `TableSink`.

    Raises:
        UsageError: it exists.
        LogWriteError: it cannot be written.
    """
    form = out.suffix.lower().removeprefix(".")
    refuse_special(out)
    refuse_taken(out, force=force)
    if form == "mcap":
        sink = LogSink(out, spec, modules, force=force)
        try:
            yield sink
        except BaseException:
            sink.abandon()
            raise
        sink.close()
        return
    with atomic_write(out) as partial:
        table = TableSink(partial, form, spec, modules, log)
        try:
            yield table
        except BaseException:
            with contextlib.suppress(Exception):  # the first error counts
                table.close()
            raise
        table.close()
