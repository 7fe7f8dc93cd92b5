"""A run's signals as a table other tools read; a recording as images, videos or a dataset.

Every table is made from the one table of signals: a row an iteration, a column a
signal. Parquet and Arrow carry each signal's symbol, equation, unit and dimensions as
the column's metadata, and the run's configuration as the table's; npz has both as JSON
in the arrays `_signals` and `_run`, CSV in a file beside it as the W3C's "CSV on the Web"
has it.
"""

from __future__ import annotations

import contextlib
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

from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.signals import SIGNALS, BlockSignals, Signal
from recorder.log.whole import partial_path
from replay.export.folder import whole_folder
from replay.export.images import check_images, write_images
from replay.export.lerobot import write_lerobot
from replay.export.videos import write_film, write_films
from replay.recordings.source import RecordedSource
from replay.runs.folders import is_run
from replay.runs.log import RunHeader, read_header, read_signals
from replay.runs.outline import read_outline

TABLES = ("parquet", "npz", "csv", "arrow")
"""What a run's signals can be written as."""

RECORDINGS = ("images", "mp4", "lerobot")
"""What a recording can be written as."""

FORMS = (*TABLES, *RECORDINGS)
"""What can be written."""

CSV_LEAVES_OUT = tuple(s.name for s in SIGNALS.values() if "T" in s.dims)
"""Signals of every frame, for which a row an iteration has no room."""

BATCH = 1000
"""Iterations that are held at once."""

_TYPES = {"float64": pa.float64(), "int64": pa.int64(), "bool": pa.bool_()}


def export(path: Path, out: Path, form: str, *, force: bool = False, lossless: bool = False) -> int:
    """Write a run's signals, or a recording's frames, in another form.

    Args:
        path: a run; for a form of `RECORDINGS` a recording.
        out: the file; for those forms the folder, or for one view's video a file *.mp4.
        form: one of `FORMS`. CSV leaves out the outputs frame by frame; NPZ fills
            arrays that grow with the modules up with NaN.
        force: replace an existing file, or an earlier export in a folder.
        lossless: keep every value of images that become a video.

    Returns:
        The number of iterations, or of images or frames, written.

    Raises:
        UsageError: no such run or form, or `out` exists and `force` is not set.
        LogDamagedError: the run cannot be read.
        CdmisfaError: the file cannot be written.
    """
    if form not in FORMS:
        raise UsageError(f"no form {form!r}: choose one of {', '.join(FORMS)} with --to")
    if lossless and form not in ("mp4", "lerobot"):
        raise UsageError(f"{form} loses nothing: --lossless is for mp4 and lerobot")
    if out.exists() and not force:
        raise UsageError(f"{out} exists: choose another name or overwrite with --force")
    if form in RECORDINGS:
        return _export_recording(path, out, form, lossless)
    if out.is_dir():
        raise UsageError(f"{out} is a folder: name the file to write")
    if form == "csv":
        return _export_csv(path, out, force)
    writer = {"parquet": _parquet, "arrow": _arrow, "npz": _npz}[form]
    with _whole_file(out) as partial:
        return writer(path, partial)


def _export_recording(path: Path, out: Path, form: str, lossless: bool) -> int:
    if is_run(path):
        raise UsageError(f"{path} is a run, {form} is for recordings: name the recording")
    with contextlib.closing(RecordedSource(path)) as source:
        if form == "lerobot":
            with whole_folder(out) as folder:
                return write_lerobot(source, folder, name=out.name, lossless=lossless)
        check_images(source, path)
        if form == "mp4" and out.suffix == ".mp4" and not out.is_dir():
            if len(source.spec.streams) > 1:
                raise UsageError(f"{path} has several views: name a folder, not {out.name}")
            with _whole_file(out) as partial:
                write_film(source, 0, partial, lossless=lossless)
            return source.frames
        with whole_folder(out) as folder:
            if form == "mp4":
                return write_films(source, folder, lossless=lossless)
            return write_images(source, folder)


