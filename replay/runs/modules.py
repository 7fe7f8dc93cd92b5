"""modules.npz: the frozen modules of a run, as plain arrays."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import LogDamagedError, UsageError, one_line
from cdmisfa.core.modules import Module
from recorder.log.files import atomic_write
from replay.runs.folders import MODULES_FILE
from replay.storage.arrays import read_arrays

Arrays = Mapping[str, NDArray[Any]]

_NAME = re.compile(r"module([1-9]\d{0,8})_([a-z_]+)")
_NUMBERS = ("index", "stream_index", "iteration")
_OPTIONAL = ("centres", "counts", "expansion", "scale")  # not in every version's files
_PLAIN = (("stream", "U", str), ("expansion", "U", str), ("scale", "f", float))
_ARRAYS = tuple(
    f.name
    for f in dataclasses.fields(Module)
    if f.name not in (*_NUMBERS, *(name for name, _, _ in _PLAIN))
)

_FIELDS = {field.name for field in dataclasses.fields(Module)}


def save_modules(path: Path, modules: Iterable[Module]) -> None:
    """Write modules as arrays `module<index>_<field>`, whole or not at all.

    Raises:
        LogWriteError: the file cannot be written.
    """
    arrays: dict[str, Any] = {}
    for module in modules:
        for field in dataclasses.fields(Module):
            arrays[_key(module.index, field.name)] = getattr(module, field.name)
    with atomic_write(Path(path)) as partial, open(partial, "wb") as file:
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
        stored = read_arrays(path)
        return tuple(_module(stored, index) for index in _indices(stored))
    except FileNotFoundError as error:
        raise UsageError(f"{path} does not exist: name a run's folder") from error
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise LogDamagedError(f"{path} holds no modules ({one_line(error)})") from error


def _module(stored: Arrays, index: int) -> Module:
    before_names = _key(index, "stream_index") not in stored  # then "stream" is the index
    values: dict[str, Any] = {"stream": ""}
    for name in _NUMBERS:
        kept = "stream" if before_names and name == "stream_index" else name
        values[name] = int(stored[_key(index, kept)])
    for name in _ARRAYS:
        if name in _OPTIONAL and _key(index, name) not in stored:
            continue
        array = stored[_key(index, name)]
        if array.dtype.kind not in "fi":
            raise ValueError(f"{name} is no array of numbers")
        values[name] = array
    for name, kind, of_type in _PLAIN:
        if _key(index, name) in stored and not (before_names and name == "stream"):
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


def _indices(stored: Arrays) -> list[int]:
    """The modules' indices, of a file in which every name is that of a module's field.

    A checksum protects what the arrays hold, but nothing their names and number. A later version
    may add fields to those of this one; one that is unknown in place of one that is not there is
    a damaged name.
    """
    fields: dict[int, set[str]] = {}
    for name in stored:
        found = _NAME.fullmatch(name)
        if found is None:
            raise ValueError(f"{name[:40]!r} is nothing of a module")
        fields.setdefault(int(found[1]), set()).add(found[2])
    indices = sorted(fields)
    if indices != list(range(1, len(indices) + 1)):
        raise ValueError(f"there are modules {indices}, one is missing")
    if any(fields[index] != fields[1] for index in indices):
        raise ValueError("a module lacks what another has")
    unknown = sorted(fields[1] - _FIELDS) if indices else []
    if unknown and not fields[1] > _FIELDS:
        raise ValueError(f"{unknown[0][:40]!r} is nothing of a module")
    if any(int(stored[_key(index, "index")]) != index for index in indices):
        raise ValueError("the numbers of modules are mixed up")
    return indices


def _key(index: int, name: str) -> str:
    return f"module{index}_{name}"
