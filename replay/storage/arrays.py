"""Arrays in .npz files and in bytes, validated before they are used."""

from __future__ import annotations

import math
import os
import re
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from tokenize import TokenError
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import one_line
from cdmisfa.core.untrusted import open_regular

# Largest file of arrays that is read.
MAX_BYTES: Final = 192 * 1024 * 1024

_PLAIN = re.compile(r"[<|][bifuU]\d{1,6}")

# The errors of numpy and zipfile for files that are damaged, or hold something else.
NOT_ARRAYS: Final = (
    *(MemoryError, OverflowError, RecursionError, SyntaxError, TokenError, zlib.error),
    *(OSError, EOFError, LookupError, TypeError, ValueError, AttributeError, RuntimeError),
    zipfile.BadZipFile,
)


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file that `numpy.savez` wrote, by name.

    Together they are no larger than the file.

    Raises:
        OSError: the file cannot be opened.
        UsageError: the path is not a regular file, or the file is too large.
        ValueError: the file has other content; the message names it in one short line.
    """
    with open(open_regular(path, MAX_BYTES), "rb") as file:
        size = os.fstat(file.fileno()).st_size
        try:
            with np.load(file, allow_pickle=False) as stored:
                if sum(member.file_size for member in stored.zip.infolist()) > size:
                    raise ValueError("its arrays overlap, or are compressed")
                arrays = {name: stored[name] for name in stored.files}
        except NOT_ARRAYS as error:
            raise ValueError(one_line(error)) from error
    if not all(isinstance(array, np.ndarray) for array in arrays.values()):
        raise ValueError("not all of its members are arrays")
    return arrays


def contents(arrays: Mapping[str, NDArray[Any]]) -> list[tuple[str, Any, tuple[int, ...]]]:
    """Return name, type and shape of each array, as JSON values, for `stored_arrays`."""
    return [(n, np.lib.format.dtype_to_descr(a.dtype), a.shape) for n, a in arrays.items()]


def stored_arrays(listed: Any, data: bytes) -> dict[str, NDArray[Any]]:
    """Return arrays whose bytes lie one after the other and are all of some data.

    Args:
        listed: what `contents` says of them, after JSON.
        data: their bytes.

    Raises:
        ValueError: the data has other content; the message names it in one short line.
    """
    arrays: dict[str, NDArray[Any]] = {}
    at = 0
    try:
        for name, kind, shape in listed:
            dtype = _plain_type(kind)
            size = dtype.itemsize * math.prod(shape)
            if min(shape, default=0) < 0 or at + size > len(data):
                raise ValueError(f"the data has no array {str(name)[:40]!r}")
            arrays[str(name)] = np.ndarray(shape, dtype, data, at).copy()
            at += size
    except NOT_ARRAYS as error:
        raise ValueError(f"an impossible array: {one_line(error)}") from error
    if at != len(data):
        raise ValueError(f"its arrays have {at} bytes, but the data has {len(data)}")
    return arrays


def _plain_type(kind: Any) -> np.dtype[Any]:
    """Return the type that numpy describes so: numbers or text, or a record of such."""
    fields = [("", kind)] if isinstance(kind, str) else [tuple(field) for field in kind]
    if not all(_PLAIN.fullmatch(field[1]) for field in fields):
        raise ValueError(f"{str(kind)[:40]!r} is not a plain type")
    return np.dtype(kind if isinstance(kind, str) else fields)
