"""MCAP logs as others would write them, of messages of any kind."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from mcap.writer import Writer

from recorder.images.messages import MessageKind

START = 10**18
"""The log time of what comes first, in nanoseconds."""

STEP = 20_000_000
"""Nanoseconds between two messages of 50 a second."""


def every(step: int, messages: Iterable[bytes]) -> Iterator[tuple[int, bytes]]:
    """Messages with their log times, so many nanoseconds apart."""
    return ((START + i * step, message) for i, message in enumerate(messages))


def write_mcap(
    path: Path,
    kind: MessageKind,
    topics: Mapping[str, Iterable[tuple[int, bytes]]],
    *,
    by_time: bool = False,
    profile: str = "",
    **options: Any,
) -> Path:
    """A log of messages of a kind: each topic with log times and messages.

    One topic stands behind the other, or all messages stand in the order of their times.
    """
    with path.open("wb") as file:
        writer = Writer(file, **{"chunk_size": 4096, **options})
        writer.start(profile)
        schema = writer.register_schema(kind.schema, kind.language, kind.definition)
        numbers = {name: writer.register_channel(name, kind.encoding, schema) for name in topics}
        each = ((time, numbers[name], data) for name in topics for time, data in topics[name])
        for time, channel, data in sorted(each) if by_time else each:
            writer.add_message(channel, time, data, time)
        writer.finish()
    return path


def write_table(path: Path, columns: dict[str, Any]) -> Path:
    """A CSV or Parquet file, by its name."""
    import pyarrow as pa
    from pyarrow import csv, parquet

    table = pa.table(columns)
    if path.suffix == ".csv":
        csv.write_csv(table, path)
    else:
        parquet.write_table(table, path)
    return path


def learned_alike(cdmisfa: Callable[..., Any], folder: Path, *words: object) -> Any:
    """What a run says of itself; one on the conversion, by the same words, is the same."""
    quick = ("--set", "learner.tau=10", "--max-iterations", "3", "--json")
    run = cdmisfa("learn", *words, *quick, "-o", folder / "run", "--no-rerun")
    assert run.code == 0, run.err
    assert cdmisfa("check", folder / "run").code == 0
    converted = cdmisfa("convert", *words, "-o", folder / "rec")
    assert converted.code == 0, converted.err
    again = cdmisfa("learn", folder / "rec", "--algorithm", "progress", *quick).json
    assert again["signals_sha256"] == run.json["signals_sha256"]
    return {**run.json, "said": (run.err, converted.err)}
