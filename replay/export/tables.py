"""A run's signals, or the numbers of a log, as a table for other programs.

Signals have a row an iteration and a column a signal, numbers of a log a row a message.

A missing value is null in Parquet, and NaN in npz and CSV. Parquet holds symbol, equation, unit
and dimensions of each signal in the metadata of its column, and the configuration of the run in
the metadata of the table; npz holds both as JSON in the arrays `_signals` and `_run`.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pyarrow.csv import CSVWriter

from cdmisfa.core.errors import UsageError
from cdmisfa.core.signals import SCHEMA_VERSION, SIGNALS, Signal
from recorder.images.fields import column_names
from recorder.log.messages import view_topic
from replay.export.applied import ROWS
from replay.logs.source import LoggedSource
from replay.runs.columns import padded, whole_signals
from replay.runs.log import RunHeader, read_columns, read_header

# Signals with a value for each frame: a row of an iteration would need thousands of cells.
CSV_LEAVES_OUT = tuple(s.name for s in SIGNALS.values() if "T" in s.dims)


def write_parquet(run: Path, out: Path) -> int:
    """Write all signals as Parquet, and return the number of iterations."""
    header, rows = read_header(run), 0
    schema = _schema(header, tuple(SIGNALS))
    with pq.ParquetWriter(out, schema, compression="zstd") as writer:
        for batch in _batches(run, header, schema):
            writer.write_batch(batch)
            rows += len(batch)
    return rows


def write_npz(run: Path, out: Path) -> int:
    """Write all signals as NumPy arrays, and return the number of iterations.

    Arrays that grow with the number of modules begin with NaN.
    """
    header = read_header(run)
    arrays = whole_signals(read_columns(run, header), tuple(SIGNALS))
    signals = {name: _facts(signal) for name, signal in SIGNALS.items()}
    notes = {
        "_signals": np.array(json.dumps(signals)),
        "_run": np.array(json.dumps(_run_facts(header))),
    }
    with open(out, "wb") as file:
        np.savez_compressed(file, **arrays, **notes)  # type: ignore[arg-type]
    return len(arrays["iteration"])


def write_csv(run: Path, out: Path) -> int:
    """Write all signals but `CSV_LEAVES_OUT` as CSV, and return the number of iterations."""
    header = read_header(run)
    signals = [s for s in SIGNALS.values() if s.name not in CSV_LEAVES_OUT]
    modules = max((piece["band_sd"].shape[1] for piece in read_columns(run, header)), default=0)
    rows = 0
    with open(out, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        for piece in read_columns(run, header):
            cells = [padded(signal, piece[signal.name], modules) for signal in signals]
            if not rows:
                writer.writerow(
                    signal.name + (f"[{','.join(map(str, place))}]" if place else "")
                    for signal, values in zip(signals, cells, strict=True)
                    for place in np.ndindex(values.shape[1:])
                )
            lists = (values.reshape(len(piece), -1).tolist() for values in cells)
            writer.writerows(map(chain.from_iterable, zip(*lists, strict=True)))
            rows += len(piece)
    return rows


# Function that writes each form of a run's signals.
#
# Args: the run and the new file. Raises: UsageError without such a run, LogDamagedError if it
# cannot be read.
TABLES: dict[str, Callable[[Path, Path], int]] = {
    "csv": write_csv,
    "parquet": write_parquet,
    "npz": write_npz,
}


# Forms in which the numbers of a log are written.
NUMBERS: Final = ("parquet", "csv")


def write_streams(source: LoggedSource, place: Path, form: str, *, single: bool) -> int:
    """Write each stream of numbers as a table, and return the number of rows.

    A row is a message, with its log time and a column for each number; of a recording, a frame.

    Raises:
        UsageError: a stream has images, messages of different length, or two columns of one name.
        LogDamagedError: a message cannot be read.
    """
    count = 0
    if not single:
        place.mkdir()
    for i, (name, log) in enumerate(zip(source.spec.streams, source.streams, strict=True)):
        messages = source.messages(i, ROWS)
        _, first = piece = next(messages)
        names = log.columns() or column_names(name, first[0].size)
        unequal = len(names) != first.shape[1] or len({"log_time", *names}) <= len(names)
        if first.ndim > 2 or unequal:
            what = "images" if first.ndim > 2 else f"columns {', '.join(names)}"
            how = (topics_of(source, images=False) if first.ndim > 2 else "") or "--field"
            raise UsageError(f"{log.path}: {name} has {what}: choose numbers with {how}")
        kinds = {"log_time": pa.int64(), **dict.fromkeys(names, pa.float64())}
        out, schema = place if single else place / f"{name}.{form}", pa.schema(kinds)
        writer = pq.ParquetWriter if form == "parquet" else CSVWriter
        with writer(out, schema) as file:
            for times, numbers in chain([piece], messages):
                columns = list(map(pa.array, (times, *numbers.T)))
                file.write_batch(pa.RecordBatch.from_arrays(columns, schema=schema))
                count += len(times)
    return count


def topics_of(source: LoggedSource, *, images: bool) -> str:
    """Return the options that choose the streams of images, or of numbers; "" if there are none."""
    named = view_topic if source.recorded else str
    logs = enumerate(source.streams)
    chosen = [named(s.topic) for i, s in logs if (len(source.spec.kind(i)[0]) > 1) == images]
    return " ".join(f"--topic {topic}" for topic in chosen)


def signals_table(run: Path, names: Sequence[str]) -> pa.Table:
    """Return some signals of a run as an Arrow table, a row an iteration.

    Raises:
        UsageError: the run does not exist.
        LogDamagedError: the run cannot be read.
    """
    header = read_header(run)
    schema = _schema(header, names)
    return pa.Table.from_batches(_batches(run, header, schema), schema)


def _schema(header: RunHeader, names: Sequence[str]) -> pa.Schema:
    """Return the columns, nested one list a dimension, with their metadata."""
    fields = []
    for signal in map(SIGNALS.__getitem__, names):
        kind = pa.from_numpy_dtype(signal.dtype)
        for _ in signal.dims:
            kind = pa.list_(kind)
        nullable = signal.dtype == "float64" and not signal.dims
        fields.append(pa.field(signal.name, kind, nullable=nullable, metadata=_facts(signal)))
    metadata = {f"cdmisfa.{name}": value for name, value in _run_facts(header).items()}
    return pa.schema(fields, metadata=metadata)


def _facts(signal: Signal) -> dict[str, str]:
    return {name: str(value) for name, value in asdict(signal).items() if name != "show"}


def _run_facts(header: RunHeader) -> dict[str, str]:
    return {
        "schema": str(SCHEMA_VERSION),
        "spec": json.dumps(header.spec.as_json()),
        "manifest": json.dumps(header.manifest),
    }


def _batches(run: Path, header: RunHeader, schema: pa.Schema) -> Iterator[pa.RecordBatch]:
    for piece in read_columns(run, header):
        arrays = [_nested(piece[name]) for name in schema.names]
        yield pa.RecordBatch.from_arrays(arrays, schema=schema)


def _nested(values: NDArray[Any]) -> pa.Array:
    """Return (n, ...) values as n rows of nested lists, NaN as null."""
    array: pa.Array = pa.array(values.reshape(-1), from_pandas=True)
    for dim in range(values.ndim - 1, 0, -1):
        lists = math.prod(values.shape[:dim])
        offsets = np.arange(lists + 1, dtype=np.int32) * values.shape[dim]
        array = pa.ListArray.from_arrays(pa.array(offsets, pa.int32()), array)
    return array
