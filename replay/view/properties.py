"""Properties of a run, its configuration and result: the columns of the viewer's tables of runs.

Rows are written without Rerun's package, which takes half a second to import.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from cdmisfa.core.errors import CdmisfaError
from replay.runs.folders import read_run_json, run_log
from replay.view.bindings import Chunk, ChunkStore, ComponentDescriptor
from replay.view.labels import label

if TYPE_CHECKING:
    from replay.runs.run import Outline

APPLICATION = "cdmisfa"
"""Rerun's application id: one layout is remembered for it."""

RESULT, DIFFERS = "result", "differs"
"""Sections of what runs came to, and of what they differ in: the table's first columns."""

Sections = dict[str, dict[str, Any]]
"""Values by section of the configuration; those of `RESULT` are what the run came to."""


def recording_id(name: str, source: Path) -> str:
    """The name of a recording, which no other one has: Rerun merges those of the same name.

    Args:
        name: what the viewer calls it.
        source: the log that it is made from.
    """
    place = hashlib.sha256(str(source.resolve()).encode()).hexdigest()[:12]
    return f"{name}-{place}"


def run_identity(run: Path) -> str:
    """The name of the recording that shows a run.

    Raises:
        UsageError: there is no such run.
    """
    log = run_log(run)
    return recording_id(log.resolve().parent.name, log)


def properties_of(outline: Outline, folder: Path) -> Sections:
    """Configuration and result of a run that was read through.

    Args:
        outline: the run in short.
        folder: of the run, whose run.json says why it ended.
    """
    began, learned = outline.header.manifest, [outline.names()[s.stream] for s in outline.saved]
    counts = began.get("seed", 0), outline.iterations, outline.frames
    return {**_configuration(began), "result": _result(counts, learned, read_run_json(folder))}


def read_properties(run: Path) -> Sections:
    """The same as `properties_of`, from the run.json of a finished run alone.

    The log of a run that has none, or no result in it, is read through.

    Raises:
        UsageError: there is no such run.
        LogDamagedError: it cannot be read.
    """
    document = read_run_json(run)
    try:
        found = document["result"]
        learned = [str(module["stream"]) for module in found["modules"]]
        counts = int(document["seed"]), int(found["iterations"]), int(found["frames"])
    except (KeyError, TypeError, ValueError):
        from replay.runs.run import read_outline  # only where there is no result

        return properties_of(read_outline(run), run)
    return {**_configuration(document), "result": _result(counts, learned, document)}


def write_rows(runs: Sequence[Path], folder: Path) -> list[Path]:
    """Write recordings that hold the properties of runs only, as the rows of a table.

    A column has one type: text where the runs' values are of several, as "auto" and 0.5 are.

    Args:
        runs: folders of runs.
        folder: of the files.

    Raises:
        UsageError: there is no such run.
        LogDamagedError: it cannot be read.
        CdmisfaError: a row cannot be written.
    """
    rows = [read_properties(run) for run in runs]
    for row, differs in zip(
        rows, differing([run.resolve().name for run in runs], rows), strict=True
    ):
        row[DIFFERS] = differs
    types: dict[tuple[str, str], set[type]] = {}
    for row in rows:
        for section, values in row.items():
            for name, value in values.items():
                types.setdefault((section, name), set()).add(type(value))
    files = []
    for i, (run, row) in enumerate(zip(runs, rows, strict=True)):
        out = folder / f"{i:05d}.rrd"
        alike = {
            section: {name: _joint(types[section, name])(v) for name, v in values.items()}
            for section, values in row.items()
        }
        try:
            stream = ChunkStore.from_chunks(property_chunks(alike)).stream()
            stream.write_rrd(str(out), APPLICATION, run_identity(run))
        except (RuntimeError, OSError, OverflowError, ValueError) as error:
            raise CdmisfaError(f"{out} cannot be written: {error}") from error
        files.append(out)
    return files


def differing(names: Sequence[str], rows: Sequence[Sections]) -> list[dict[str, Any]]:
    """Of each run what it was told otherwise than others, and which one it is identical to.

    Args:
        names: of the runs.
        rows: their properties.

    Returns:
        Values by key, and `identical_to`: the first run with the same signals, bit for bit.
    """
    told = [
        {f"{section}_{key}": v for section, table in row.items() for key, v in table.items()}
        for row in rows
    ]
    outcome = {f"{RESULT}_{key}" for key in rows[0][RESULT] if key != "seed"} if rows else set()
    keys = dict.fromkeys(key for run in told for key in run if key not in outcome)
    others = [key for key in keys if len({repr(run.get(key)) for run in told}) > 1]
    firsts: dict[Any, str] = {}
    found = []
    for name, row, run in zip(names, rows, told, strict=True):
        first = firsts.setdefault(row[RESULT].get("signals_sha256", name), name)
        same = {"identical_to": "" if first == name else label(first)}
        mine = {key.removeprefix(f"{RESULT}_"): run[key] for key in others if key in run}
        found.append(same | mine)
    return found


def property_chunks(sections: Sections) -> list[Chunk]:
    """The properties of one run as Rerun's chunks."""
    return [
        Chunk.from_property(
            section, {ComponentDescriptor(name): pa.array([v]) for name, v in values.items()}
        )
        for section, values in sections.items()
    ]


def _joint(types: set[type]) -> type:
    """The type that holds values of all these."""
    if len(types) == 1:
        return next(iter(types))
    return float if types == {int, float} else str


def _configuration(manifest: Mapping[str, Any]) -> Sections:
    config = manifest.get("config")
    tables = config.items() if isinstance(config, Mapping) else ()
    sections = {str(name): _flat(table) for name, table in tables if isinstance(table, Mapping)}
    return {name: values for name, values in sections.items() if values}


def _result(
    counts: tuple[Any, int, int], learned: Sequence[str], document: Mapping[str, Any]
) -> dict[str, Any]:
    """Result of a run, and why it ended, where its run.json says it."""
    found = dict(zip(("seed", "iterations", "frames"), counts, strict=True))
    found |= {"modules": len(learned), "learned": label(", ".join(learned))}
    with contextlib.suppress(KeyError, TypeError):
        ending = document["result"]
        found |= {name: str(ending[name]) for name in ("ended", "signals_sha256")}
    return found


def _flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key, value in table.items():
        name = f"{prefix}{key}".replace(".", "_")
        if isinstance(value, Mapping):
            values |= _flat(value, f"{name}_")
        elif isinstance(value, bool | int | float):
            values[name] = value
        else:
            values[name] = label(value if isinstance(value, str) else json.dumps(value))
    return values
