"""What is kept on disk of compiled functions: where, and until when it counts."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import os
import pickle
import platform
import sys
import uuid
from collections.abc import Callable
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

MARKS = (
    b"@compiled",
    b"@inlined",
    b"spliced(",
    b"@reordered",
    b"@in_compiled_code",
    b"@_intrinsic",
    b"Either",
    b"class MachineCode",
)
"""What files contain that hold compiled functions, or say how they are kept."""


NUMBA = "0.68."
"""What the versions of numba begin with whose machine code is run without it."""


def kept_while_sources_last(dispatcher: Any) -> Any:
    """Let a result on disk count only as long as no compiled function has changed.

    A compiled function holds what it calls in other files; numba by itself compiles it again
    only when its own file has changed.
    """
    cache: Any = getattr(dispatcher, "_cache", None)
    if hasattr(cache, "save_overload"):
        cache.save_overload = partial(_saved_if_it_can_be, cache.save_overload)
    kept: Any = getattr(cache, "_cache_file", None)
    if hasattr(kept, "_source_stamp"):
        kept._source_stamp = (kept._source_stamp, _sources())
        kept._load_index = partial(_index_or_none, kept._load_index)
    return dispatcher


def _saved_if_it_can_be(save: Callable[..., None], *compiled: Any) -> None:
    """Run on with what was compiled where the disk is full."""
    with contextlib.suppress(OSError):
        save(*compiled)


def _index_or_none(load: Callable[[], Any]) -> Any:
    """What is on disk, or nothing where it cannot be read.

    Numba unpickles the names of classes before it looks at the stamp: after a move they may lead
    to modules that are no longer there.
    """
    try:
        return load()
    except Exception:
        return {}


@cache
def runs_alone() -> bool:
    """Whether machine code is kept here, and run without the compiler: where this was tested.

    It takes what the compiler made from where these versions of it have that. Not where numba was
    told of more than folders and threads: it may be to profile what runs, or to compile nothing.
    Then it keeps what it compiles itself.
    """
    here = sys.platform == "linux" and platform.machine() == "x86_64"
    return here and _versions()[1].startswith(NUMBA) and not any(_told())


def folder_of(source: Path) -> Path | None:
    """Where what is compiled of a source file is kept; None where nothing can be.

    It is run as it is there, as numba runs what it keeps: a folder is trusted as the source is.
    """
    wanted = os.environ.get("NUMBA_CACHE_DIR")
    beside = source.resolve().parent / "__pycache__"
    folders = [Path(wanted)] if wanted else [beside, Path.home() / ".cache" / "cdmisfa"]
    for folder in folders if source.is_file() else ():
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return None


def keep(name: str, source: Path, value: Any) -> None:
    """Keep a value that can be pickled, made from a source file.

    Raises:
        OSError: it cannot be written.
    """
    pickled = pickle.dumps((_made_by(source), value))
    whole = hashlib.sha256(pickled).digest() + pickled
    folder = folder_of(source)
    if folder is not None:
        file = folder / _file(name, source)
        unfinished = file.with_name(f"{file.name}.{uuid.uuid4().hex[:16]}")
        try:
            unfinished.write_bytes(whole)
            unfinished.replace(file)
        finally:
            unfinished.unlink(missing_ok=True)


def recalled(name: str, source: Path) -> Any:
    """A value that was kept.

    Raises:
        LookupError: it is not there, or counts no more.
        Exception: it cannot be read.
    """
    folder = folder_of(source)
    if folder is None:
        raise LookupError(name)
    whole = (folder / _file(name, source)).read_bytes()
    checksum, pickled = whole[:32], memoryview(whole)[32:]
    if hashlib.sha256(pickled).digest() != checksum:  # as a power cut can leave it
        raise LookupError(name)
    made_by, value = pickle.loads(pickled)
    if made_by != _made_by(source):
        raise LookupError(name)
    return value


def _file(name: str, source: Path) -> str:
    text = "\n".join((str(source.resolve()), name, platform.python_version(), *_settings()))
    return f"{source.stem}.{hashlib.sha256(text.encode()).hexdigest()[:20]}.kept"


@cache
def _settings() -> tuple[str, ...]:
    """The processor, and what numba was told from outside."""
    import llvmlite.binding as llvm

    return (
        llvm.get_process_triple(),
        llvm.get_host_cpu_name(),
        llvm.get_host_cpu_features().flatten(),
        *_told(),
    )


def _told() -> tuple[str, ...]:
    told = {name: value for name, value in os.environ.items() if name.startswith("NUMBA_")}
    for needless in ("NUMBA_CACHE_DIR", "NUMBA_NUM_THREADS"):
        told.pop(needless, None)
    file = Path(".numba_config.yaml")
    return (
        *(f"{name}={told[name]}" for name in sorted(told)),
        file.read_text("utf-8", "replace") if file.is_file() else "",
    )


def _made_by(source: Path) -> tuple[str, ...]:
    return (*_versions(), _sources(), hashlib.sha256(source.read_bytes()).hexdigest())


@cache
def _versions() -> tuple[str, ...]:
    names = ("numba", "llvmlite", "numpy")
    return (sys.version, *(metadata.version(name) for name in names))


@cache
def _sources() -> str:
    """Hash of the sources of all packages that hold compiled functions."""
    root = Path(__file__).parents[3]
    digest = hashlib.sha256()
    for package in ("cdmisfa", "recorder", "replay"):
        for path in sorted((root / package).rglob("*.py")):
            source = path.read_bytes()
            if any(word in source for word in MARKS):
                digest.update(source)
    return digest.hexdigest()


def described(value: Any) -> Any:
    """The type of an argument as JSON values, the same in every process.

    Raises:
        LookupError: there is no description of it.
    """
    kind = type(value)
    name = f"{kind.__module__}:{kind.__qualname__}"
    if kind is np.ndarray:
        flags = value.flags
        order = "C" if flags.c_contiguous else "F" if flags.f_contiguous else "A"
        order += "" if flags.aligned else " unaligned"
        order += "" if flags.writeable else " readonly"
        return [order, value.ndim, _as_json(np.lib.format.dtype_to_descr(value.dtype))]
    if isinstance(value, tuple):
        return {name: [described(one) for one in value]}
    if kind in (bool, float) or isinstance(value, np.number | np.bool):
        return name
    if kind is int and -(2**63) <= value < 2**63:
        return name
    raise LookupError(f"{name} is not known here")


def example_of(description: Any) -> Any:
    """A value of a type that was described.

    Raises:
        Exception: there is no such type, or it cannot be made.
    """
    if isinstance(description, list):
        (order, *but), ndim, dtype = description[0].split(), *description[1:]
        array = np.zeros((4,) * ndim, _as_dtype(dtype), order="F" if order == "F" else "C")
        array = array[(slice(None, None, 2),) * ndim] if order == "A" else array
        array.flags.writeable = "readonly" not in but
        value: Any = array
    elif isinstance(description, dict):
        ((name, parts),) = description.items()
        values = map(example_of, parts)
        value = tuple(values) if name == "builtins:tuple" else _named(name)(*values)
    else:
        value = _named(description)()
    if described(value) != description:
        raise LookupError(f"no value of {description}")
    return value


def _named(name: str) -> Any:
    module, _, kind = name.partition(":")
    return getattr(importlib.import_module(module), kind)


def _as_json(descr: Any) -> Any:
    return [_as_json(one) for one in descr] if isinstance(descr, list | tuple) else descr


def _as_dtype(descr: Any) -> np.dtype[Any]:
    fields = [tuple(field) for field in descr] if isinstance(descr, list) else descr
    return np.lib.format.descr_to_dtype(fields)
