"""What a run was and came to: the columns that the viewer's tables of runs show."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import rerun as rr
from rerun.chunk import Chunk, ChunkStore

from cdmisfa.errors import CdmisfaError
from replay.labels import label
from replay.outline import Outline, read_outline
from replay.runlog import run_log

APPLICATION = "cdmisfa"
"""Rerun's application id: one layout is remembered for it."""

Sections = dict[str, dict[str, Any]]
"""Values by section of the configuration; those of `result` are what the run came to."""


def identity(name: str, source: Path) -> str:
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
    return identity(log.resolve().parent.name, log)


def properties_of(outline: Outline, folder: Path) -> Sections:
    """Configuration and result of a run that was read through.

    Args:
        outline: the run in short.
        folder: of the run, whose manifest says why it ended.
    """
    manifest = outline.header.manifest
    result: dict[str, Any] = {
        "seed": manifest.get("seed", 0),
        "iterations": outline.iterations,
        "frames": outline.frames,
        "modules": len(outline.saved),
        "learned": ", ".join(label(outline.names()[s.stream]) for s in outline.saved),
        **_ending(_manifest(folder)),
    }
    return {**_configuration(manifest), "result": result}


def read_properties(run: Path) -> Sections:
    """The same as `properties_of`, from the manifest of a finished run alone.

    The log of a run that has none, or no result in it, is read through.

    Raises:
        UsageError: there is no such run.
        LogDamagedError: it cannot be read.
    """
    manifest = _manifest(run)
    try:
        found = manifest["result"]
        modules = [label(str(module["stream"])) for module in found["modules"]]
        result: dict[str, Any] = {
            "seed": int(manifest["seed"]),
            "iterations": int(found["iterations"]),
            "frames": int(found["frames"]),
            "modules": len(modules),
            "learned": ", ".join(modules),
            **_ending(manifest),
        }
    except (KeyError, TypeError, ValueError):
        return properties_of(read_outline(run), run)
    return {**_configuration(manifest), "result": result}


def write_row(run: Path, out: Path) -> None:
    """Write a recording that holds a run's properties only, as the row of a table.

    Raises:
        UsageError: there is no such run.
        LogDamagedError: it cannot be read.
        CdmisfaError: the row cannot be written.
    """
    sections = read_properties(run)
    try:
        chunks = [
            Chunk.from_property(name, _batches(json.dumps(values)))
            for name, values in sections.items()
        ]
        store = ChunkStore.from_chunks(chunks)
        store.write_rrd(out, application_id=APPLICATION, recording_id=run_identity(run))
    except (RuntimeError, OSError, ValueError) as error:
        raise CdmisfaError(f"{out} cannot be written: {error}") from error


@functools.lru_cache(maxsize=1024)
def _batches(values: str) -> tuple[rr.DescribedComponentBatch, ...]:
    """A section's values, given as JSON, as Rerun stores them; runs of a sweep share most."""
    return tuple(rr.AnyValues(**json.loads(values)).as_component_batches())


def _configuration(manifest: Mapping[str, Any]) -> Sections:
    config = manifest.get("config")
    tables = config.items() if isinstance(config, Mapping) else ()
    sections = {str(name): _flat(table) for name, table in tables if isinstance(table, Mapping)}
    return {name: values for name, values in sections.items() if values}


def _manifest(folder: Path) -> Mapping[str, Any]:
    """A run's manifest; empty where there is none that can be read."""
    try:
        document = json.loads((folder / "run.json").read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return document if isinstance(document, Mapping) else {}


def _ending(manifest: Mapping[str, Any]) -> dict[str, str]:
    """Why the run ended, where its manifest says it."""
    try:
        return {name: str(manifest["result"][name]) for name in ("ended", "signals_sha256")}
    except (KeyError, TypeError):
        return {}


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
