"""Files of plain arrays on this machine (.npz), of which nothing is believed."""

from __future__ import annotations

import os
import struct
import zipfile
import zlib
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import one_line

_END = struct.Struct("<4s4H2LH")
_IMPOSSIBLE = (MemoryError, OverflowError, RecursionError, SyntaxError, TokenError)
_DAMAGED = (
    *(OSError, EOFError, KeyError, TypeError, ValueError, AttributeError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error),
)  # together what numpy and zipfile raise for damaged files


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a file that `numpy.savez` wrote, by name.

    They were stored as they are, so that together they are no larger than the file.

    Raises:
        OSError: the file cannot be opened.
        ValueError: it holds something else; it says what in one short line.
    """
    with open(path, "rb") as file:
        try:
            with np.load(file, allow_pickle=False) as stored:
                _refuse_packed(stored.zip)
                arrays = {name: stored[name] for name in stored.files}
        except _IMPOSSIBLE as error:
            raise ValueError("an impossible array") from error
        except _DAMAGED as error:
            raise ValueError(one_line(error)) from error
    if not all(isinstance(array, np.ndarray) for array in arrays.values()):
        raise ValueError("not all of it are arrays")
    return arrays


def _refuse_packed(archive: zipfile.ZipFile) -> None:
    """Refuse what was not stored as it is: only then nothing unpacks to more than the file."""
    members = archive.infolist()
    if any(member.compress_type != zipfile.ZIP_STORED for member in members):
        raise ValueError("it is compressed")
    if len(members) != _stated_members(archive):
        raise ValueError("its directory is cut")
    if len({member.filename for member in members}) < len(members):
        raise ValueError("two arrays have one name")
    end = 0
    for member in members:
        if member.header_offset < end:
            raise ValueError("its arrays overlap")
        end = member.header_offset + member.file_size


def _stated_members(archive: zipfile.ZipFile) -> int:
    """How many members the last record of a zip file without a comment states."""
    if archive.fp is None or archive.comment:
        raise ValueError("it has a comment")
    archive.fp.seek(-_END.size, os.SEEK_END)
    return int(_END.unpack(archive.fp.read(_END.size))[4])
