"""A folder that one process at a time writes in."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from cdmisfa.core.errors import UsageError


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Keep every other process that holds folders out of this one; a kill lets go of it, too.

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
