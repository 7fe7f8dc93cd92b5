"""modules.npz: the frozen modules of a run, as plain arrays."""

from __future__ import annotations

import dataclasses
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np

from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.modules import Module
from recorder.log.whole import whole
from replay.runs.folders import MODULES_FILE

_NAME = re.compile(r"module([1-9]\d{0,8})_([a-z_]+)")
_NUMBERS = ("index", "stream_index", "iteration")
_OPTIONAL = ("centres", "counts", "expansion", "scale")  # not in every version's files
_PLAIN = (("stream", "U", str), ("expansion", "U", str), ("scale", "f", float))
_ARRAYS = tuple(
    f.name
    for f in dataclasses.fields(Module)
    if f.name not in (*_NUMBERS, *(name for name, _, _ in _PLAIN))
)

_END = struct.Struct("<4s4H2LH")
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
            _refuse_compressed(stored.zip)
            return tuple(_module(stored, index) for index in _indices(stored))
    except FileNotFoundError as error:
        raise UsageError(f"{path} does not exist: name a run's folder") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, EOFError) as error:
        raise LogDamagedError(f"{path} holds no modules ({_line(error)})") from error
    except (MemoryError, OverflowError, RecursionError, SyntaxError, TokenError) as error:
        raise LogDamagedError(f"{path} holds no modules (an impossible array)") from error
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError) as error:
        raise LogDamagedError(f"{path} is damaged ({_line(error)})") from error


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


def _indices(stored: Any) -> list[int]:
    """The modules' indices, of a file in which every name is that of a module's field.

    A checksum protects what the arrays hold, but nothing their names and number.
    """
    fields: dict[int, set[str]] = {}
    for name in stored.files:
        found = _NAME.fullmatch(name)
        if found is None or found[2] not in _FIELDS:
            raise ValueError(f"{name[:40]!r} is nothing of a module")
        fields.setdefault(int(found[1]), set()).add(found[2])
    indices = sorted(fields)
    if indices != list(range(1, len(indices) + 1)):
        raise ValueError(f"there are modules {indices}, one is missing")
    if any(fields[index] != fields[1] for index in indices):
        raise ValueError("a module lacks what another has")
    if any(int(stored[_key(index, "index")]) != index for index in indices):
        raise ValueError("the numbers of modules are mixed up")
    return indices


def _refuse_compressed(archive: zipfile.ZipFile) -> None:
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


def _line(error: Exception) -> str:
    """What an error says, short and in one line."""
    return " ".join(str(error).split())[:200]


def _key(index: int, name: str) -> str:
    return f"module{index}_{name}"
