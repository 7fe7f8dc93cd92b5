"""A run's signals as a table other tools read: Parquet, Arrow, NumPy, CSV.

Every form is made from the one table of signals: a row an iteration, a column a
signal. Parquet and Arrow carry each signal's symbol, equation, unit and dimensions as
the column's metadata, and the run's configuration as the table's.
"""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from PIL import Image

from cdmisfa.errors import CdmisfaError, UsageError
from cdmisfa.signals import SIGNALS, BlockSignals, Signal
from recorder.logfile import partial_path
from replay.outline import read_outline
from replay.recorded import RecordedSource
from replay.runlog import RunHeader, read_header, read_signals

FORMS = ("parquet", "npz", "csv", "arrow", "images")
"""What can be written."""

CSV_LEAVES_OUT = tuple(s.name for s in SIGNALS.values() if "T" in s.dims)
"""Signals of every frame, for which a row an iteration has no room."""

BATCH = 1000
"""Iterations, or frames, that are held at once."""

_TYPES = {"float64": pa.float64(), "int64": pa.int64(), "bool": pa.bool_()}


def export(path: Path, out: Path, form: str, *, force: bool = False) -> int:
    """Write a run's signals, or a recording's frames, in another form.

    Args:
        path: a run; for the form "images" a recording.
        out: the file, for images the folder.
        form: one of `FORMS`. CSV leaves out the outputs frame by frame; NPZ fills
            arrays that grow with the modules up with NaN.
        force: replace an existing file.

    Returns:
        The number of iterations, or of images, written.

    Raises:
        UsageError: no such run or form, or `out` exists and `force` is not set.
        LogDamagedError: the run cannot be read.
        CdmisfaError: the file cannot be written.
    """
    if form not in FORMS:
        raise UsageError(f"no form {form!r}: choose one of {', '.join(FORMS)} with --to")
    if out.exists() and not force:
        raise UsageError(f"{out} exists: choose another name or overwrite with --force")
    if form == "images":
        return _write_images(path, out)
    writer = {"parquet": _parquet, "arrow": _arrow, "npz": _npz, "csv": _csv}[form]
    partial = partial_path(out)
    try:
        rows = writer(path, partial)
        os.replace(partial, out)
    except (OSError, pa.ArrowException) as error:
        raise CdmisfaError(f"{out} cannot be written: {error}") from error
    finally:
        partial.unlink(missing_ok=True)
    return rows


def arrow_schema(header: RunHeader) -> pa.Schema:
    """The table's columns, nested one list a dimension, with what each signal is."""
    fields = []
    for signal in SIGNALS.values():
        kind = _TYPES[signal.dtype]
        for _ in signal.dims:
            kind = pa.list_(kind)
        about = {name: str(value) for name, value in asdict(signal).items() if name != "show"}
        fields.append(pa.field(signal.name, kind, nullable=False, metadata=about))
    whole = {
        "cdmisfa.schema": str(header.schema),
        "cdmisfa.spec": json.dumps(asdict(header.spec)),
        "cdmisfa.manifest": json.dumps(header.manifest),
    }
    return pa.schema(fields, metadata=whole)


def record_batch(records: Sequence[BlockSignals], schema: pa.Schema) -> pa.RecordBatch:
    """Records as rows of the table."""
    columns = []
    for signal in SIGNALS.values():
        values = [np.asarray(getattr(r, signal.name), dtype=signal.dtype) for r in records]
        columns.append(_nested(values, signal))
    return pa.RecordBatch.from_arrays(columns, schema=schema)


def _nested(values: Sequence[NDArray[Any]], signal: Signal) -> pa.Array:
    """(…) arrays of one number of dimensions as rows of nested lists."""
    array: pa.Array = pa.array(np.concatenate([v.reshape(-1) for v in values]))
    for dimension in reversed(range(len(signal.dims))):
        # Each list of this dimension is as long as its row's shape says.
        counts = [int(np.prod(v.shape[:dimension])) for v in values]
        lengths = np.repeat([v.shape[dimension] for v in values], counts)
        offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
        array = pa.ListArray.from_arrays(pa.array(offsets), array)
    return array


