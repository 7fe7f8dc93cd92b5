"""What is kept on disk of compiled functions: until when it counts, and how it is loaded."""

from __future__ import annotations

import contextlib
import hashlib
import pickle
import sys
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

MARKS = (
    b"@compiled",
    b"@inlined",
    b"spliced(",
    b"@reordered",
    b"@in_compiled_code",
    b"@_intrinsic",
    b"Either",
)
"""What files that hold compiled functions contain."""

NEEDLESS = ("numba.np.", "numba.cpython.unicode", "numba.cpython.builtins", "numba.cpython.numbers")
"""Beginnings of modules of which compiled code has all it needs when it is loaded."""


def kept_while_sources_last(dispatcher: Any) -> Any:
    """Let a result on disk count only as long as no compiled function has changed.

    A compiled function holds what it calls in other files; numba by itself compiles it again
    only when its own file has changed.
    """
    results: Any = getattr(dispatcher, "_cache", None)
    kept: Any = getattr(results, "_cache_file", None)
    if hasattr(kept, "_source_stamp"):
        kept._source_stamp = (kept._source_stamp, _sources())
        kept._load_index = partial(_index_or_none, kept._load_index)
        kept._load_data = partial(_load_data, kept)
        results.load_overload = partial(_load_first, results, results.load_overload)
    return dispatcher


def _index_or_none(load: Callable[[], Any]) -> Any:
    """What is on disk, or nothing where it cannot be read.

    Numba unpickles the names of classes before it looks at the stamp: after a move they may lead
    to modules that are no longer there.
    """
    try:
        return load()
    except Exception:
        return {}


def _load_first(results: Any, load: Callable[[Any, Any], Any], signature: Any, context: Any) -> Any:
    """What is on disk, or, where that is nothing, what numba says.

    Numba itself imports all that its compiler can do, SciPy included, before it looks on disk:
    half of the time of a run of one iteration.
    """
    with contextlib.suppress(Exception):  # then numba says what is wrong
        from numba.core.runtime import nrt

        memory: Any = nrt.rtsys  # what allocates arrays, which numba readies with its compiler
        memory.initialize(context)
        found = results._load_overload(signature, context)
        if found is not None:
            return found
    return load(signature, context)


def _load_data(kept: Any, name: str) -> Any:
    with Path(kept._data_path(name)).open("rb") as file:
        return _Unpickler(file).load()


class _Unpickler(pickle.Unpickler):
    """Reads compiled code without importing what it was compiled from, where that is numba's."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("numba.core.environment", "_rebuild_env"):
            return _environment
        return super().find_class(module, name)


def _environment(module: str, constants: list[Any], name: str) -> Any:
    """The constants of a piece of compiled code; its module's globals only if it may use them."""
    from numba.core import environment

    as_numba_does: Any = environment._rebuild_env
    if module in sys.modules or not module.startswith(NEEDLESS):
        return as_numba_does(module, constants, name)
    found = environment.Environment._memo.get(name)
    if found is None:
        found = environment.Environment({"__name__": module})
        found.consts[:] = constants
        found.env_name = name
        environment.Environment._memo[name] = found
    return found


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
