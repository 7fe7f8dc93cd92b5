"""modules.npz: the frozen modules of a run, as plain arrays."""

from __future__ import annotations

import dataclasses
import re
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.modules import Module
from recorder.log.whole import whole
from replay.runs.folders import MODULES_FILE

MAX_BYTES = 4 * 1024**3
"""Largest array that is read; asked for before anything is decompressed."""

_FIRST = re.compile(r"module\d+_index")
_NUMBERS = ("index", "stream_index", "iteration")
_OPTIONAL = ("centres", "counts", "expansion", "scale")  # not in every version's files
_PLAIN = (("stream", "U", str), ("expansion", "U", str), ("scale", "f", float))
_ARRAYS = tuple(
    f.name
    for f in dataclasses.fields(Module)
    if f.name not in (*_NUMBERS, *(name for name, _, _ in _PLAIN))
)


def save_modules(path: Path, modules: Iterable[Module]) -> None:
    """Write modules as arrays `module<index>_<field>`, whole or not at all.

    Raises:
        LogWriteError: the file cannot be written.
    """
    arrays: dict[str, Any] = {}
    for module in modules:
        for field in dataclasses.fields(Module):
            arrays[_key(module.index, field.name)] = getattr(module, field.name)
    with whole(Path(path)) as partial, open(partial, "wb") as file:
        np.savez(file, **arrays)


def load_modules(path: Path) -> tuple[Module, ...]:
    """The modules of a file, or of a run's folder, in the order of learning.

    Raises:
        UsageError: there is no such file.
        LogDamagedError: it holds something else.
    """
    path = Path(path)
    path = path / MODULES_FILE if path.is_dir() else path
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
            _refuse_large(stored.zip)
            first = (name for name in stored.files if _FIRST.fullmatch(name))
            indices = sorted(int(stored[name]) for name in first)
            return tuple(_module(stored, index) for index in indices)
    except FileNotFoundError as error:
        raise UsageError(f"{path} does not exist: name a run's folder") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, EOFError) as error:
        raise LogDamagedError(f"{path} holds no modules ({error})") from error
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError) as error:
        raise LogDamagedError(f"{path} is damaged ({error})") from error


def _module(stored: Any, index: int) -> Module:
    before_names = _key(index, "stream_index") not in stored.files  # then "stream" is the index
    values: dict[str, Any] = {"stream": ""}
    for name in _NUMBERS:
        kept = "stream" if before_names and name == "stream_index" else name
        values[name] = int(stored[_key(index, kept)])
    for name in _ARRAYS:
        if name in _OPTIONAL and _key(index, name) not in stored.files:
            continue
        array = stored[_key(index, name)]
        if array.dtype.kind not in "fi":
            raise ValueError(f"{name} is no array of numbers")
        values[name] = array
    for name, kind, of_type in _PLAIN:
        if _key(index, name) in stored.files and not (before_names and name == "stream"):
            array = stored[_key(index, name)]
            if array.dtype.kind != kind:
                raise ValueError(f"{name} is no {of_type.__name__}")
            values[name] = of_type(array.item())
    outputs, size = values["phi"].shape
    for name, shape in {
        "mean": (size,),
        "band_mean": (outputs,),
        "band_sd": (outputs,),
        "eta": (outputs,),
    }.items():
        if values[name].shape != shape:
            raise ValueError(f"{name} has shape {values[name].shape}")
    return Module(**values)


def _refuse_large(archive: zipfile.ZipFile) -> None:
    size = sum(item.file_size for item in archive.infolist())
    if size > MAX_BYTES:
        raise ValueError(f"{size} bytes unpacked")


def _key(index: int, name: str) -> str:
    return f"module{index}_{name}"
