"""Output of results: JSON values and files, Markdown tables, versions and machine."""

from __future__ import annotations

import contextlib
import functools
import json
import math
import platform
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from recorder.log.files import atomic_write

# Packages whose version can change a result.
PACKAGES = ("cdmisfa", "numpy", "mcap", "protobuf", "rerun-sdk", "pybullet", "icub-models")


def plain(value: Any) -> Any:
    """Return a value in JSON types: paths as texts, arrays as lists, None for NaN."""
    match value:
        case Mapping():
            return {str(k): plain(v) for k, v in value.items()}
        case float():
            return value if math.isfinite(value) else None
        case Path():
            return str(value)
        case list() | tuple():
            return [plain(v) for v in value]
        case _ if hasattr(value, "tolist"):
            return plain(value.tolist())
        case _:
            return value


def warnings_of(source: object) -> list[str]:
    """Return the warnings about a source, including changed and damaged frames."""
    changes = getattr(source, "changes", {}).values()
    damage: list[str] = getattr(source, "skipped_damage", list)()
    return [*getattr(source, "warnings", ()), *changes, *damage]


def notes_of(source: Any) -> list[str]:
    """Return how the images of a source become frames, and which topics are left out."""
    framings = zip(source.spec.streams, getattr(source, "framings", ()), strict=False)
    changed = [f"{name}: {framing}" for name, framing in framings if "," in str(framing)]
    return [*getattr(source, "notes", ()), *changed]


def about_source(source: object) -> dict[str, list[str]]:
    """Return the warnings and notes about a source, as keys of a JSON document."""
    return {"warnings": warnings_of(source), "notes": notes_of(source)}


def markdown(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a Markdown table, without a line end after the last line."""
    lines = (head, ["---"] * len(head), *rows)
    cells = ([str(cell).replace("|", r"\|") for cell in line] for line in lines)
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)


@functools.cache
def versions() -> Mapping[str, str]:
    """Return the versions of Python and of `PACKAGES`."""
    result = {"python": platform.python_version()}
    for name in PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            result[name] = metadata.version(name)
    return result


@functools.cache
def machine() -> dict[str, str]:
    """Return the system, the processor and the C library.

    Signals do not depend on them; simulated images, batch SFA and times can.
    """
    return {
        "system": platform.system(),
        "machine": platform.machine(),
        "libc": " ".join(platform.libc_ver()).strip(),
    }


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON document completely or not at all.

    Raises:
        LogWriteError: the file cannot be written.
    """
    with atomic_write(path) as partial:
        partial.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
