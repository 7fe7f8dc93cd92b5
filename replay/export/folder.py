"""A folder that an export writes: there in whole, or not at all."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from cdmisfa.core.errors import CdmisfaError, UsageError
from recorder.log.whole import partial_path

WRITTEN = frozenset({".png", ".mp4", ".parquet", ".json", ".md"})
"""Endings of the files that exports write; a folder with others is somebody else's."""


@contextlib.contextmanager
def whole_folder(out: Path) -> Iterator[Path]:
    """A folder to write into, which becomes `out` once it is complete.

    An earlier export that is there is replaced.

    Args:
        out: the folder.

    Raises:
        UsageError: `out` is there and holds other files than exports write.
        CdmisfaError: it cannot be written.
    """
    _refuse_others(out)
    partial = partial_path(out)
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        yield partial
        if out.is_dir():
            shutil.rmtree(out)
        elif out.exists():
            out.unlink()
        os.replace(partial, out)
    except OSError as error:
        raise CdmisfaError(f"{out} cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _refuse_others(out: Path) -> None:
    if out.is_file() or not out.exists():
        return
    for file in out.rglob("*"):
        if not file.is_dir() and file.suffix not in WRITTEN:
            raise UsageError(
                f"{out} holds other files, such as {file.relative_to(out)}: export into a new "
                "folder"
            )
