"""A run's signals as a table that other tools read: a row an iteration, a column a signal.

Every table is made from the one table of signals. What is missing is null in Parquet,
and NaN in npz and CSV. Parquet carries each signal's symbol, equation, unit and dimensions as the
column's metadata, and the run's configuration as the table's; npz has both as JSON in the arrays
`_signals` and `_run`.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cdmisfa.core.signals import SCHEMA_VERSION, SIGNALS, Signal
from recorder.log.files import atomic_write
from replay.runs.columns import padded, whole_signals
from replay.runs.log import RunHeader, read_columns, read_header

TABLES = ("csv", "parquet", "npz")
"""What a run's signals can be written as."""

CSV_LEAVES_OUT = tuple(s.name for s in SIGNALS.values() if "T" in s.dims)
"""Signals of every frame, for which a row an iteration has no room."""

_ARROW = {"float64": pa.float64(), "int64": pa.int64(), "bool": pa.bool_()}


def export_signals(run: Path, out: Path, form: str) -> int:
    """Write a run's signals to a file, and return how many iterations there are.

    CSV leaves out the outputs frame by frame; npz fills arrays that grow with the modules up
    with NaN.

    Args:
        run: the folder of the run.
        out: the file; replaced.
        form: one of `TABLES`.

    Raises:
        UsageError: no such run.
        LogDamagedError: the run cannot be read.
        LogWriteError: the file cannot be written.
    """
    header = read_header(run)
    write = {"csv": _write_csv, "npz": _write_npz, "parquet": _write_parquet}[form]
    with atomic_write(out) as partial:
        return write(run, header, partial)


def signals_table(run: Path, names: Sequence[str] = tuple(SIGNALS)) -> pa.Table:
    """Some signals of a run as an Arrow table, a row an iteration; what is missing is null.

    Raises:
        UsageError: no such run.
        LogDamagedError: the run cannot be read.
    """
    header = read_header(run)
    schema = _arrow_schema(header, names)
    return pa.Table.from_batches(_batches(run, header, schema), schema)


def _arrow_schema(header: RunHeader, names: Sequence[str] = tuple(SIGNALS)) -> pa.Schema:
    """The table's columns, nested one list a dimension, with what each signal is."""
    fields = []
    for signal in map(SIGNALS.__getitem__, names):
        kind = _ARROW[signal.dtype]
        for _ in signal.dims:
            kind = pa.list_(kind)
        missing = signal.dtype == "float64" and not signal.dims
        fields.append(pa.field(signal.name, kind, nullable=missing, metadata=_about(signal)))
    about = {f"cdmisfa.{name}": value for name, value in _run(header).items()}
    return pa.schema(fields, metadata=about)


def _about(signal: Signal) -> dict[str, str]:
    return {name: str(value) for name, value in asdict(signal).items() if name != "show"}


def _run(header: RunHeader) -> dict[str, str]:
    return {
        "schema": str(SCHEMA_VERSION),
        "spec": json.dumps(asdict(header.spec)),
        "manifest": json.dumps(header.manifest),
    }


def _nested(values: NDArray[Any]) -> pa.Array:
    """(n, ...) values as n rows of nested lists, NaN as null."""
    array: pa.Array = pa.array(values.reshape(-1), from_pandas=True)
    for dim in range(values.ndim - 1, 0, -1):
        lists = math.prod(values.shape[:dim])
        offsets = np.arange(lists + 1, dtype=np.int32) * values.shape[dim]
        array = pa.ListArray.from_arrays(pa.array(offsets, pa.int32()), array)
    return array


def _batches(run: Path, header: RunHeader, schema: pa.Schema) -> Iterator[pa.RecordBatch]:
    for piece in read_columns(run, header):
        arrays = [_nested(piece[name]) for name in schema.names]
        yield pa.RecordBatch.from_arrays(arrays, schema=schema)


def _write_parquet(run: Path, header: RunHeader, out: Path) -> int:
    rows, schema = 0, _arrow_schema(header)
    with pq.ParquetWriter(out, schema, compression="zstd") as writer:
        for batch in _batches(run, header, schema):
            writer.write_batch(batch)
            rows += len(batch)
    return rows


def _write_npz(run: Path, header: RunHeader, out: Path) -> int:
    arrays = whole_signals(read_columns(run, header), tuple(SIGNALS))
    about = {name: _about(signal) for name, signal in SIGNALS.items()}
    notes = {"_signals": np.array(json.dumps(about)), "_run": np.array(json.dumps(_run(header)))}
    with open(out, "wb") as file:
        np.savez_compressed(file, **arrays, **notes)  # type: ignore[arg-type]
    return len(arrays["iteration"])


def _write_csv(run: Path, header: RunHeader, out: Path) -> int:
    signals = [s for s in SIGNALS.values() if s.name not in CSV_LEAVES_OUT]
    modules = max((piece["band_sd"].shape[1] for piece in read_columns(run, header)), default=0)
    rows = 0
    with open(out, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        for piece in read_columns(run, header):
            cells = [padded(signal, piece[signal.name], modules) for signal in signals]
            if not rows:
                writer.writerow(
                    signal.name + _place(place)
                    for signal, values in zip(signals, cells, strict=True)
                    for place in np.ndindex(values.shape[1:])
                )
            lists = (values.reshape(len(piece), -1).tolist() for values in cells)
            writer.writerows(map(chain.from_iterable, zip(*lists, strict=True)))
            rows += len(piece)
    return rows


def _place(index: tuple[int, ...]) -> str:
    return f"[{','.join(map(str, index))}]" if index else ""