def _batches(path: Path, schema: pa.Schema) -> Iterator[pa.RecordBatch]:
    records = read_signals(path)
    while batch := list(islice(records, BATCH)):
        yield record_batch(batch, schema)


def _parquet(path: Path, out: Path) -> int:
    schema, rows = arrow_schema(read_header(path)), 0
    with pq.ParquetWriter(out, schema, compression="zstd") as writer:
        for batch in _batches(path, schema):
            writer.write_batch(batch)
            rows += batch.num_rows
    return rows


def _arrow(path: Path, out: Path) -> int:
    schema, rows = arrow_schema(read_header(path)), 0
    with pa.OSFile(str(out), "wb") as file, pa.ipc.new_file(file, schema) as writer:
        for batch in _batches(path, schema):
            writer.write_batch(batch)
            rows += batch.num_rows
    return rows


def _npz(path: Path, out: Path) -> int:
    outline = read_outline(path)
    count, arrays = outline.iterations, dict[str, NDArray[Any]]()
    for k, record in enumerate(read_signals(path)):
        for signal in SIGNALS.values():
            value = np.asarray(getattr(record, signal.name), dtype=signal.dtype)
            if signal.name not in arrays:
                shape = value.shape
                if signal.dims.startswith("M"):
                    shape = (outline.modules, *shape[1:])
                fill = np.nan if signal.dtype == "float64" else 0
                arrays[signal.name] = np.full((count, *shape), fill, dtype=signal.dtype)
            inner = tuple(slice(size) for size in value.shape)
            arrays[signal.name][k, ...][inner] = value
    with open(out, "wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    return count


def _csv(path: Path, out: Path) -> int:
    modules = read_outline(path).modules
    with open(out, "w", encoding="utf-8", newline="") as file:
        return _csv_rows(path, file, modules)


def _csv_rows(path: Path, file: TextIO, modules: int) -> int:
    writer, rows = csv.writer(file), 0
    wanted = [s for s in SIGNALS.values() if s.name not in CSV_LEAVES_OUT]
    for record in read_signals(path):
        names: list[str] = []
        cells: list[Any] = []
        for signal in wanted:
            value = np.asarray(getattr(record, signal.name), dtype=signal.dtype)
            if signal.dims.startswith("M"):
                missing = [(0, modules - len(value))] + [(0, 0)] * (value.ndim - 1)
                value = np.pad(value, missing, constant_values=np.nan)
            names += [signal.name + _place(i) for i in np.ndindex(value.shape)]
            cells += value.reshape(-1).tolist()
        if not rows:
            writer.writerow(names)
        writer.writerow(cells)
        rows += 1
    return rows


def _place(index: tuple[int, ...]) -> str:
    return f"[{','.join(map(str, index))}]" if index else ""


def _write_images(path: Path, out: Path) -> int:
    """Every frame of every view as VIEW/FRAME.png."""
    source = RecordedSource(path)
    try:
        spec, first, count = source.spec, source.t, source.frames
        if spec.dtype != "uint8" or len(spec.frame_shape) != 2:
            raise UsageError(f"{path} holds no images: its frames are values")
        for stream, name in enumerate(spec.streams):
            folder = out / name
            folder.mkdir(parents=True, exist_ok=True)
            for t in range(first, first + count, BATCH):
                source.seek(t)
                block = source.take(stream, min(BATCH, first + count - t))
                for i, frame in enumerate(block.frames):
                    Image.fromarray(frame).save(folder / f"{t + i:08d}.png")
    except OSError as error:
        raise CdmisfaError(f"{out} cannot be written: {error}") from error
    finally:
        source.close()
    return count * len(spec.streams)
