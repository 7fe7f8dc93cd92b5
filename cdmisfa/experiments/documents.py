"""How results are written down: JSON values and files, Markdown tables, what they depend on."""

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

PACKAGES = ("cdmisfa", "numpy", "mcap", "protobuf", "rerun-sdk", "pybullet", "icub-models")


def plain(value: Any) -> Any:
    """A value as JSON has it: paths as texts, arrays as lists, None where it has no number."""
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


def markdown(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Rows of cells as a table of Markdown; its last line has no end."""
    lines = (head, ["---"] * len(head), *rows)
    cells = ([str(cell).replace("|", r"\|") for cell in line] for line in lines)
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)


@functools.cache
def versions() -> Mapping[str, str]:
    """Versions of Python and of the packages every result may depend on."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


@functools.cache
def machine() -> dict[str, str]:
    """The system and the processor.

    No signal depends on them; renderings of the simulator, batch SFA and times may.
    """
    return {
        "system": platform.system(),
        "machine": platform.machine(),
        "libc": " ".join(platform.libc_ver()).strip(),
    }


def as_text(document: Mapping[str, Any]) -> str:
    """A JSON document as its file has it."""
    return json.dumps(document, indent=2) + "\n"


def write_json(path: Path, document: Mapping[str, Any] | str) -> None:
    """Write a JSON document, or its text, whole or not at all.

    Raises:
        LogWriteError: the file cannot be written.
    """
    text = document if isinstance(document, str) else as_text(document)
    with atomic_write(path) as partial:
        partial.write_text(text, encoding="utf-8")
