"""Outputs of frozen modules on the frames of a log: as a table, an MCAP file or JSON lines."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from google.protobuf import descriptor_pb2
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.clock import times_of
from cdmisfa.modules import Module, columns_of
from recorder.log.files import atomic_write, refuse_taken
from recorder.log.logfile import LogFile
from recorder.log.messages import ENCODING, ImageEncoder, VectorEncoder, varint, view_topic
from replay.runs.codec import Layout, define_message

# Rows that a table writes at once: a Parquet file with fewer rows a group is much larger.
ROWS: Final = 8192

_FIELD = descriptor_pb2.FieldDescriptorProto
OUTPUT_SCHEMA: Final = "cdmisfa.ModuleOutput"
_, OUTPUT_DEFINITION = define_message(
    OUTPUT_SCHEMA,
    "module_output",
    [
        ("y", 1, _FIELD.TYPE_DOUBLE, True, "Outputs on the frame, the slowest first"),
        ("block_slowness", 2, _FIELD.TYPE_DOUBLE, True, "Of each within the block, 1/frame"),
        ("alive", 3, _FIELD.TYPE_BOOL, False, "Whether the first varies as where it was learned"),
        (
            "novelty",
            4,
            _FIELD.TYPE_DOUBLE,
            False,
            "Up to and with the block; above 1 it is not explained",
        ),
        ("frame", 5, _FIELD.TYPE_SFIXED64, False, "Number of the frame"),
    ],
)


@dataclass(frozen=True, slots=True)
class Applied:
    """Outputs of M modules, R in all, on a block of consecutive frames of one stream.

    Attributes:
        block: the frames, no more than a block of the run that learned the modules.
        y: (n, R) outputs of all modules, side by side.
        block_slowness: (R,) of each output within the block, 1/frame; infinite if it is constant.
        alive: (M,) whether the module's first output varies as where it was learned.
        novelty: (M,) difference from the stream that the module learned; the module explains the
            block up to 1. NaN for a block of one frame.
    """

    block: Block
    y: FloatArray
    block_slowness: FloatArray
    alive: NDArray[np.bool_]
    novelty: FloatArray


# Takes the outputs block by block.
AppliedSink = Callable[[Applied], None]


@contextlib.contextmanager
def written(
    out: Path, spec: SourceSpec, modules: Sequence[Module], log: str | None = None
) -> Iterator[AppliedSink]:
    """Open a file for outputs; it replaces another once the body has ended without an error.

    Args:
        out: the file, .parquet, .csv or .mcap.
        spec: the spec of the source.
        modules: the modules in their order.
        log: value of a first column `log`, for a table that is one of many logs' tables.

    Raises:
        UsageError: the output is a folder or a special file.
        LogWriteError: the file cannot be written.
    """
    refuse_taken(out, force=True)
    if out.suffix.lower() == ".mcap":
        with _log_sink(out, spec, modules) as sink:
            yield sink
    else:
        with atomic_write(out) as partial, _table_sink(partial, out, spec, modules, log) as sink:
            yield sink


@contextlib.contextmanager
def _table_sink(
    path: Path, out: Path, spec: SourceSpec, modules: Sequence[Module], log: str | None
) -> Iterator[AppliedSink]:
    """Write a table with a row a frame of a stream, Parquet or CSV by the ending of `out`."""
    import pyarrow.csv as pacsv
    import pyarrow.parquet as pq

    waiting: list[Applied] = []
    schema = _batch(waiting, spec, modules, log).schema
    if out.suffix.lower() == ".parquet":
        # Dictionaries save space in columns with one value a block, which repeats.
        of_frames = {"log_time", "t", *(name for name in schema.names if "_y" in name)}
        of_blocks = [name for name in schema.names if name not in of_frames]
        writer = pq.ParquetWriter(path, schema, compression="zstd", use_dictionary=of_blocks)
    else:
        writer = pacsv.CSVWriter(path, schema)

    def write() -> None:
        writer.write_batch(_batch(waiting, spec, modules, log))
        waiting.clear()

    def add(applied: Applied) -> None:
        waiting.append(applied)
        if sum(len(each.block) for each in waiting) >= ROWS:
            write()

    with contextlib.closing(writer):
        yield add
        if waiting:
            write()


def _batch(
    waiting: Sequence[Applied], spec: SourceSpec, modules: Sequence[Module], log: str | None
) -> Any:
    """Return outputs as rows of a table; a slowness that is not finite is null."""
    import pyarrow as pa

    count = sum(len(module.phi) for module in modules)
    blocks = [applied.block for applied in waiting]
    lengths = [len(block) for block in blocks]
    numbers = (np.arange(block.t, block.t + len(block)) for block in blocks)
    t = np.concatenate([np.empty(0, np.int64), *numbers])
    y = np.concatenate([np.empty((0, count)), *(applied.y for applied in waiting)])

    def repeated(name: str, width: int, dtype: type) -> NDArray[Any]:
        values: Any = np.array([getattr(applied, name) for applied in waiting], dtype)
        return np.repeat(values.reshape(len(waiting), width), lengths, axis=0)

    slowness = repeated("block_slowness", count, float)
    slowness[np.isinf(slowness)] = np.nan
    alive = repeated("alive", len(modules), bool)
    novelty = repeated("novelty", len(modules), float)
    streams = np.repeat(np.array([block.stream for block in blocks], int), lengths)
    table: dict[str, Any] = {} if log is None else {"log": pa.repeat(log, len(t))}
    table["log_time"] = pa.array(times_of(t, spec.fps, spec.start_ns))
    table["t"] = pa.array(t)
    table["stream"] = pa.array(np.array(spec.streams, object)[streams], pa.string())
    for i, (module, outputs) in enumerate(columns_of(modules)):
        name = f"module{module.index}"
        for kind, values in (("y", y), ("block_slowness", slowness)):
            for j, column in enumerate(values[:, outputs].T):
                table[f"{name}_{kind}{j}"] = pa.array(column, from_pandas=kind != "y")
        table[f"{name}_alive"] = pa.array(alive[:, i])
        table[f"{name}_novelty"] = pa.array(novelty[:, i], from_pandas=True)
    return pa.RecordBatch.from_pydict(table)


@contextlib.contextmanager
def _log_sink(out: Path, spec: SourceSpec, modules: Sequence[Module]) -> Iterator[AppliedSink]:
    """Write an MCAP file with the frames of each stream, and a topic per module and stream.

    The file is readable while it is written; an error leaves a readable NAME.partial.
    """
    shapes = [spec.kind(stream)[0] for stream in range(len(spec.streams))]
    encoders: list[Any] = [
        ImageEncoder(shape[0], shape[1], name) if len(shape) > 1 else VectorEncoder()
        for shape, name in zip(shapes, spec.streams, strict=True)
    ]
    log = LogFile(out, force=True, compression="lz4")

    def channel(topic: str, schema: str, definition: bytes) -> int:
        return log.add_channel(topic, log.add_schema(schema, ENCODING, definition))

    views = [
        channel(view_topic(name), encoder.schema, encoder.schema_data())
        for name, encoder in zip(spec.streams, encoders, strict=True)
    ]
    topics = [
        [channel(f"/module{m.index}/{name}", OUTPUT_SCHEMA, OUTPUT_DEFINITION) for m in modules]
        for name in spec.streams
    ]

    def add(applied: Applied) -> None:
        block, s = applied.block, applied.block.stream
        times = spec.times(block.t, block.t + len(block)).tolist()
        messages = [
            (views[s], at, encoders[s](at, frame), at, 0)
            for at, frame in zip(times, block.frames, strict=True)
        ]
        for i, (_, outputs) in enumerate(columns_of(modules)):
            values = {
                "y": applied.y[:, outputs],
                "block_slowness": applied.block_slowness[outputs],
                "alive": applied.alive[i],
                "novelty": applied.novelty[i],
                "frame": block.t + np.arange(len(block)),
            }
            encoded = _layout(outputs.stop - outputs.start).write(len(block), values)
            rows = zip(times, encoded, strict=True)
            messages += [(topics[s][i], at, row, at, 0) for at, row in rows]
        log.write_all(messages)

    try:
        yield add
    except BaseException:
        log.abandon()
        raise
    log.finish()


@cache
def _layout(outputs: int) -> Layout:
    """Return the layout of all messages of a module; protobuf takes ten times as long for each."""
    float64, length = np.dtype("<f8"), varint(8 * outputs)
    return Layout(
        [
            ("y", float64, (outputs,), b"\x0a" + length),
            ("block_slowness", float64, (outputs,), b"\x12" + length),
            ("alive", np.dtype("u1"), (), b"\x18"),
            ("novelty", float64, (), b"\x21"),
            ("frame", np.dtype("<i8"), (), b"\x29"),
        ]
    )


def json_line(applied: Applied, spec: SourceSpec, modules: Sequence[Module]) -> str:
    """Return the outputs on a block as a line of JSON; a number that is not finite is null."""
    block = applied.block

    def numbers(values: Any) -> list[float | None]:
        return [value if math.isfinite(value) else None for value in values]

    document = {
        "log_time": spec.time_ns(block.t),
        "t": block.t,
        "frames": len(block),
        "stream": spec.streams[block.stream],
        "modules": [
            {
                "module": module.index,
                "y": applied.y[:, outputs].tolist(),
                "block_slowness": numbers(applied.block_slowness[outputs].tolist()),
                "alive": bool(applied.alive[i]),
                "novelty": numbers([float(applied.novelty[i])])[0],
            }
            for i, (module, outputs) in enumerate(columns_of(modules))
        ],
    }
    return json.dumps(document, allow_nan=False)