@contextlib.contextmanager
def _whole_file(out: Path) -> Iterator[Path]:
    """A file to write, which becomes `out` once it is complete."""
    partial = partial_path(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        os.replace(partial, out)
    except (OSError, pa.ArrowException) as error:
        raise CdmisfaError(f"{out} cannot be written: {error}") from error
    finally:
        partial.unlink(missing_ok=True)


def arrow_schema(header: RunHeader) -> pa.Schema:
    """The table's columns, nested one list a dimension, with what each signal is."""
    fields = []
    for signal in SIGNALS.values():
        kind = _TYPES[signal.dtype]
        for _ in signal.dims:
            kind = pa.list_(kind)
        fields.append(pa.field(signal.name, kind, nullable=False, metadata=_about(signal)))
    whole = {f"cdmisfa.{name}": value for name, value in _run(header).items()}
    return pa.schema(fields, metadata=whole)


def _about(signal: Signal) -> dict[str, str]:
    """What a signal is, without how a viewer shows it."""
    return {name: str(value) for name, value in asdict(signal).items() if name != "show"}


def _run(header: RunHeader) -> dict[str, str]:
    """What run it is, as JSON."""
    return {
        "schema": str(header.schema),
        "spec": json.dumps(asdict(header.spec)),
        "manifest": json.dumps(header.manifest),
    }


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
    about = {name: _about(signal) for name, signal in SIGNALS.items()}
    arrays["_signals"] = np.array(json.dumps(about))
    arrays["_run"] = np.array(json.dumps(_run(outline.header)))
    with open(out, "wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    return count


def csv_notes(out: Path) -> Path:
    """The file that says what a CSV file's columns are."""
    return out.with_name(f"{out.name}-metadata.json")


def _export_csv(path: Path, out: Path, force: bool) -> int:
    notes = csv_notes(out)
    if notes.exists() and not force:
        raise UsageError(f"{notes} exists: choose another name or overwrite with --force")
    modules = read_outline(path).modules
    with _whole_file(notes) as about, _whole_file(out) as partial:
        with open(partial, "w", encoding="utf-8", newline="") as file:
            columns, rows = _csv_rows(path, file, modules)
        document = {
            "@context": "http://www.w3.org/ns/csvw",
            "url": out.name,
            "tableSchema": {"columns": [_csv_column(*column) for column in columns]},
            "notes": [
                {"signals": {signal.name: _about(signal) for _, signal in columns}},
                {"run": _run(read_header(path))},
            ],
        }
        about.write_text(json.dumps(document, indent=1), "utf-8")
    return rows


def _csv_column(title: str, signal: Signal) -> dict[str, str]:
    kind = {"float64": "double", "int64": "integer", "bool": "boolean"}[signal.dtype]
    return {
        "titles": title,
        "datatype": kind,
        "dc:description": signal.about,
        "schema:alternateName": signal.symbol,
        "schema:unitText": signal.unit,
    }


def _csv_rows(path: Path, file: TextIO, modules: int) -> tuple[list[tuple[str, Signal]], int]:
    """Write the table; its columns with their signals, and how many rows."""
    writer, rows = csv.writer(file), 0
    columns: list[tuple[str, Signal]] = []
    wanted = [s for s in SIGNALS.values() if s.name not in CSV_LEAVES_OUT]
    for record in read_signals(path):
        cells: list[Any] = []
        for signal in wanted:
            value = np.asarray(getattr(record, signal.name), dtype=signal.dtype)
            if signal.dims.startswith("M"):
                missing = [(0, modules - len(value))] + [(0, 0)] * (value.ndim - 1)
                value = np.pad(value, missing, constant_values=np.nan)
            if not rows:
                columns += [(signal.name + _place(i), signal) for i in np.ndindex(value.shape)]
            cells += value.reshape(-1).tolist()
        if not rows:
            writer.writerow(title for title, _ in columns)
        writer.writerow(cells)
        rows += 1
    return columns, rows


def _place(index: tuple[int, ...]) -> str:
    return f"[{','.join(map(str, index))}]" if index else ""
