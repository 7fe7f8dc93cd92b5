"""A recording's folder: held by one process at a time, and what it was asked to hold."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from cdmisfa.errors import UsageError

ASKED = "recording.json"
"""How many frames each unfinished view was asked to have; gone when all are finished.

Beside the logs, because these hold the same bytes whatever length was asked for first.
"""


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Keep every other process that asks out of a folder; a kill lets go of it too.

    Raises:
        UsageError: another process holds it, or there is no such folder.
    """
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise UsageError(f"{folder} is no folder that can be opened: {error.strerror}") from error
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UsageError(
                f"{folder} is in use by another process: wait for it, or choose another folder"
            ) from error
        except OSError:
            pass  # A file system without locks: nothing can be held there.
        yield
    finally:
        os.close(handle)


def asked(folder: Path, views: Sequence[str]) -> int | None:
    """The most frames that one of some unfinished views was asked to have; None: nobody knows."""
    known = _read(folder)
    return max((known[view] for view in views if view in known), default=None)


def ask(folder: Path, views: Sequence[str], frames: int) -> None:
    """Note how many frames some views shall have, so that they can be gone on with.

    Raises:
        OSError: the disk does not take it.
    """
    _write(folder, {**_read(folder), **dict.fromkeys(views, frames)})


def answered(folder: Path, views: Sequence[str]) -> None:
    """Forget what was asked of some views, which are finished.

    Raises:
        OSError: the disk does not take it.
    """
    _write(folder, {view: n for view, n in _read(folder).items() if view not in views})


def _read(folder: Path) -> dict[str, int]:
    try:
        frames = json.loads((folder / ASKED).read_text("utf-8"))["frames"]
        return {str(view): n for view, n in frames.items() if isinstance(n, int) and n > 0}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return {}


def _write(folder: Path, frames: dict[str, int]) -> None:
    path = folder / ASKED
    if not frames:
        path.unlink(missing_ok=True)
        return
    partial = path.with_name(f".{ASKED}")
    partial.write_text(json.dumps({"frames": frames}) + "\n", "utf-8")
    os.replace(partial, path)
