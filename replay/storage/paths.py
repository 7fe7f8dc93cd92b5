"""Find the logs that paths name."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from pathlib import Path

from cdmisfa.core.errors import UsageError
from cdmisfa.core.untrusted import opened_regular
from recorder.mcap.records import MAGIC
from recorder.mcap.store import PARTIAL
from replay.storage.location import location


def log_files(path: str | Path) -> list[Path]:
    """List the MCAP files of a folder; of a file itself.

    In a folder a `.partial` counts where the finished file is not there.

    Raises:
        UsageError: the folder has no log.
    """
    path = location(path)
    if not path.exists():
        raise no_such(path)
    if not path.is_dir():
        return [path]
    whole = sorted(path.glob("*.mcap"))
    cut = sorted(path.glob(f"*.mcap{PARTIAL}"))
    logs = whole + [p for p in cut if p.with_suffix("") not in whole]
    if not logs:
        raise UsageError(
            f"{path}: no MCAP file in this folder: give each video, "
            "bag, table or folder of images by its path, or index all with cdmisfa index"
        )
    return logs


def no_such(path: Path, words: Iterable[str] = (), remedy: str = "") -> UsageError:
    """Return the error about a path that does not exist, with the nearest existing name.

    Args:
        path: the path as the user gave it.
        words: further names that the user may have meant.
        remedy: text if no name is near.
    """
    beside = [path.parent / p.name for p in path.parent.iterdir()] if path.parent.is_dir() else ()
    known = {str(name).lower(): name for name in (*beside, *words)}
    nearest = difflib.get_close_matches(str(path).lower(), known, n=1, cutoff=0.7)
    hint = f"did you mean {known[nearest[0]]}?" if nearest else remedy
    return UsageError(f"{path}: no such file or folder{hint and ': '}{hint}")


def starts_as_log(path: Path) -> bool:
    """Return whether a file begins as every MCAP file does.

    Raises:
        UsageError: the path is not a regular file, or not readable.
        LogDamagedError: the disk does not give it.
    """
    with opened_regular(path) as file:
        return file.read(len(MAGIC)) == MAGIC


def natural_order(path: Path) -> list[tuple[int, str]]:
    """Return a sort key that puts 9.png before 10.png."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(p) if p.isdecimal() else -1, p) for p in parts]
